"""``rehearsal.mp4``: the rehearsal as it happened in the twin, with time, phase and distances written into it.

The patient and the room do not move, so what each view's samples show of them is found once; every frame then draws
the arm over it, and blends only where the arm is.
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from itertools import repeat
from pathlib import Path
from typing import Any, NamedTuple

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw

from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.base.text import plural
from puncture_twin.twin.report import annotate, palette
from puncture_twin.twin.report.numbers import demanding
from puncture_twin.twin.report.present import number
from puncture_twin.twin.report.raster.camera import ViewCamera
from puncture_twin.twin.report.raster.render import Layer, MovingPicture, Surface
from puncture_twin.twin.report.scene import scene_parts
from puncture_twin.twin.report.scene.scene_parts import ArmPicture, SceneBody, bar

MOST_THREADS = 4  # of those that draw: each takes 40 MB, and the encoder and the words do not keep up with more
BELOW = 80  # pixels: height of the numbers below the views
WIDTH, HEIGHT = 832, 608  # pixels; multiples of 16, as H.264 likes them
VIEW_WIDTH, VIEW_HEIGHT = 592, HEIGHT - BELOW  # the overview, upper left. Below it stand the numbers
INSET = 240  # side of the close-up, upper right; below it stand the names and the body's directions
FRAMES_PER_SECOND = 15  # enough for an arm that takes seconds; each frame costs its drawing and encoding
LONGEST_S = 8.0  # playback is sped up until the motion fits into this time; then the last frame stands still
STILL_S = 2.0
SPEEDS = (0.5, 1, 2, 3, 4, 5, 6, 8, 10, 12, 15, 20, 30, 40, 60, 100, 200, 500)
INSET_RADIUS_MM = 30.0
BODY_MM = 250.0  # what of the body the overview holds, about the target: the patient fills it, and the arm may leave it
ABOVE_MM = 30.0  # of the needle at standoff above its tip
NEEDLE_PIXELS = 4.5  # the needle's width at least, where it stands on the target
PLANNED: Rgb = (0, 158, 115)
PLANNED_RADIUS_MM = 0.7
SAME_BYTES = ("-threads", "4", "-filter_threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact",
              "-sws_flags", "bitexact+accurate_rnd")  # fmt: skip
"""x264 writes other bytes for another number of threads, and left alone it takes as many as there are cores."""
QUALITY = ("-crf", "20", "-preset", "veryfast", "-movflags", "+faststart")


@dataclass(frozen=True)
class FilmTimes:
    """Times of the frames: moments of the rehearsal in s, the playback speed, and how many frames stand still."""

    moments: tuple[float, ...]
    speed: float
    still_frames: int

    @property
    def frames(self) -> int:
        """Number of frames of the film."""
        return len(self.moments) + self.still_frames

    @property
    def duration_s(self) -> float:
        """Duration of the film."""
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
        images = [Image.fromarray(frame).quantize(128) for frame in film.frames(times)]
        look: dict[str, Any] = {"save_all": True, "loop": 0, "duration": 1000 // FRAMES_PER_SECOND}
        with atomic(path) as temporary:
            images[0].save(temporary, format="GIF", append_images=images[1:], **look)
    return path


class _Film(NamedTuple):
    """The two views of a film, with the moving links and the tool, and with the tool alone, and the text about them."""

    wide: MovingPicture
    near: MovingPicture
    words: FilmFrames
    poses: Callable[[int], list[Floats]]
    """T_ct_body of the links after the base, and of the tool, at a record of the rehearsal."""

    @classmethod
    def of(cls, rehearsal: Any, plan: Any, case: Any, anatomy: Any, speed: float) -> _Film:
        """The film of a rehearsal, with what does not move drawn once."""
        T_base_ct = rehearsal.T_base_ct_true
        arm = ArmPicture(plan.model, T_base_ct)
        base, at_standoff = arm.bodies(rehearsal.q[0])[0], plan.target_ct + plan.standoff_mm * plan.outward_ct
        planned = SceneBody("planned path", "safe", bar(plan.target_ct, at_standoff, PLANNED_RADIUS_MM), PLANNED)
        still = [*scene_parts.patient(anatomy, case), *scene_parts.room(case, T_base_ct), arm.plate, planned]
        organs = Layer([b.surface for b in still if b.alpha >= 1 and b.group in {"organ", "target"}])
        path_ct = np.stack([plan.target_ct, plan.entry_ct])
        near_by = scene_parts.close_up(case, path_ct, INSET_RADIUS_MM, organs, (INSET, INSET))
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
            for at, moment in enumerate(times.moments):
                waiting.append(pool.submit(drawn, moment))
                while len(waiting) > threads or (waiting and at == len(times.moments) - 1):
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
    bodies = scene_parts.needle_bodies(case.needle, tip, np.array([0.0, 0.0, -1.0]), NEEDLE_PIXELS / 2 * mm_per_pixel)
    own = [] if case.tool is None else [Surface(case.tool.mesh, palette.HOLDER)]
    return Layer([*(Surface(b.mesh, b.colour) for b in bodies), *own])


def _wide_camera(case: Any, still: list[SceneBody], arm: ArmPicture, rehearsal: Any, plan: Any) -> ViewCamera:
    """Camera of the overview: the patient fills it, seen from the entry's side, with the needle at its standoff."""
    direction = plan.outward_ct
    focus = plan.target_ct + np.linspace(0, plan.standoff_mm + case.needle.length_mm, 24)[:, None] * direction
    shown = focus[np.linalg.norm(focus - plan.target_ct, axis=1) < plan.standoff_mm + ABOVE_MM]
    skin = [b.mesh.vertices for b in still if b.group == "skin"]
    near = [v[np.linalg.norm(v - plan.target_ct, axis=1) < BODY_MM] for v in skin]
    at_work = [body for q in (plan.insertion.q[0], rehearsal.q[-1]) for body in arm.bodies(q)]
    blockers = Layer([b.surface for b in at_work] + [b.surface for b in still if b.group == "room"])
    content, size = np.concatenate([*near, shown]), (VIEW_WIDTH, VIEW_HEIGHT)
    return scene_parts.overview(case, content, focus, blockers, size, direction)


def write_mp4(frames: Iterable[Pixels], size: tuple[int, int], path: Path, fps: int) -> None:
    """Write frames (h, w, 3) as a film, whole or not at all; width and height are multiples of 16, as H.264 likes them.

    Raises OSError: No encoder can be started. RuntimeError: It has no H.264, or did not write all frames.
    """
    with atomic(path) as temporary:
        keys = {"fps": fps, "codec": "libx264", "quality": None, "ffmpeg_log_level": "quiet"}
        writer = imageio_ffmpeg.write_frames(str(temporary), size, output_params=[*QUALITY, *SAME_BYTES], **keys)
        writer.send(None)
        sent = 0
        try:
            for frame in frames:
                writer.send(np.ascontiguousarray(frame))
                sent += 1
        finally:
            writer.close()
        written, _ = imageio_ffmpeg.count_frames_and_secs(str(temporary))  # an encoder on a full disk says nothing
        if written != sent:
            raise RuntimeError(f"the encoder wrote {written} of {sent} frames")


PHASES = {
    "approach": "approach to standoff",
    "settle": "settling at standoff",
    "insertion": "insertion",
    "hold": "at the target",
}
CONTACT_SHOWN_S = 3.0  # how long (time of the rehearsal) a contact stays in large letters
LABEL, VALUE = 13, 17
FRAME: Rgb = (150, 156, 164)
RULE: Rgb = (190, 194, 200)  # the lines about the close-up, and between views and words

CELLS = (  # column and name of each number below the overview; a phase takes at most 201 pixels
    (12, "time"),
    (128, "phase"),
    (338, "true tip to target"),
    (474, "contacts"),
    (560, "needle to nearest structure"),
)


class FilmFrames:
    """Whole frames: the overview upper left, the close-up beside it (with a camera each), numbers below."""

    def __init__(
        self, rehearsal: Any, cameras: tuple[ViewCamera, ViewCamera], case: Any, speed: float, keep_away: frozenset[str]
    ) -> None:
        self._rehearsal, self._keep_away, self._note = rehearsal, keep_away, model_note(case)
        self._over_near, self._ground = _over_near(cameras[1], case), _ground(rehearsal, cameras, case, speed)
        self._wide = cameras[0]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self._ground.size

    def frame(self, moment: float, wide: Pixels, near: Pixels) -> Pixels:
        """The frame of a moment, s, whose views are drawn; shape (h, w, 3)."""
        frame, row = self._ground.copy(), self.row(moment)
        frame.paste(Image.fromarray(wide))
        frame.paste(Image.fromarray(near), (self._wide.width, 0))
        frame.paste(self._over_near, (self._wide.width, 0), self._over_near)
        draw = ImageDraw.Draw(frame)
        self._news(draw, moment)
        self._numbers(draw, self._wide.height, row, moment)
        return np.asarray(frame)

    def row(self, moment: float) -> int:
        """The record that is shown at a moment."""
        return int(np.searchsorted(self._rehearsal.times_s, moment, side="right")) - 1

    def _news(self, draw: ImageDraw.ImageDraw, moment: float) -> None:
        """Write recent contacts over the overview, and at the end the result."""
        done = self._rehearsal
        fresh = [contact for contact in done.contacts if 0.0 <= moment - contact.time_s <= CONTACT_SHOWN_S]
        for line, contact in enumerate(fresh[-3:]):
            text = f"CONTACT: {_short(contact.link)} touches {_short(contact.body)}"
            annotate.write(draw, (12, 12 + 24 * line), text, size=17, bold=True, colour=annotate.RED, halo=3)
        if moment >= done.times_s[-1]:
            touched = plural(len(done.contacts), "contact") if done.contacts else "no contact"
            said = f"The tip ended {number(done.tip_error_mm, 2, 'mm')} from the target; {touched}"
            ink = annotate.RED if done.contacts else annotate.INK
            annotate.write(draw, (12, self._wide.height - 34), said, size=20, bold=True, colour=ink, halo=4)

    def _numbers(self, draw: ImageDraw.ImageDraw, top: int, row: int, moment: float) -> None:
        """Write the numbers of a record below the views; at the end what the tip's error consists of."""
        done = self._rehearsal
        contacts = sum(one.time_s <= moment for one in done.contacts)
        phase, away = str(done.phase[row]), float(np.linalg.norm(done.tip_true_ct[row] - done.target_true_ct))
        values = (
            (f"{moment:.1f}/{done.times_s[-1]:.1f} s", annotate.INK),
            (PHASES.get(phase, phase), annotate.INK),
            (number(away, 1, "mm"), annotate.INK),
            (str(contacts), annotate.RED if contacts else annotate.INK),
            (self._nearest(moment), annotate.INK),
        )
        for (x, _), (value, ink) in zip(CELLS, values, strict=True):
            annotate.write(draw, (x, top + 22), value, size=VALUE, bold=True, colour=ink)
        if row < len(done.times_s) - 1:
            annotate.write(draw, (12, top + 54), self._note, size=11, colour=annotate.FAINT)
            return
        deeper = "deep" if done.depth_mm >= 0 else "shallow"
        parts = f"lateral {number(done.lateral_mm, 2)}, {number(abs(done.depth_mm), 2)} too {deeper}"
        place = "" if done.standing is None else f"; {done.standing.place}"
        if done.truth_is_belief:  # what matters more than the parts of so small an error, and there is room for one
            parts, place = "from the joints alone; the patient is exactly where believed", ""
        result = f"tip error at the end {number(done.tip_error_mm, 2, 'mm')}: {parts}{place}"
        annotate.write(draw, (12, top + 51), result, size=VALUE, bold=True)

    def _nearest(self, moment: float) -> str:
        """Nearest structure to keep away from, and its clearance, at the latest sample."""
        times, names = self._rehearsal.clearance_times_s, self._keep_away & set(self._rehearsal.clearance_mm)
        if len(times) == 0 or moment < times[0] or not names:
            return "– (not yet)"
        sample = int(np.searchsorted(times, moment, side="right")) - 1
        clearance_mm, name = min((float(self._rehearsal.clearance_mm[one][sample]), one) for one in names)
        return f"crosses {_short(name)}" if clearance_mm < 0 else f"{number(clearance_mm, 1, 'mm')}  {_short(name)}"


def _ground(rehearsal: Any, cameras: Sequence[ViewCamera], case: Any, speed: float) -> Image.Image:
    wide, near = cameras
    frame = Image.new("RGB", (wide.width + near.width, wide.height + BELOW), annotate.WHITE)
    draw, left, below = ImageDraw.Draw(frame), wide.width, near.height
    played = "real time" if speed == 1 else f"playback × {speed:g}"
    annotate.write(draw, (left + 10, below + 12), str(case.name)[:26], size=17, bold=True)
    shown = "rehearsal in the twin" if rehearsal.standing is None else rehearsal.standing.short
    for line, text in enumerate((shown, f"{played}; green: planned path")):
        annotate.write(draw, (left + 10, below + 37 + 19 * line), text, size=12)
    annotate.body_axes(draw, wide, case.space, (left + near.width / 2, wide.height - 96), 42, size=14)
    about = "directions in the large view"
    annotate.write(draw, (left + 24, wide.height - 204), about, size=11, colour=annotate.FAINT)
    draw.line([(left, below), (frame.width, below)], fill=FRAME, width=1)
    draw.line([(left, below), (left, wide.height)], fill=RULE, width=1)
    draw.line([(0, wide.height), (wide.width, wide.height)], fill=RULE, width=1)
    for x, label in CELLS:
        annotate.write(draw, (x, wide.height + 6), label, size=LABEL, colour=annotate.FAINT)
    return frame


def _over_near(near: ViewCamera, case: Any) -> Image.Image:
    """RGBA of the close-up's size, see-through where nothing is written."""
    image = Image.new("RGBA", (near.width, near.height), (*annotate.WHITE, 0))
    draw = ImageDraw.Draw(image)
    draw.line([(0, near.height), (0, 0), (near.width, 0)], fill=FRAME, width=1)
    annotate.write(draw, (8, 7), "close-up", size=13, bold=True, halo=2)
    annotate.scale_bar(draw, near, case.target_ct, 12, near.height - 12, 90, note="")
    return image


def model_note(case: Any) -> str:
    """Note on needle, tissue and breath: what the case declares of them is computed, not drawn."""
    needle = "needle and tissue are rigid"
    if case.bending is not None:
        needle = "tissue pushes on the needle: its end is bent, the drawing is straight"
    breath = "nothing breathes" if case.breathing is None else "the body is drawn still, as in the CT"
    return f"{needle}; {breath}; research software, not a medical device"


def _short(name: str) -> str:
    return name.replace("_", " ")
