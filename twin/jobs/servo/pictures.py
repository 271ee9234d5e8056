"""Pictures of a session: the workcell through each camera, and the convergence of the servo."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.twin.guidance.stereo.camera import Camera
from puncture_twin.twin.plant.ball_image import render
from puncture_twin.twin.plant.stereo_workcell import ShownBall, ball_scene
from puncture_twin.twin.rehearsal.stereo_session import Reached, Session
from puncture_twin.twin.report.annotate import INK
from puncture_twin.twin.report.figures import cross, figure_of, halo, picture_axes, ring, write_png
from puncture_twin.twin.world.workcell import load_ball, open_workcell, pinhole_picture

BALL, TARGET, MARKER = (214, 96, 0), (0, 120, 60), (30, 80, 200)  # colours of what is drawn over the picture
WIDTH_PX = 1280  # of the pictures that are written, whatever the camera's size
INSET_HALF_PX = 24
INSET_SCALE = 6  # the inset shows so many camera pixels to each side of the ball, so many times enlarged
DOWN = np.array([0.0, 0.0, -1.0])


def draw_cameras(session: Session, folder: Path) -> list[Path]:
    """Write ``camera_1.png``, ``camera_2.png``: the first target's end, as each camera sees it; returns the paths."""
    reached = next((one for one in session.reached if one.servoed.visits), session.reached[0])
    paths = []
    for number, camera in enumerate(session.workcell.cameras):
        figure = figure_of(WIDTH_PX, round(WIDTH_PX * camera.height / camera.width))
        axes = picture_axes(figure, _workcell_picture(session, reached, camera))
        _annotate(axes, session, reached, number)
        paths.append(folder / f"camera_{number + 1}.png")
        write_png(figure, paths[-1])
    return paths


def _workcell_picture(session: Session, reached: Reached, camera: Camera) -> NDArray[np.uint8]:
    """The true workcell by PyBullet, through the camera without its lens's distortion."""
    workcell, file = session.workcell, session.workcell.case.file
    T_base_c = np.linalg.inv(workcell.T_c_base)
    tool = Tool(file.tool.rod_mm, file.tool.rod_mm - file.tool.holder_mm, file.tool.rod_diameter_mm,
                file.tool.holder_diameter_mm)  # fmt: skip
    boxes = [Box(box.name, pose(np.eye(3), box.center_mm), box.size_mm) for box in file.box]
    with open_workcell(
        workcell.model, tool, workcell.case.skin, T_base_c @ workcell.T_c_m, boxes, down_ct=DOWN
    ) as simulated:
        simulated.arm.place(reached.q_true)
        flange = simulated.arm.flange_pose()
        load_ball(simulated.client, flange[:3, 3] + file.tool.rod_mm * flange[:3, 2], file.tool.ball_diameter_mm / 2,
                  (0.95, 0.5, 0.1, 1.0))  # fmt: skip
        for marker in apply(T_base_c, workcell.markers_c):
            load_ball(simulated.client, marker, file.head.marker_diameter_mm / 2, (0.2, 0.4, 0.9, 1.0))
        return pinhole_picture(
            simulated.client, (camera.width, camera.height), camera.K, camera.T_camera_c @ workcell.T_c_base
        )


def _annotate(axes: Axes, session: Session, reached: Reached, number: int) -> None:
    workcell, at = session.workcell, f"seed {session.trial.seed}, at the end of target {reached.row.target}"
    camera, believed = workcell.cameras[number].pinhole(), session.calibration.cameras[number].pinhole()
    for name, marker in zip(
        workcell.case.markers.names, session.mapping.to_c(workcell.case.markers.points), strict=True
    ):
        ring(axes, believed.project(marker), 16, MARKER, name, 3)
    for target, point in zip(workcell.case.targets.names, workcell.targets_c, strict=True):
        cross(axes, camera.project(point), 9 if target == reached.row.target else 3, TARGET)
    if reached.servoed.visits:
        ring(axes, believed.project(reached.servoed.visits[-1].seen.ball_c), 18, BALL, width=3)
        _inset(axes, session, reached, number)
    lines = (
        (f"camera {number + 1}: {workcell.case.name}, {at}", INK),
        ("orange ring: ball as measured", BALL),
        ("green cross: true targets, the large one served now", TARGET),
        ("blue rings: marker positions by the mapping", MARKER),
        ("the scene is drawn without lens distortion", INK),
    )
    for row, (text, colour) in enumerate(lines):
        place, weight = (16, -14 - 24 * row), "normal" if row else "bold"
        look: dict[str, Any] = {"textcoords": "offset points", "va": "top", "weight": weight, "path_effects": halo(3)}
        axes.annotate(text, (0, 1), place, "axes fraction", fontsize=17, color=css(colour), **look)


def _inset(axes: Axes, session: Session, reached: Reached, number: int) -> None:
    """Draw what the camera measures: the analytic picture of the ball, enlarged, with the outline that was found."""
    workcell, tool = session.workcell, session.workcell.case.file.tool
    camera, believed = workcell.cameras[number], session.calibration.cameras[number]
    seen, plan = reached.servoed.visits[-1].seen.ball_c, workcell.case.file.cameras
    q_true, rng = reached.q_true, np.random.default_rng(session.trial.seed)
    ball = ShownBall(workcell.ball_c(q_true), tool.ball_diameter_mm / 2, workcell.rod_c(q_true))
    half = round(INSET_HALF_PX * camera.width / WIDTH_PX)
    grey = render(
        camera, ball_scene(plan, ball, 0.0, rng), rng=rng, noise=plan.noise_grey, blur_px=plan.blur_px, half_px=half
    )
    side, high = INSET_SCALE * 2 * INSET_HALF_PX, axes.figure.bbox.height
    inset = axes.inset_axes((1 - (side + 16) / WIDTH_PX, 16 / high, side / WIDTH_PX, side / high))
    inset.set_axis_off()
    inset.imshow(grey.grey, cmap="gray", vmin=0, vmax=255)
    at = believed.project(seen) - np.array(grey.offset)
    inset.add_patch(Circle(at, believed.ball_radius_px(seen, ball.radius_mm), fill=False, color=css(BALL), linewidth=2))
    cross(inset, at, 6, BALL)
    text = f"what is measured, x{side / grey.grey.shape[1]:.1f}"
    inset.set_title(text, fontsize=15, color=css(BALL), loc="left", path_effects=halo(3))


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
        true = [
            np.linalg.norm(session.workcell.ball_c(q) - visit.seen.target_c)
            for q, visit in zip(one.rests, visits, strict=True)
        ]
        looks = np.arange(len(visits))
        longest = max(longest, len(visits) - 1)
        (line,) = axes.plot(looks, true, "-", linewidth=1.2, label=one.row.target)
        axes.plot(looks, one.servoed.errors_mm, "o", color=line.get_color(), markersize=4)
    tolerance = session.workcell.case.file.servo.tolerance_mm
    axes.axhline(tolerance, color="#d6001e", linewidth=1)
    text, look = f"tolerance {tolerance:g} mm", {"ha": "right", "va": "bottom"}
    axes.text(longest, tolerance, text, look, color="#d6001e", path_effects=halo(3))
    axes.set_yscale("log")
    for axis_format in (axes.yaxis.set_major_formatter, axes.yaxis.set_minor_formatter):
        axis_format("{x:g}")
    axes.set_xticks(range(longest + 1))
    axes.set(xlabel="corrections (0: the robot alone)", ylabel="ball to estimated target, mm")
    axes.set_title("lines: true distance; dots: as measured by the cameras")
    axes.grid(visible=True, which="both", color="#e4e6ea", linewidth=0.6)
    axes.legend(fontsize=8, title="target", loc="upper left", bbox_to_anchor=(1.01, 1.0))
    write_png(figure, path)
