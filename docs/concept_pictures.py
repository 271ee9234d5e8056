"""Draw the pictures of the concept pages from the code that they explain: ``python docs/concept_pictures.py PLAN``.

PLAN is a plan.json, such as that of ``run_twin.py demo``.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.collections import PolyCollection
from matplotlib.patches import Circle, Polygon

import puncture_twin as pt
from benchmarks.placements import meshes_of, phantoms
from puncture_twin.meshes import folder
from puncture_twin.planning.anatomy.body.body_mask import body_mask
from puncture_twin.planning.anatomy.scan import OutsideImage, outside_mask
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.tables import AIR_HU
from puncture_twin.planning.collision.packed import sphere_tree
from puncture_twin.planning.evidence.edges import Placement, compare, edge_image, sample_surfaces
from puncture_twin.planning.evidence.label_placement import REFUSING_Z
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.planning.reach.standoff import skin_gaps
from puncture_twin.planning.registration.checks.markers import skin_fit
from tools.phantoms import supine
from tools.phantoms.ct_image import rendered

PICTURES = Path(__file__).parent / "pictures"
BLUE, ORANGE, GREEN, RED, GREY = "#1f4e8c", "#b9770e", "#1e8449", "#c0392b", "#8a8a8a"
SAFE_COLOURS = {"S": GREEN, "R": "#d9d9d9", "U": ORANGE}
POSE = np.radians([20, -70, 90, -60, -80, 0])
"""Joint angles whose flange pose the picture of the branches shows."""


def save(figure, name):
    """Write one picture."""
    figure.tight_layout()
    figure.savefig(PICTURES / name, dpi=100)
    plt.close(figure)


def kinematics():
    """The eight branches of one pose as stick figures."""
    model = ur_model("ur3")
    target = flange_pose(model, POSE)
    figure = plt.figure(figsize=(11, 6))
    for branch, q in enumerate(inverse(model, target)[0]):
        ax = figure.add_subplot(2, 4, branch + 1, projection="3d")
        ax.set_title(f"branch {branch}" + (": none" if np.isnan(q).any() else ""), fontsize=10)
        if not np.isnan(q).any():
            joints = link_poses(model, q)[:, :3, 3]
            ax.plot(*joints.T, "-o", color=BLUE, linewidth=3, markersize=4)
        tip = target[:3, 3] + 90 * target[:3, 2]
        ax.plot(*np.stack([target[:3, 3], tip], axis=1), color=RED, linewidth=3)
        ax.set(xlim=(-400, 400), ylim=(-400, 400), zlim=(-150, 650))
        ax.view_init(elev=18, azim=-60)
        ax.set_box_aspect((1, 1, 1))
        ax.tick_params(labelsize=6)
    save(figure, "kinematics.png")


def standoff():
    """The padded needle before oblique skin, and the gap over the skin angle."""
    needle = pt.load_case(folder() / "abdomen").needle
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.4), width_ratios=(1.2, 1))
    angle, padding, radius = np.radians(50), 5.0, needle.radius_mm
    gap = float(skin_gaps(needle, angle))
    along, across = np.array([np.sin(angle), np.cos(angle)]), np.array([np.cos(angle), -np.sin(angle)])
    left.axhspan(-22, 0, color="#f3e6da")
    left.axhline(0, color=ORANGE)
    tip, wide = gap * along, (radius + padding) * across
    corners = [tip - padding * along + s * wide for s in (-1, 1)] + [tip + 40 * along + s * wide for s in (1, -1)]
    left.add_patch(Polygon(corners, facecolor="#dbe9f6", edgecolor=BLUE))
    left.plot(*np.stack([tip, tip + 40 * along], axis=1), color="black", linewidth=3)
    left.plot(*np.stack([-20 * along, tip], axis=1), "--", color=GREY)
    left.annotate("tip", tip, xytext=tip + [6, -5])
    left.annotate("skin", (-22, -3), color=ORANGE)
    left.annotate(f"gap {gap:.1f} mm", 0.5 * tip, xytext=(-16, 6), color=GREY)
    left.annotate("needle with 5 mm of padding", tip + 18 * along, xytext=(-24, 33), color=BLUE)
    left.set(xlim=(-26, 48), ylim=(-18, 40), aspect="equal", title="standoff at a skin angle of 50°")
    left.set_axis_off()
    degrees = np.linspace(0, 75, 200)
    right.plot(degrees, skin_gaps(needle, np.radians(degrees)), color=BLUE)
    right.set(xlabel="skin angle, degrees", ylabel="gap from tip to skin, mm", ylim=(0, None))
    right.grid(alpha=0.3)
    save(figure, "standoff.png")


def bounding_spheres():
    """The forearm of a UR3, and the leaves of its tree of spheres."""
    link = next(one for one in collision_links(ur_model("ur3")) if one.name == "forearm")
    tree = sphere_tree([np.asarray(piece.vertices) for piece in link.pieces])
    figure, ax = plt.subplots(figsize=(11, 4.6))
    for row in tree.leaves:
        ax.add_patch(Circle(tree.centres[row, :2], tree.radii[row], facecolor="#fbe5d0", edgecolor=ORANGE, alpha=0.5))
    for piece, colour in zip(link.pieces, plt.cm.Blues(np.linspace(0.35, 0.8, len(link.pieces))), strict=True):
        faces = np.asarray(piece.vertices)[np.asarray(piece.faces)][:, :, :2]
        ax.add_collection(
            PolyCollection(faces, facecolor=(*colour[:3], 0.35), edgecolor=(*colour[:3], 0.5), linewidth=0.3)
        )
    ax.set(aspect="equal", xlabel="mm", title=f"{len(link.pieces)} convex pieces in {len(tree.leaves)} spheres")
    ax.autoscale_view()
    save(figure, "bounding_spheres.png")


def approach(plan_file):
    """Joint speeds over time."""
    plan = read_plan(plan_file)
    limit = 0.5 * np.degrees(plan.model.max_speeds)
    figure, axes = plt.subplots(1, 2, figsize=(11, 4), sharey=True)
    for ax, motion, title in zip(axes, (plan.approach, plan.insertion), ("approach", "insertion"), strict=True):
        speeds = np.degrees(np.diff(motion.q, axis=0) / np.diff(motion.times_s)[:, None])
        ax.plot(motion.times_s[1:], speeds, label=[f"q{joint}" for joint in range(1, 7)])
        ax.set(xlabel="s", title=title)
        ax.grid(alpha=0.3)
    axes[0].axhline(limit.min(), color=RED, linestyle=":", label="limit")
    axes[0].axhline(-limit.min(), color=RED, linestyle=":")
    axes[0].set_ylabel("degrees per second")
    axes[0].legend(ncols=2, fontsize=8)
    save(figure, "approach.png")


def certificate():
    """The cells of the embedded abdomen."""
    context = pt.prepare(folder() / "abdomen", arm=False)
    found = pt.certify(context, size_deg=1.0)
    figure, ax = plt.subplots(figsize=(7, 7), subplot_kw={"projection": "polar"})
    theta, beta = np.degrees(found.leaves.theta), found.leaves.beta
    for letter, colour in SAFE_COLOURS.items():
        rows = found.verdict == letter
        low, high = theta[rows].T
        first, last = beta[rows].T
        style = {"color": colour, "edgecolor": "white", "linewidth": 0.15}
        ax.bar(0.5 * (first + last), high - low, width=last - first, bottom=low, **style)
        ax.plot([], [], "s", color=colour, label={"S": "safe", "R": "rejected", "U": "undecided"}[letter])
    ax.set_title("puncture angle outward, azimuth around, degrees")
    ax.legend(loc="lower left", bbox_to_anchor=(-0.08, -0.06))
    save(figure, "certificate.png")


def body_and_air():
    """A slice of the supine phantom with its body, and what is outside of it and not air."""
    grid, rng = supine.grid(), np.random.default_rng(20191104)
    parts = [*supine.trunk_parts(), *supine.arm_parts("down"), *supine.bed_parts(), supine.line_part()]
    hu = rendered(parts, grid, noise_hu=12.0, rng=rng).astype(np.float32)
    spacing = np.array(grid.spacing_mm)
    body = body_mask(hu, spacing, where="supine phantom").body
    outside = outside_mask(OutsideImage(hu, body, np.zeros_like(body), grid.affine, spacing), AIR_HU)
    low, (nx, ny, _) = np.array(grid.low_mm), grid.shape
    row = int(np.argmin(np.abs(low[2] + spacing[2] * np.arange(grid.shape[2]) - 30.0)))
    x, y = low[0] + spacing[0] * np.arange(nx), low[1] + spacing[1] * np.arange(ny)
    figure, ax = plt.subplots(figsize=(11, 6.6))
    extent = (x[0], x[-1], y[-1], y[0])
    ax.imshow(hu[:, :, row].T, cmap="gray", vmin=-1000, vmax=400, extent=extent)
    ax.contourf(x, y, outside[:, :, row].T, levels=[0.5, 1.5], colors=[ORANGE], alpha=0.55)
    ax.contour(x, y, body[:, :, row].T, levels=[0.5], colors=["#4fc3f7"])
    ax.plot([], [], color="#4fc3f7", label="body (trunk and both arms)")
    ax.plot([], [], "s", color=ORANGE, label="outside_body: mattress, table, line")
    ax.set(xlabel="x, mm (patient's left to the right)", ylabel="y, mm (front above)")
    ax.legend(loc="lower right")
    save(figure, "body_and_air.png")


def markers():
    """The abdomen's markers as given and rotated by half a turn about z, and their distances from the skin."""
    context = pt.prepare(folder() / "abdomen", arm=False)
    points = pt.read_points(folder() / "abdomen" / "markers_ct.csv")
    lists = {"as given": points.points, "x and y negated": points.points * [-1, -1, 1]}
    skin = context.anatomy.skin
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6))
    outline = np.asarray(skin.mesh.vertices)
    left.scatter(outline[::7, 0], outline[::7, 1], s=0.3, color="#d9c3ae")
    for (name, one), colour, shift in zip(lists.items(), (GREEN, RED), (-0.18, 0.18), strict=True):
        fit = skin_fit(one, skin)
        left.plot(one[:, 0], one[:, 1], "o", color=colour, label=f"{name}: scatter {fit.scatter_mm:.1f} mm")
        rows = np.arange(len(one))
        right.bar(rows + shift, fit.gaps_mm, width=0.34, color=colour, label=name)
    left.invert_yaxis()
    left.set(aspect="equal", xlabel="x, mm", ylabel="y, mm (front above)")
    left.legend(loc="center", fontsize=8)
    right.set(xticks=range(len(points.names)), ylabel="distance from the skin, mm")
    right.set_xticklabels(points.names)
    right.legend()
    save(figure, "markers.png")


def evidence():
    """Labels 12 mm off on a slice of their CT, and z of every shift: in place, every other is worse."""
    patient = dict(phantoms())["trunk"]
    image, meshes = edge_image(patient.hu, patient.T), meshes_of(patient)
    figure, (left, right) = plt.subplots(1, 2, figsize=(11, 4.6), width_ratios=(1.2, 1))
    middle, steps = patient.hu.shape[2] // 2, np.arange(-30.0, 31.0, 3.0)
    x, y = (patient.T[k, 3] + patient.T[k, k] * np.arange(patient.hu.shape[k]) for k in range(2))
    left.pcolormesh(x, y, patient.hu[:, :, middle].T, cmap="gray", vmin=-200, vmax=400)
    for colour, off_mm in ((GREEN, 0.0), (RED, 12.0)):
        for label in range(1, int(patient.labels.max()) + 1):
            inside = label == patient.labels[:, :, middle].T
            left.contour(x, y + off_mm, inside, levels=[0.5], colors=colour, linewidths=1.2)
        slip = pose(np.eye(3), [0.0, off_mm, 0.0])
        sample = sample_surfaces([mesh.transformed(slip) for mesh in meshes.values()])
        for axis, style in enumerate(("-", "--", ":")):
            moves = [Placement("shift", pose(np.eye(3), step * np.eye(3)[axis])) for step in steps]
            z = [fit.z for fit in compare(image, sample, moves).fits]
            label = f"{off_mm:g} mm off, moved along {'xyz'[axis]}"
            right.plot(steps, np.where(steps == 0, 0.0, z), style, color=colour, label=label)
    left.set(xlabel="x, mm (LPS)", ylabel="y, mm (LPS)", title="green: labels in place; red: 12 mm to the back")
    left.set_aspect("equal")
    left.invert_yaxis()
    right.axhspan(REFUSING_Z, 22, color="#f9e3e0")
    right.axhline(0, color=GREY, linewidth=0.8)
    right.annotate("refused", (-29, REFUSING_Z + 0.3), color=RED)
    right.set(
        xlabel="moved by, mm",
        ylabel="z: better elsewhere",
        ylim=(-15, 22),
        title="every shift against the place as it is",
    )
    right.legend(fontsize=8, loc="upper right")
    save(figure, "evidence.png")


def main() -> None:
    """Draw all."""
    kinematics()
    standoff()
    bounding_spheres()
    approach(Path(sys.argv[1]))
    certificate()
    body_and_air()
    markers()
    evidence()


if __name__ == "__main__":
    main()
