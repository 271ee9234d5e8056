"""The frames of a film: its two views, and text: time, phase, distances, contacts; and the film as a file."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from PIL import Image, ImageDraw

from puncture_twin.planning.base.arrays import Pixels
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.planning.base.text import plural
from puncture_twin.twin.report import annotate
from puncture_twin.twin.report.present import number
from puncture_twin.twin.report.raster.camera import ViewCamera

SAME_BYTES = ("-threads", "4", "-filter_threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact",
              "-sws_flags", "bitexact+accurate_rnd")  # fmt: skip
"""x264 writes other bytes for another number of threads, and left alone it takes as many as there are cores."""

QUALITY = ("-crf", "20", "-preset", "veryfast", "-movflags", "+faststart")


def write_mp4(frames: Iterable[Pixels], size: tuple[int, int], path: Path, fps: int) -> None:
    """Write the film; it appears whole or not at all.

    Args:
        frames: Each of shape (h, w, 3).
        size: Width and height; multiples of 16, as H.264 likes them.

    Raises:
        OSError: No encoder can be started.
        RuntimeError: It has no H.264, or did not write all frames.
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


def write_gif(frames: Iterable[Pixels], path: Path, fps: int) -> None:
    """Write a film as a GIF; arguments as of `write_mp4`."""
    images = [Image.fromarray(frame).quantize(128) for frame in frames]
    with atomic(path) as temporary:
        images[0].save(temporary, format="GIF", save_all=True, append_images=images[1:], loop=0, duration=1000 // fps)


PHASES = {
    "approach": "approach to standoff",
    "settle": "settling at standoff",
    "insertion": "insertion",
    "hold": "at the target",
}
CONTACT_SHOWN_S = 3.0  # how long (time of the rehearsal) a contact stays in large letters
LABEL, VALUE = 13, 17
BELOW = 80  # pixels: height of the numbers below the views
FRAME: Rgb = (150, 156, 164)
RULE: Rgb = (190, 194, 200)  # the lines about the close-up, and between views and words

CELLS = (
    (12, "time"),
    (128, "phase"),
    (338, "true tip to target"),
    (474, "contacts"),
    (560, "needle to nearest structure"),
)
"""Column and name of each number below the overview; the longest phase takes 201 pixels."""


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
        """Over the overview: what touches while that is news, and at the end the result."""
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
        """Below the views: the numbers of a record; at the end what the tip's error consists of."""
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
    """What a film shows of needle, tissue and breath: what the case declares of them is computed, not drawn."""
    needle = "needle and tissue are rigid"
    if case.bending is not None:
        needle = "tissue pushes on the needle: its end is bent, the drawing is straight"
    breath = "nothing breathes" if case.breathing is None else "the body is drawn still, as in the CT"
    return f"{needle}; {breath}; research software, not a medical device"


def _short(name: str) -> str:
    return name.replace("_", " ")
