"""A small patient for the tests of what a person looks at: every verdict is known from θ and β alone."""

import io
from pathlib import Path as FilePath
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from PIL import Image

from puncture_twin.planning.anatomy.scan import nearest
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.case.case import view_frame
from puncture_twin.planning.case.entry import entry_frame, grid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.search.candidates import ArmColumns, Candidates, ClearanceColumns, Path, Ranking, Verdict
from puncture_twin.twin.report.map.map_picture import map_figure
from puncture_twin.twin.report.page import page
from puncture_twin.twin.report.raster.raster import draw
from puncture_twin.twin.report.raster.render import Drawn, View
from puncture_twin.twin.report.slices.panel import Subject

TARGET = np.array([10.0, -20.0, 30.0])
SKIN_RADIUS = 100.0
STANDOFF = 130.0


def make_case(*, space="LPS", frame=None, name="ball"):
    """A case with a 210 mm needle; the entry frame is the space's own unless said."""
    rotation = entry_frame(frame, Space(space))
    needle = SimpleNamespace(
        length_mm=210.0,
        shaft_mm=150.0,
        diameter_mm=1.2,
        radius_mm=0.6,
        skin_gap_mm=10.0,
        holder_diameter_mm=30.0,
        lengths_mm=(),
    )
    return SimpleNamespace(
        name=name,
        path=FilePath("ball.toml"),
        space=Space(space),
        target_ct=TARGET,
        target_name="lesion",
        target_structure="liver",
        needle=needle,
        T_ct_entry=view_frame(rotation, TARGET),
        obstacles=(),
        gantry=None,
        inputs=(Input("case", "case.toml", "ab" * 32), Input("mesh liver", "liver.ply", "cd" * 32)),
        robot=SimpleNamespace(model=ur_model("ur3")),
        rehearsal=SimpleNamespace(seed=7),
        breathing=None,
        bending=None,
        tool=None,
    )


def make_directions(case, *, step_deg=5.0, theta_deg=(0, 90), beta_deg=(0, 360)):
    limits = [tuple(np.radians(pair)) for pair in (theta_deg, beta_deg)]
    return grid(*limits, np.radians(step_deg), case.T_ct_entry[:3, :3])


def make_candidates(case, *, safe=True, **limits):
    """β 30-90: ``too_close`` (rib); θ from 70 on: ``too_long``; else safe, clearance growing with θ."""
    ways = make_directions(case, **limits)
    theta, beta = np.degrees(ways.theta), np.degrees(ways.beta)
    n = len(ways)
    reason = np.full(n, "", dtype="U20")
    reason[theta > 69.9] = "too_long"
    reason[(beta > 29.9) & (beta < 90.1)] = "too_close"
    if not safe:
        reason[reason == ""] = "skin_angle"
    good, rib = reason == "", reason == "too_close"
    rank = np.zeros(n, dtype=np.int32)
    rank[good] = 1 + np.arange(good.sum())
    clearance = np.stack([5.0 + theta / 10, np.full(n, 40.0)], axis=1)
    return Candidates(
        theta=ways.theta.copy(),
        beta=ways.beta.copy(),
        outward_ct=ways.outward_ct.copy(),
        verdict=Verdict(
            reason=reason,
            structure=np.where(rib, "rib_right_9", ""),
            depth=np.where(rib, 55.5, np.nan),
            amount=np.where(rib, 0.25, np.nan),
            detail=np.where(reason == "too_long", "the shaft ends at 150 mm", ""),
        ),
        path=Path(
            entry_ct=TARGET + SKIN_RADIUS * ways.outward_ct,
            length=np.full(n, SKIN_RADIUS),
            skin_angle=np.zeros(n),
            tissue=np.zeros(n),
        ),
        clearance=ClearanceColumns(
            structures=("rib_right_9", "aorta"),
            margins=np.array([1.0, 5.0]),
            by_structure=clearance,
            least=clearance.min(axis=1),
        ),
        arm=ArmColumns(np.where(good, 1, -1).astype(np.int8), np.where(good, 0.5, np.nan), np.full((n, 6), np.nan)),
        ranking=Ranking(np.where(good, 0.1 * rank, np.nan), rank, (rank > 0) & (rank < 4)),
        safe_cone=np.full(n, np.nan),
        arm_note="checked",
    )


def make_anatomy(*, warnings=()):
    """A round skin about the target, an organ around it, a rib and a vessel."""
    parts = (
        ("liver", "target", 0.0, _ball(40, TARGET)),
        ("rib_right_9", "avoid", 1.0, _ball(8, TARGET + np.array([-70, 0, 0]))),
        ("aorta", "avoid", 5.0, _ball(10, TARGET + np.array([40, 60, 0]))),
    )
    structures = tuple(
        SimpleNamespace(name=name, role=role, margin_mm=margin, mesh=mesh, closed=True, source=name)
        for name, role, margin, mesh in parts
    )
    skin = SimpleNamespace(mesh=_ball(SKIN_RADIUS, TARGET, 4), cut_faces=np.zeros(0, int), field_of_view=None)
    return SimpleNamespace(
        structures=structures,
        surroundings=(),
        checked=structures,
        skin=skin,
        scan=None,
        warnings=tuple(warnings),
        findings=(),
    )


def make_plan(case, candidates):
    """A motion of a UR3 along the best candidate; the approach is a straight line of joint angles."""
    outward = candidates.outward_ct[candidates.ranked[0]]
    T_base_ct = np.eye(4)
    T_base_ct[:3, :3] = [[1, 0, 0], [0, 0, 1], [0, -1, 0]]
    T_base_ct[:3, 3] = [0.0, 330.0, 50.0] - T_base_ct[:3, :3] @ case.target_ct
    q = _insertion(case, T_base_ct, outward)
    home = np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
    share = np.linspace(0, 1, 20)[:, None]
    row = candidates.ranked[0]
    return SimpleNamespace(
        case_name=case.name,
        inputs=case.inputs,
        seed=7,
        model=ur_model("ur3"),
        T_base_ct=T_base_ct,
        expected_target_error_mm=1.25,
        theta=candidates.theta[row],
        beta=candidates.beta[row],
        entry_ct=candidates.path.entry_ct[row],
        target_ct=case.target_ct,
        outward_ct=outward,
        roll=0.0,
        standoff_mm=STANDOFF,
        needle_length_mm=case.needle.length_mm,
        approach=Trajectory(np.linspace(0, 1, 20), home * (1 - share) + q[0] * share),
        insertion=Trajectory(np.linspace(0, 1, len(q)), q),
        clearance_mm={"approach": 12.0, "insertion": 9.0, "needle": 5.0},
        warnings=(),
        guidance=(),
    )


def _insertion(case, T_base_ct, outward):
    model = ur_model("ur3")
    z = -outward
    x = np.cross(z, [1.0, 0.2, 0.1])
    x /= np.linalg.norm(x)
    poses = np.tile(np.eye(4), (30, 1, 1))
    poses[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=1)
    heights = case.needle.length_mm + np.linspace(STANDOFF, 0, 30)
    poses[:, :3, 3] = case.target_ct + heights[:, None] * outward
    solutions = inverse(model, T_base_ct @ poses)
    for branch in range(solutions.shape[1]):
        q = np.unwrap(solutions[:, branch], axis=0)
        if np.isfinite(q).all() and np.abs(np.diff(q, axis=0)).max() < 0.3:
            return q
    raise AssertionError("the test's own pose is out of reach")


def make_rehearsal(plan, *, shift=(0.6, 0.0, 0.8), total_s=2.0):
    """The plan executed exactly, with the patient shifted (base frame, mm) from where he was believed."""
    T_true = plan.T_base_ct.copy()
    T_true[:3, 3] += shift
    q = np.concatenate([plan.approach.q, plan.insertion.q])
    flange = flange_pose(ur_model("ur3"), q)
    T_ct_flange = np.linalg.inv(T_true) @ flange
    tip = T_ct_flange[:, :3, 3] + plan.needle_length_mm * T_ct_flange[:, :3, 2]
    error = tip[-1] - plan.target_ct
    depth = float(-error @ plan.outward_ct)
    samples = np.linspace(total_s / 2, total_s, 10)
    return SimpleNamespace(
        seed=7,
        truth_source="a shift",
        T_base_ct_true=T_true,
        times_s=np.linspace(0, total_s, len(q)),
        q=q,
        q_command=q,
        phase=np.array(["approach"] * 20 + ["insertion"] * (len(q) - 20)),
        T_base_flange_true=flange,
        tip_true_ct=tip,
        clearance_times_s=samples,
        clearance_mm={"rib_right_9": np.linspace(30, 5, 10), "aorta": np.full(10, 20.0)},
        contacts=(SimpleNamespace(time_s=0.5, link="forearm", body="patient", depth_mm=0.4),),
        max_joint_speed=np.full(6, 0.8),
        speed_limits=np.full(6, np.pi),
        tip_error_mm=float(np.linalg.norm(error)),
        lateral_mm=float(np.linalg.norm(error + depth * plan.outward_ct)),
        depth_mm=depth,
        predicted_error_mm=1.25,
        target_true_ct=plan.target_ct,
        truth_is_belief=False,
        followed_text="with a spring at the tip (impedance), at most 0.010 mm off its commanded path",
        force_text="no force of tissue: the case declares no [tissue]",
        standing=None,
    )


def make_registration():
    """Plain values as the main job hands them over."""
    return {
        "method": "rigid",
        "residual_mm": {"A": 0.31, "B": 0.42, "C": 0.17},
        "fre_mm": 0.345,
        "mean_error_mm": 0.333,
        "fle_mm": 0.5,
        "fle_source": "stated",
        "spread_ratio": 0.15,
        "altitude_mm": 25.0,
        "leverage": 2.5,
        "expected_tre_target_mm": 1.31,
        "flags": ["markers nearly in one line"],
    }


def make_page(path):
    """The whole page of this patient: a plan, a rehearsal, slices; returns its candidates."""
    case = make_case()
    candidates, anatomy = make_candidates(case), make_anatomy()
    anatomy.scan = make_scan()
    plan, subject = make_plan(case, candidates), Subject(case, anatomy, candidates.best, REGION)
    regions = np.where(candidates.safe[:, None, None], REGION, np.nan)
    parts = (case, anatomy, candidates, plan, make_rehearsal(plan), make_registration())
    page.write_page(page.Shown(*parts, film="rehearsal.mp4", subject=subject, regions_ct=regions), path)
    return candidates


REGION = np.diag([4.0, 9.0, 16.0])


def make_scan(*, spacing=(2.0, 2.5, 3.0), axes=((1, 0, 0), (0, 1, 0), (0, 0, 1))):
    """A CT whose every voxel has another value than those beside it, from the lungs' to the bones'; air about it.

    Its middle is the target; ``axes`` are the columns along which its indices grow.
    """
    shape = np.ceil(300 / np.array(spacing)).astype(int)
    T = np.eye(4)
    T[:3, :3] = np.array(axes) * spacing
    T[:3, 3] = TARGET - T[:3, :3] @ (150.0 / np.array(spacing))
    rng = np.random.default_rng(0)
    index = np.stack(np.indices(shape), axis=-1)
    far = np.linalg.norm(index @ T[:3, :3].T + T[:3, 3] - TARGET, axis=-1)
    hu = np.where(far < SKIN_RADIUS, rng.integers(-200, 300, shape), -1000).astype(np.int16)

    def hu_at(points):
        return nearest(hu, np.linalg.inv(T), points)

    return SimpleNamespace(hu_at=hu_at, measured=(hu, T), grid=SimpleNamespace(shape=hu.shape, T_ct_index=T))


NOISY_BYTES = 104_000
"""For `make_noisy_scan`: a byte for 7 voxels of a millimetre, as a page has it for a box of 230 mm."""


def make_noisy_scan():
    """A CT of 0.7 mm with 20 HU of noise: soft tissue in shells of 40 HU more and less, 10 mm each, and air."""
    shape, T = (130, 130, 88), np.diag([0.7, 0.7, 1.0, 1.0])
    T[:3, 3] = TARGET - [45.5, 45.5, 44.0]

    def quiet(points):
        far = np.linalg.norm(points - TARGET, axis=-1)
        return np.where(far < SKIN_RADIUS, 40.0 + 40.0 * (far // 10 % 2), -1000.0)

    index = np.stack(np.indices(shape), axis=-1)
    noise = np.random.default_rng(0).normal(0.0, 20.0, shape)
    hu = np.round(quiet(index @ T[:3, :3].T + T[:3, 3]) + noise).astype(np.int16)
    grid = SimpleNamespace(shape=hu.shape, T_ct_index=T)
    back = np.linalg.inv(T)
    return SimpleNamespace(hu_at=lambda points: nearest(hu, back, points), measured=(hu, T), grid=grid, quiet=quiet)


def _ball(radius, centre, subdivisions=3):
    mesh = trimesh.creation.icosphere(subdivisions, radius)
    return TriangleMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def rays(camera):
    """Unit rays through the middles of a camera's samples, shape (h * w, 3), CT frame."""
    rows, columns = (g.ravel() for g in np.mgrid[0 : camera.height, 0 : camera.width])
    x, y = (columns + 0.5 - camera.width / 2) / camera.scale, (camera.height / 2 - rows - 0.5) / camera.scale
    along = np.stack([x, y, np.ones_like(x)], axis=1) @ camera.axes
    return along / np.linalg.norm(along, axis=1)[:, None]


def samples(layer, camera, most=1):
    """Depths along the rays, mm, infinite for nothing, and triangles, each (most, h, w), nearest first."""
    view, size = View(layer, camera), (camera.height, camera.width)
    drawn = Drawn.empty(most, size)
    draw(*view.look[:3], view.spans, view.grid, (0, 0), np.zeros(size, dtype=np.float32), *drawn)
    slant = 1.0 / (rays(camera) @ camera.axes[2]).reshape(size)
    with np.errstate(divide="ignore"):
        return slant / drawn.inverse, drawn.triangle


def no_scene(*_):
    """In the place of `scene_figure`, which takes most of a page's time."""
    return {}


def page_text(folder, *parts, **others):
    """The page of these parts, without its scene."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page, "scene_figure", no_scene)
        page.write_page(page.Shown(*parts, **others), folder / "page.html")
    return (folder / "page.html").read_text(encoding="utf-8")


def map_image(candidates, case):
    """The map as it is drawn."""
    file = io.BytesIO()
    map_figure(candidates, case).savefig(file, format="png")
    return Image.open(file).convert("RGB")


def unpacked_bytes(block):
    """The bytes of a block of the CT that is packed with loss, shape (nz, ny, nx), as Pillow decodes it."""
    at, found, (nx, ny, _) = 0, [], block.facts["shape"]
    for size, count, _ in block.facts["strips"]:
        rows = np.asarray(Image.open(io.BytesIO(block.content[at : at + size])))
        found.append(rows.reshape(count, block.facts["rows"], nx)[:, :ny])
        at += size
    return np.concatenate(found)


def block_pose(block):
    """Index to mm of a block, 4 x 4."""
    return np.vstack([np.reshape(block.facts["T"], (3, 4)), [0, 0, 0, 1]])
