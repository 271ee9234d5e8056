"""``rehearsal.mp4``: the rehearsal as it happened in the twin, with time, phase and distances written into it.

The patient and the room do not move, so what each view's samples show of them is found once; every frame then draws
the arm over it, and blends only where the arm is.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.twin.report import palette
from puncture_twin.twin.report.numbers import demanding
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.render import Layer, MovingPicture, Surface
from puncture_twin.twin.report.scene.film_text import BELOW, FilmFrames, write_gif, write_mp4
from puncture_twin.twin.report.scene.scene_parts import ArmPicture, SceneBody, bar, needle_bodies, patient, room
from puncture_twin.twin.report.scene.views import close_up, overview

MOST_THREADS = 4  # of those that draw: each takes 40 MB, and the encoder and the words do not keep up with more
WIDTH, HEIGHT = 832, 608  # pixels; multiples of 16, as H.264 likes them
VIEW_WIDTH, VIEW_HEIGHT = 592, HEIGHT - BELOW  # the overview, upper left. Below it stand the numbers
INSET = 240  # side of the close-up, upper right; below it stand the names and the body's directions
FRAMES_PER_SECOND = 15
"""Enough for an arm that takes seconds from pose to pose; each frame costs its drawing and its encoding."""

LONGEST_S = 8.0  # playback is sped up until the motion fits into this time; then the last frame stands still
STILL_S = 2.0
SPEEDS = (0.5, 1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 30, 40, 60, 100, 200, 500)
INSET_RADIUS_MM = 30.0
BODY_MM = 250.0  # what of the body the overview holds, about the target: the patient fills it, and the arm may leave it
ABOVE_MM = 30.0  # of the needle at standoff above its tip
NEEDLE_PIXELS = 4.5  # the needle's width at least, where it stands on the target
PLANNED: Rgb = (0, 158, 115)
PLANNED_RADIUS_MM = 0.7


@dataclass(frozen=True)
class FilmTimes:
    """When each frame is taken: moments of the rehearsal in s, the playback speed, and how many frames stand still."""

    moments: tuple[float, ...]
    speed: float
    still_frames: int

    @property
    def frames(self) -> int:
        """All frames of the film."""
        return len(self.moments) + self.still_frames

    @property
    def duration_s(self) -> float:
        """Of the film."""
        return self.frames / FRAMES_PER_SECOND


def film_times(total_s: float) -> FilmTimes:
    """The frames of a rehearsal that took ``total_s``; the last moving frame shows its end."""
    speed = next((s for s in SPEEDS if total_s / s <= LONGEST_S), SPEEDS[-1])
    count = max(2, int(np.ceil(total_s / speed * FRAMES_PER_SECOND)) + 1)
    moments = np.minimum(np.arange(count) * speed / FRAMES_PER_SECOND, total_s)
    return FilmTimes(tuple(float(m) for m in moments), float(speed), round(STILL_S * FRAMES_PER_SECOND))


def draw_film(rehearsal: Any, plan: Any, case: Any, anatomy: Any, path: Path) -> Path:
    """Write the film, a GIF beside it when no H.264 encoder can be started; returns the file that was written."""
    times = film_times(float(rehearsal.times_s[-1]))
    film, path = _Film.of(rehearsal, plan, case, anatomy, times.speed), Path(path)
    try:
        write_mp4(film.frames(times), film.words.size, path, FRAMES_PER_SECOND)
    except (OSError, RuntimeError):  # no encoder on this machine, or one without H.264
        path = path.with_suffix(".gif")
        write_gif(film.frames(times), path, FRAMES_PER_SECOND)
    return path


class _Film(NamedTuple):
    """The two views, with the links after the base and the tool, and with the tool alone, and the words about them."""

    wide: MovingPicture
    near: MovingPicture
    words: FilmFrames
    poses: Callable[[int], list[Floats]]
    """Of the links after the base, and the tool, T_ct_body, at a record of the rehearsal."""

    @classmethod
    def of(cls, rehearsal: Any, plan: Any, case: Any, anatomy: Any, speed: float) -> _Film:
        """What does not move is drawn here, once."""
        T_base_ct = rehearsal.T_base_ct_true
        arm = ArmPicture(plan.model, T_base_ct)
        base, at_standoff = arm.bodies(rehearsal.q[0])[0], plan.target_ct + plan.standoff_mm * plan.outward_ct
        planned = SceneBody("planned path", "safe", bar(plan.target_ct, at_standoff, PLANNED_RADIUS_MM), PLANNED)
        still = [*patient(anatomy, case), *room(case, T_base_ct), arm.plate, planned]
        organs = Layer([b.surface for b in still if b.alpha >= 1 and b.group in {"organ", "target"}])
        near_by = close_up(case, np.stack([plan.target_ct, plan.entry_ct]), INSET_RADIUS_MM, organs, (INSET, INSET))
        cameras = _wide_camera(case, still, arm, rehearsal, plan), near_by
        wide, near = (_tool_layer(case, camera) for camera in cameras)

        def poses(row: int) -> list[Floats]:
            T_ct_flange = np.linalg.inv(T_base_ct) @ rehearsal.T_base_flange_true[row]
            return [*arm.poses_ct(rehearsal.q[row])[1:], T_ct_flange]

        return cls(
            _moving_picture([*still, base], cameras[0], [*arm.layers[1:], wide]),
            _moving_picture([b for b in still if b.group != "room"], cameras[1], [near]),
            FilmFrames(rehearsal, cameras, case, speed, demanding(anatomy)),
            poses,
        )

    def frames(self, times: FilmTimes) -> Iterator[Pixels]:
        """The frames that move, drawn by as many threads as there are cores while others are encoded; then the last."""
        threads = min(len(os.sched_getaffinity(0)), MOST_THREADS)

        def drawn(moment: float) -> Pixels:
            poses = self.poses(self.words.row(moment))
            return self.words.frame(moment, self.wide.at(poses), self.near.at(poses[-1:]))

        with ThreadPoolExecutor(threads) as pool:
            waiting: deque[Future[Pixels]] = deque()
            for number, moment in enumerate(times.moments):
                waiting.append(pool.submit(drawn, moment))
                while len(waiting) > threads or (waiting and number == len(times.moments) - 1):
                    frame = waiting.popleft().result()
                    yield frame
        yield from repeat(frame, times.still_frames)


def _moving_picture(bodies: list[SceneBody], camera: ViewCamera, layers: Sequence[Layer]) -> MovingPicture:
    opaque, translucent = ([b.surface for b in bodies if (b.alpha >= 1) == solid] for solid in (True, False))
    return MovingPicture(Layer(opaque), Layer(translucent), layers, camera)


def _tool_layer(case: Any, camera: ViewCamera) -> Layer:
    """All that the flange carries, flange frame: the needle points along +z, at least `NEEDLE_PIXELS` wide."""
    tip = np.array([0.0, 0.0, case.needle.length_mm])
    mm_per_pixel = float(camera.project(case.target_ct[None])[0, 2]) / camera.scale
    bodies = needle_bodies(case.needle, tip, np.array([0.0, 0.0, -1.0]), NEEDLE_PIXELS / 2 * mm_per_pixel)
    own = [] if case.tool is None else [Surface(case.tool.mesh, palette.HOLDER)]
    return Layer([*(Surface(b.mesh, b.colour) for b in bodies), *own])


def _wide_camera(case: Any, still: list[SceneBody], arm: ArmPicture, rehearsal: Any, plan: Any) -> ViewCamera:
    """The patient fills the picture, seen from the entry's side, with the needle at its standoff."""
    direction = plan.outward_ct
    focus = plan.target_ct + np.linspace(0, plan.standoff_mm + case.needle.length_mm, 24)[:, None] * direction
    shown = focus[np.linalg.norm(focus - plan.target_ct, axis=1) < plan.standoff_mm + ABOVE_MM]
    skin = [b.mesh.vertices for b in still if b.group == "skin"]
    near = [v[np.linalg.norm(v - plan.target_ct, axis=1) < BODY_MM] for v in skin]
    at_work = [body for q in (plan.insertion.q[0], rehearsal.q[-1]) for body in arm.bodies(q)]
    blockers = Layer([b.surface for b in at_work] + [b.surface for b in still if b.group == "room"])
    return overview(case, np.concatenate([*near, shown]), focus, blockers, (VIEW_WIDTH, VIEW_HEIGHT), direction)
