"""What a person looks at: B-mode pictures with what was detected, and both arms about the phantom."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import visual_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.acquisition import Acquisition, ProbeShot
from puncture_twin.twin.guidance.ultrasound.image.needle_detector import Detection
from puncture_twin.twin.guidance.ultrasound.image.probe_image import Imager, NeedleInImage
from puncture_twin.twin.guidance.ultrasound.puncture import Puncture, puncture_image
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.summaries import SelfcalTrial
from puncture_twin.twin.guidance.ultrasound.two_arms import head_pose, needle_tool, phantom_mesh, probe_tool, table_box
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.annotate import width_of, write, write_image
from puncture_twin.twin.report.raster.camera import camera_around
from puncture_twin.twin.report.raster.compositing import compose
from puncture_twin.twin.report.raster.render import Layer, Surface, opaque_shot, shells_of
from puncture_twin.twin.report.scene.shapes import bar

PX_PER_MM = 8
"""Of the sheet."""

MARGIN, CAPTION = 14, 58
"""Pixels about a picture and below it."""

MARKED_MM = 14.0
"""Of the detected shaft that is marked."""

TARGET_MM = 2.0
"""Radius of the ring about a target."""

DETECTED: Rgb = (86, 220, 255)
TRUE: Rgb = (255, 214, 64)
TARGET: Rgb = (255, 96, 96)
WORKCELL_SIZE = (1180, 720)
OPACITY = 0.45
"""Opacity of the phantom, so that the needle shows in it."""


class Panel(NamedTuple):
    """One picture of the sheet with its marks."""

    picture: Pixels
    title: str
    text: str
    found: Detection | None
    true: NeedleInImage
    target: Floats | None = None


def detection_sheet(case: SelfcalCase, trial: SelfcalTrial, path: Path) -> Path:
    """Six pictures: three detections from best to worst, what was set aside or missed, and two punctures."""
    rng = np.random.default_rng([trial.seed, 1])
    panels = [*_recorded_panels(trial), *_puncture_panels(case, trial, rng)]
    imager = case.content.image.imager()
    columns = 3
    width, height = (int(PX_PER_MM * (side + imager.pixel_mm)) for side in imager.size_mm)
    cell = (width + 2 * MARGIN, height + CAPTION + 2 * MARGIN)
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * cell[0], rows * cell[1] + 40), (255, 255, 255))
    draw = ImageDraw.Draw(sheet)
    for i, panel in enumerate(panels):
        corner = ((i % columns) * cell[0] + MARGIN, (i // columns) * cell[1] + MARGIN)
        _draw_panel(sheet, draw, panel, imager, corner, (width, height))
    _draw_legend(draw, rows * cell[1])
    write_image(sheet, path)
    return path


def _recorded_panels(trial: SelfcalTrial) -> list[Panel]:
    taken = trial.acquisition
    errors = np.linalg.norm(taken.detection_errors()[:, :2], axis=1)
    order = np.argsort(errors)
    chosen = [(order[0], "best detection"), (order[len(order) // 2], "median"), (order[-1], "worst")]
    panels = [_shot_panel(taken, int(i), f"{what}: tip {errors[i]:.2f} mm off") for i, what in chosen]
    if taken.missed_shots:
        shot = taken.missed_shots[0]
        panels.append(Panel(shot.image, "not used", str(shot.found), None, shot.true_needle))
    return panels


def _shot_panel(taken: Acquisition, index: int, title: str) -> Panel:
    shot: ProbeShot = taken.shots[index]
    assert isinstance(shot.found, Detection)  # only those are kept as shots
    steep = np.degrees(np.arcsin(abs(shot.true_needle.direction_image[1])))
    text = f"insertion {steep:.0f}°, off the plane {shot.true_needle.tip_image[2]:+.2f} mm"
    return Panel(shot.image, title, text.replace("-", "−"), shot.found, shot.true_needle)


def _puncture_panels(case: SelfcalCase, trial: SelfcalTrial, rng: np.random.Generator) -> list[Panel]:
    def panel(one: Puncture) -> Panel:
        title = f"puncture: {one.error_mm:.2f} mm from the target"
        text = f"lateral {one.lateral_mm:.2f} mm, depth {one.depth_mm:+.2f} mm".replace("-", "−")
        return Panel(puncture_image(case, one, rng), title, text, None, one.needle, one.target_image)

    order = sorted(trial.punctures, key=lambda one: one.error_mm)
    wanted = 2 if trial.acquisition.missed_shots else 3
    return [panel(one) for one in [*order[:1], *order[1:][-(wanted - 1) :]]]


def _draw_panel(
    sheet: Image.Image,
    draw: ImageDraw.ImageDraw,
    panel: Panel,
    imager: Imager,
    corner: tuple[int, int],
    size: tuple[int, int],
) -> None:
    picture = Image.fromarray(panel.picture).resize(size, Image.Resampling.BICUBIC).convert("RGB")
    _draw_marks(ImageDraw.Draw(picture), panel, imager)
    sheet.paste(picture, corner)
    below = corner[1] + size[1] + 6
    write(draw, (corner[0], below), panel.title, size=18, bold=True)
    write(draw, (corner[0], below + 24), panel.text, size=15)
    bar_y = corner[1] + size[1] - 12
    draw.line([(corner[0] + 10, bar_y), (corner[0] + 10 + 10 * PX_PER_MM, bar_y)], fill=(255, 255, 255), width=3)
    write(draw, (corner[0] + 16 + 10 * PX_PER_MM, bar_y), "10 mm", size=13, colour=(255, 255, 255), anchor="lm")


def _draw_marks(draw: ImageDraw.ImageDraw, panel: Panel, imager: Imager) -> None:
    """Detected shaft and tip, true tip, target; what lies beyond the picture is cut off."""

    def at(point: Floats) -> tuple[float, float]:
        x, y = (np.asarray(point) + 0.5 * imager.pixel_mm) * PX_PER_MM
        return float(x), float(y)

    if panel.found is not None:
        tip, direction = panel.found.tip_image, panel.found.direction_image
        for side in (-1.2, 1.2):  # beside the shaft, so that it stays visible
            start = tip + side * np.array([-direction[1], direction[0]])
            draw.line([at(start), at(start - MARKED_MM * direction)], fill=DETECTED, width=1)
    _cross(draw, at(panel.true.tip_image[:2]), TRUE)
    if panel.target is not None:
        _ring(draw, at(panel.target[:2]), TARGET_MM * PX_PER_MM, TARGET)
    if panel.found is not None:
        _ring(draw, at(panel.found.tip_image), 9, DETECTED)


def _cross(draw: ImageDraw.ImageDraw, at: tuple[float, float], colour: Rgb) -> None:
    x, y = at
    for dx, dy in ((5, 5), (5, -5)):
        draw.line([(x - dx, y - dy), (x + dx, y + dy)], fill=colour, width=2)


def _ring(draw: ImageDraw.ImageDraw, at: tuple[float, float], radius: float, colour: Rgb) -> None:
    x, y = at
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=colour, width=2)


def _draw_legend(draw: ImageDraw.ImageDraw, top: int) -> None:
    x, y = MARGIN + 10.0, top + 16.0
    dark = {DETECTED: (0, 130, 175), TRUE: (190, 140, 0), TARGET: (200, 40, 40)}
    items = (
        (DETECTED, "ring and lines: detected tip and shaft"),
        (TRUE, "cross: true tip"),
        (TARGET, "ring of 2 mm radius: target"),
    )
    for colour, text in items:
        if colour == TRUE:
            _cross(draw, (x, y), dark[colour])
        else:
            _ring(draw, (x, y), 8, dark[colour])
        write(draw, (x + 16, y), text, size=15, anchor="lm")
        x += 60 + width_of(text, 15)


def workcell_picture(case: SelfcalCase, q_probe: Floats, q_needle: Floats, path: Path) -> Path:
    """Both arms at one pose, by the drawing."""
    opaque, veiled = workcell_surfaces(case, q_probe, q_needle)
    points = np.concatenate([s.mesh.vertices for s in opaque[1:]])
    toward, up = np.array([0.25, 1.0, -0.45]), np.array([0.0, 0.0, 1.0])
    camera = camera_around(points, toward, up, fov=0.5, width=WORKCELL_SIZE[0], height=WORKCELL_SIZE[1])
    fine = camera.finer(2)
    pixels = compose(opaque_shot(Layer(opaque), fine), shells_of(Layer(veiled), fine))
    picture = Image.fromarray(np.ascontiguousarray(pixels))
    if picture.size != WORKCELL_SIZE:
        picture = picture.resize(WORKCELL_SIZE, Image.Resampling.LANCZOS)
    draw = ImageDraw.Draw(picture)
    anchors = {
        f"probe arm ({case.content.probe_arm.model})": np.array([0.0, 0.0, 0.0]),
        f"needle arm ({case.content.needle_arm.model})": case.T_base1_base2[:3, 3],
        "tissue phantom": np.array(case.content.phantom.top_mm) - [0.0, 0.0, case.content.phantom.size_mm[2]],
    }
    for text, point in anchors.items():
        column, row, _ = camera.project(point[None])[0]
        write(draw, (column, row + 26), text, size=17, bold=True, anchor="mm", halo=3)
    write_image(picture, path)
    return path


def workcell_surfaces(case: SelfcalCase, q_probe: Floats, q_needle: Floats) -> tuple[list[Surface], list[Surface]]:
    """Table, arms, probe and needle; and, see-through, the phantom and the slice. base1, mm."""
    table = table_box(case.content.phantom)
    T1 = link_poses(case.models[0], q_probe)
    T2 = case.T_base1_base2 @ link_poses(case.models[1], q_needle)
    opaque = [Surface(box(table.T_base_box, table.size_mm), palette.TABLE)]
    for model, poses in zip(case.models, (T1, T2), strict=True):
        opaque += [Surface(link.mesh.transformed(poses[link.frame]), palette.ARM) for link in visual_links(model)]
    handle, needle = probe_tool(case), needle_tool(case)
    opaque.append(Surface(_cylinder(T1[6], 0.0, handle.needle_length_mm, handle.holder_diameter_mm), (235, 236, 240)))
    opaque.append(Surface(box(T1[6] @ head_pose(case, case.T_end1_image), case.content.probe.head_mm), (90, 110, 150)))
    opaque += _needle_surfaces(T2[6], needle)
    width, depth = case.content.image.imager().size_mm
    T_slice = pose(np.eye(3), [width / 2.0, depth / 2.0, 0.0])
    slab = box(T1[6] @ case.T_end1_image @ T_slice, (width, depth, 0.6))
    return opaque, [
        Surface(phantom_mesh(case.content.phantom), palette.SKIN, OPACITY),
        Surface(slab, (86, 180, 233), 0.55, 0.0),
    ]


def _needle_surfaces(T_base1_end2: Floats, tool: Tool) -> Sequence[Surface]:
    holder = _cylinder(T_base1_end2, 0.0, tool.holder_length_mm, tool.holder_diameter_mm)
    shaft = _cylinder(T_base1_end2, tool.holder_length_mm, tool.needle_length_mm, max(tool.needle_diameter_mm, 3.0))
    return [Surface(holder, palette.HOLDER), Surface(shaft, palette.NEEDLE)]


def _cylinder(T: Floats, low: float, high: float, diameter_mm: float) -> TriangleMesh:
    start, end = T[:3, 3] + low * T[:3, 2], T[:3, 3] + high * T[:3, 2]
    return bar(start, end, diameter_mm / 2.0)
