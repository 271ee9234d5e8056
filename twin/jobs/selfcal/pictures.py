"""Pictures of a self-calibration: B-mode pictures with what was detected, and both arms about the phantom."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Circle
from PIL import Image, ImageDraw

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import visual_links
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound import pose_choice
from puncture_twin.twin.guidance.ultrasound.needle_detector import Detection, Imager
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.plant.bmode_image import NeedleInImage
from puncture_twin.twin.rehearsal.selfcal_trial import Puncture, SelfcalTrial, puncture_image
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.annotate import write, write_image
from puncture_twin.twin.report.figures import cross, figure_of, ring, write_png
from puncture_twin.twin.report.raster.camera import camera_around
from puncture_twin.twin.report.raster.render import Layer, Surface, picture
from puncture_twin.twin.report.scene.scene_parts import bar

PX_PER_MM = 8  # of the sheet
MARGIN, CAPTION, LEGEND, COLUMNS = 14, 58, 40, 3  # pixels about a picture, below it, below all; side by side
MARKED_MM = 14.0  # of the detected shaft that is marked
TARGET_MM = 2.0  # radius of the ring about a target
DETECTED: Rgb = (86, 220, 255)
TRUE: Rgb = (255, 214, 64)
TARGET: Rgb = (255, 96, 96)
DARK = ("#0082af", "#be8c00", "#c82828")  # the same on white
WORKCELL_SIZE = (1180, 720)
OPACITY = 0.45  # opacity of the phantom, so that the needle shows in it


class Panel(NamedTuple):
    """One picture of the sheet with its marks."""

    picture: Pixels
    title: str
    text: str
    detection: Detection | None
    true: NeedleInImage
    target: Floats | None = None


def detection_sheet(case: SelfcalCase, trial: SelfcalTrial, path: Path) -> Path:
    """Six pictures: three detections from best to worst, what was set aside or missed, and two punctures."""
    rng = np.random.default_rng([trial.seed, 1])
    panels = [*_recorded_panels(trial), *_puncture_panels(case, trial, rng)]
    imager = case.content.image.imager()
    width, height = (PX_PER_MM * (side + imager.pixel_mm) for side in imager.size_mm)
    sheet_width, rows = width + 2 * MARGIN, -(-len(panels) // COLUMNS)
    high = height + CAPTION + 2 * MARGIN
    size = (round(COLUMNS * sheet_width), round(rows * high + LEGEND))
    figure = figure_of(*size)
    for i, panel in enumerate(panels):
        left, top = (i % COLUMNS) * sheet_width + MARGIN, (i // COLUMNS) * high + MARGIN
        at = (left / size[0], 1 - (top + height) / size[1], width / size[0], height / size[1])
        _draw_panel(figure.add_axes(at), panel, imager)
    marks = (
        Line2D([], [], marker="o", ms=16, mfc="none", mew=2, color=DARK[0], label="ring, lines: detected tip, shaft"),
        Line2D([], [], marker="x", ms=10, mew=2, ls="none", color=DARK[1], label="cross: true tip"),
        Line2D([], [], marker="o", ms=16, mfc="none", mew=2, ls="none", color=DARK[2], label="ring of 2 mm: target"),
    )
    figure.legend(handles=marks, loc="lower left", ncols=3, fontsize=15, frameon=False)
    write_png(figure, path)
    return path


def _recorded_panels(trial: SelfcalTrial) -> list[Panel]:
    taken, panels = trial.acquisition, []
    errors = np.linalg.norm(trial.detection_errors()[:, :2], axis=1)
    order = np.argsort(errors)
    for i, what in ((order[0], "best detection"), (order[len(order) // 2], "median"), (order[-1], "worst")):
        shot = taken.shots[i]
        needle = trial.shown[shot.number].needle
        assert isinstance(shot.found, Detection)  # only those are kept as shots
        steep = np.degrees(np.arcsin(abs(needle.direction_image[1])))
        text = f"insertion {steep:.0f}°, off the plane {needle.tip_image[2]:+.2f} mm".replace("-", "−")
        panels.append(Panel(shot.image, f"{what}: tip {errors[i]:.2f} mm off", text, shot.found, needle))
    if taken.missed_shots:
        shot = taken.missed_shots[0]
        panels.append(Panel(shot.image, "not used", str(shot.found), None, trial.shown[shot.number].needle))
    return panels


def _puncture_panels(case: SelfcalCase, trial: SelfcalTrial, rng: np.random.Generator) -> list[Panel]:
    def panel(one: Puncture) -> Panel:
        title = f"puncture: {one.error_mm:.2f} mm from the target"
        text = f"lateral {one.lateral_mm:.2f} mm, depth {one.depth_mm:+.2f} mm".replace("-", "−")
        return Panel(puncture_image(case, one, rng), title, text, None, one.needle, one.target_image)

    order = sorted(trial.punctures, key=lambda one: one.error_mm)
    wanted = 2 if trial.acquisition.missed_shots else 3
    return [panel(one) for one in [*order[:1], *order[1:][-(wanted - 1) :]]]


def _draw_panel(axes: Axes, panel: Panel, imager: Imager) -> None:
    """The picture in mm, its marks (what lies beyond it is cut off), its scale, and its title and text below."""
    (width, depth), half = imager.size_mm, 0.5 * imager.pixel_mm
    axes.set_axis_off()
    extent = (-half, width + half, depth + half, -half)
    axes.imshow(panel.picture, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="bicubic", aspect="auto")
    axes.set_autoscale_on(False)
    if panel.detection is not None:
        tip, direction = panel.detection.tip_image, panel.detection.direction_image
        for side in (-1.2, 1.2):  # beside the shaft, so that it stays visible
            start = tip + side * np.array([-direction[1], direction[0]])
            axes.plot(*np.stack([start, start - MARKED_MM * direction]).T, color=css(DETECTED), linewidth=1)
        ring(axes, tip, 9, DETECTED)
    cross(axes, panel.true.tip_image[:2], 5, TRUE, "x")
    if panel.target is not None:
        u, v = panel.target[:2].tolist()
        axes.add_patch(Circle((u, v), TARGET_MM, fill=False, color=css(TARGET), linewidth=2))
    axes.plot((1.0, 11.0), (depth - 1.5, depth - 1.5), color="white", linewidth=3)
    axes.text(12.0, depth - 1.5, "10 mm", color="white", fontsize=13, va="center")
    for text, below, look in ((panel.title, 6, {"fontsize": 18, "weight": "bold"}), (panel.text, 30, {"fontsize": 15})):
        axes.annotate(text, (0, 0), (0, -below), "axes fraction", textcoords="offset points", va="top", **look)


def workcell_picture(case: SelfcalCase, q_probe: Floats, q_needle: Floats, path: Path) -> Path:
    """Both arms at one pose, by the drawing."""
    opaque, veiled = workcell_surfaces(case, q_probe, q_needle)
    points = np.concatenate([s.mesh.vertices for s in opaque[1:]])
    toward, up = np.array([0.25, 1.0, -0.45]), np.array([0.0, 0.0, 1.0])
    camera = camera_around(points, toward, up, fov=0.5, width=WORKCELL_SIZE[0], height=WORKCELL_SIZE[1])
    image = Image.fromarray(picture(Layer(opaque), Layer(veiled), camera))
    draw = ImageDraw.Draw(image)
    anchors = {
        f"probe arm ({case.content.probe_arm.model})": np.array([0.0, 0.0, 0.0]),
        f"needle arm ({case.content.needle_arm.model})": case.T_base1_base2[:3, 3],
        "tissue phantom": np.array(case.content.phantom.top_mm) - [0.0, 0.0, case.content.phantom.size_mm[2]],
    }
    for text, point in anchors.items():
        column, row, _ = camera.project(point[None])[0]
        write(draw, (column, row + 26), text, size=17, bold=True, anchor="mm", halo=3)
    write_image(image, path)
    return path


def workcell_surfaces(case: SelfcalCase, q_probe: Floats, q_needle: Floats) -> tuple[list[Surface], list[Surface]]:
    """Table, arms, probe and needle; and, see-through, the phantom and the slice. base1, mm."""
    table, (width, depth) = pose_choice.table_box(case.content.phantom), case.content.image.imager().size_mm
    T1, T2 = link_poses(case.models[0], q_probe), case.T_base1_base2 @ link_poses(case.models[1], q_needle)
    opaque = [Surface(box(table.T_base_box, table.size_mm), palette.TABLE)]
    for model, poses in zip(case.models, (T1, T2), strict=True):
        opaque += [Surface(link.mesh.transformed(poses[link.frame]), palette.ARM) for link in visual_links(model)]
    handle, tool, end2 = pose_choice.probe_tool(case), pose_choice.needle_tool(case), T2[6]
    shaft = _cylinder(end2, tool.holder_length_mm, tool.needle_length_mm, max(tool.needle_diameter_mm, 3.0))
    T_head = T1[6] @ pose_choice.head_pose(case, case.T_end1_image)
    opaque += [
        Surface(_cylinder(T1[6], 0.0, handle.needle_length_mm, handle.holder_diameter_mm), (235, 236, 240)),
        Surface(box(T_head, case.content.probe.head_mm), (90, 110, 150)),
        Surface(_cylinder(end2, 0.0, tool.holder_length_mm, tool.holder_diameter_mm), palette.HOLDER),
        Surface(shaft, palette.NEEDLE),
    ]
    T_slice = pose(np.eye(3), [width / 2.0, depth / 2.0, 0.0])
    slab = box(T1[6] @ case.T_end1_image @ T_slice, (width, depth, 0.6))
    return opaque, [
        Surface(pose_choice.phantom_mesh(case.content.phantom), palette.SKIN, OPACITY),
        Surface(slab, (86, 180, 233), 0.55, 0.0),
    ]


def _cylinder(T: Floats, low: float, high: float, diameter_mm: float) -> TriangleMesh:
    start, end = T[:3, 3] + low * T[:3, 2], T[:3, 3] + high * T[:3, 2]
    return bar(start, end, diameter_mm / 2.0)
