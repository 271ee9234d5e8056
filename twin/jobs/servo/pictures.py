"""Pictures of a session: the workcell through each camera, and how the servo came to rest."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.twin.guidance.stereo.ball.ball_image import render
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.detection import LocatedPair, ball_scene
from puncture_twin.twin.guidance.stereo.session import Reached, Session
from puncture_twin.twin.report.annotate import INK, write, write_image
from puncture_twin.twin.report.figures import halo, write_png
from puncture_twin.twin.world.workcell import load_ball, open_workcell, pinhole_picture

BALL, TARGET, MARKER = (214, 96, 0), (0, 120, 60), (30, 80, 200)
"""Colours of what is drawn over the picture."""

WIDTH_PX = 1280
"""Of the pictures that are written, whatever the camera's size."""

INSET_HALF_PX = 24
INSET_SCALE = 6
"""The inset shows so many camera pixels to each side of the ball, so many times enlarged."""

DOWN = np.array([0.0, 0.0, -1.0])


def draw_cameras(session: Session, path_of: Path) -> list[Path]:
    """Write ``camera_1.png``, ``camera_2.png``: the first target's end, as each camera sees it; returns the paths."""
    reached = next((one for one in session.reached if one.servoed.visits), session.reached[0])
    paths = []
    for number, camera in enumerate(session.workcell.cameras):
        picture = Image.fromarray(_workcell_picture(session, reached, camera))
        scale = WIDTH_PX / camera.width
        picture = picture.resize((WIDTH_PX, round(camera.height * scale)), Image.Resampling.LANCZOS)
        _annotate(picture, session, reached, number, scale)
        path = path_of / f"camera_{number + 1}.png"
        write_image(picture, path)
        paths.append(path)
    return paths


def _workcell_picture(session: Session, reached: Reached, camera: Camera) -> NDArray[np.uint8]:
    """The true room by PyBullet, through the camera without its lens's distortion."""
    workcell, file = session.workcell, session.workcell.case.file
    T_base_c = np.linalg.inv(workcell.T_c_base)
    tool = Tool(file.tool.rod_mm, file.tool.rod_mm - file.tool.holder_mm, file.tool.rod_diameter_mm,
                file.tool.holder_diameter_mm)  # fmt: skip
    boxes = [Box(box.name, pose(np.eye(3), box.center_mm), box.size_mm) for box in file.box]
    with open_workcell(
        workcell.model, tool, workcell.case.skin, T_base_c @ workcell.T_c_m, boxes, down_ct=DOWN
    ) as simulated:
        simulated.arm.place(reached.servoed.q_true)
        flange = simulated.arm.flange_pose()
        load_ball(simulated.client, flange[:3, 3] + file.tool.rod_mm * flange[:3, 2], file.tool.ball_diameter_mm / 2,
                  (0.95, 0.5, 0.1, 1.0))  # fmt: skip
        for marker in apply(T_base_c, workcell.markers_c):
            load_ball(simulated.client, marker, file.head.marker_diameter_mm / 2, (0.2, 0.4, 0.9, 1.0))
        return pinhole_picture(
            simulated.client, (camera.width, camera.height), camera.K, camera.T_camera_c @ workcell.T_c_base
        )


def _annotate(picture: Image.Image, session: Session, reached: Reached, number: int, scale: float) -> None:
    draw, workcell = ImageDraw.Draw(picture), session.workcell
    camera, believed = workcell.cameras[number].pinhole(), session.calibration.cameras[number].pinhole()
    for name, marker in zip(
        workcell.case.markers.names, session.mapping.to_c(workcell.case.markers.points), strict=True
    ):
        _ring(draw, believed.project(marker) * scale, 16, MARKER, name)
    for target, point in zip(workcell.case.targets.names, workcell.targets_c, strict=True):
        _cross(draw, camera.project(point) * scale, TARGET, 9 if target == reached.target else 3)
    if reached.servoed.visits:
        _ring(draw, believed.project(reached.servoed.visits[-1].seen.ball_c) * scale, 18, BALL, "")
    lines = (
        (f"camera {number + 1}: {workcell.case.name}, seed {session.seed}, at the end of target {reached.target}", INK),
        ("orange ring: ball as measured", BALL),
        ("green cross: true targets, the large one served now", TARGET),
        ("blue rings: markers where the mapping has them", MARKER),
        ("the room is drawn for looking at, without the lens's distortion", INK),
    )
    for row, (text, colour) in enumerate(lines):
        write(draw, (16, 14 + 24 * row), text, size=17, bold=row == 0, colour=colour, halo=3)
    if reached.servoed.visits:
        _inset(picture, session, reached, number)


def _ring(draw: ImageDraw.ImageDraw, at: Floats, radius: float, colour: Rgb, text: str) -> None:
    x, y = (float(v) for v in at)
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=colour, width=3)
    if text:
        write(draw, (x + radius + 4, y), text, size=15, colour=colour, anchor="lm", halo=3)


def _cross(draw: ImageDraw.ImageDraw, at: Floats, colour: Rgb, size: float) -> None:
    x, y = (float(v) for v in at)
    draw.line([(x - size, y), (x + size, y)], fill=colour, width=2)
    draw.line([(x, y - size), (x, y + size)], fill=colour, width=2)


def _inset(picture: Image.Image, session: Session, reached: Reached, number: int) -> None:
    """What is really measured: the analytic picture of the ball, enlarged, with the outline that was found."""
    workcell, tool = session.workcell, session.workcell.case.file.tool
    camera, believed = workcell.cameras[number], session.calibration.cameras[number]
    seen, plan = reached.servoed.visits[-1].seen.ball_c, workcell.case.file.cameras
    q_true, rng = reached.servoed.q_true, np.random.default_rng(session.seed)
    ball = LocatedPair(workcell.ball_c(q_true), tool.ball_diameter_mm / 2, workcell.rod_c(q_true))
    half = round(INSET_HALF_PX * camera.width / WIDTH_PX)
    grey = render(
        camera, ball_scene(plan, ball, 0.0, rng), rng=rng, noise=plan.noise_grey, blur_px=plan.blur_px, half_px=half
    )
    side = INSET_SCALE * 2 * INSET_HALF_PX
    zoom = side / grey.grey.shape[1]
    inset = Image.fromarray(grey.grey).convert("RGB").resize((side, side), Image.Resampling.NEAREST)
    x, y = (believed.project(seen) - np.array(grey.offset) + 0.5) * zoom
    radius = believed.ball_radius_px(seen, ball.radius_mm) * zoom
    draw = ImageDraw.Draw(inset)
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], outline=BALL, width=2)
    _cross(draw, np.array([x, y]), BALL, 6)
    corner = (picture.width - side - 16, picture.height - side - 16)
    picture.paste(inset, corner)
    text = f"what is measured, x{zoom:.1f}"
    write(ImageDraw.Draw(picture), (corner[0], corner[1] - 8), text, size=15, colour=BALL, anchor="lb", halo=3)


def draw_convergence(session: Session, path: Path) -> None:
    """Write the plot: true distance from ball to estimated target at each look, and what the cameras saw."""
    figure = Figure(figsize=(9.0, 5.2), dpi=120, layout="constrained")
    axes = figure.add_subplot()
    axes.set_prop_cycle(color=[colormaps["tab20"](k) for k in range(20)])
    longest = 1
    for one in session.reached:
        visits = one.servoed.visits
        if not visits:
            continue
        true = [np.linalg.norm(session.workcell.ball_c(v.q_true) - v.seen.target_c) for v in visits]
        looks = np.arange(len(visits))
        longest = max(longest, len(visits) - 1)
        (line,) = axes.plot(looks, true, "-", linewidth=1.2, label=one.target)
        axes.plot(looks, one.servoed.errors_mm, "o", color=line.get_color(), markersize=4)
    _finish(axes, session, longest)
    write_png(figure, path)


def _finish(axes: Axes, session: Session, longest: int) -> None:
    tolerance = session.workcell.case.file.servo.tolerance_mm
    axes.axhline(tolerance, color="#d6001e", linewidth=1)
    text, look = f"tolerance {tolerance:g} mm", {"ha": "right", "va": "bottom"}
    axes.text(longest, tolerance, text, look, color="#d6001e", path_effects=halo(3))
    axes.set_yscale("log")
    for axis_format in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        axis_format("{x:g}")
    axes.set_xticks(range(longest + 1))
    axes.set_xlabel("corrections driven (0: the robot alone)")
    axes.set_ylabel("ball to estimated target, mm")
    axes.set_title("lines: true distance; dots: as the cameras saw it")
    axes.grid(visible=True, which="both", color="#e4e6ea", linewidth=0.6)
    axes.legend(fontsize=8, title="target", loc="upper left", bbox_to_anchor=(1.01, 1.0))
