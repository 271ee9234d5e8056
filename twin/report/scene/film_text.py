"""Text in a frame of the film: time, phase, distances, contacts.

The film as a file: what changes from frame to frame is put on a ground, and goes to the encoder as whole frames.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import imageio_ffmpeg
import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.reasons import Rgb
from puncture_twin.twin.report import annotate
from puncture_twin.twin.report.present import number
from puncture_twin.twin.report.raster.camera import ViewCamera

Pixels = NDArray[np.uint8]
"""Shape (h, w, 3)."""

SAME_BYTES = ("-threads", "4", "-filter_threads", "1", "-fflags", "+bitexact", "-flags:v", "+bitexact",
              "-sws_flags", "bitexact+accurate_rnd")  # fmt: skip
"""x264 writes other bytes for another number of threads, and left alone it takes as many as there are cores."""

QUALITY = ("-crf", "20", "-preset", "veryfast", "-movflags", "+faststart")

BOXES = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
"""Of an MP4 file (ISO 14496-12), from the outermost to the one that lists the frames' sizes."""

SIZES = b"stsz"


class Part(NamedTuple):
    """A part of a frame that may differ from the ground."""

    left: int
    top: int
    pixels: Pixels


Frame = Sequence[Part]


def put_on(ground: Pixels, frame: Frame) -> Pixels:
    """The whole frame."""
    whole = ground.copy()
    for left, top, pixels in frame:
        whole[top : top + pixels.shape[0], left : left + pixels.shape[1]] = pixels
    return whole


def write_mp4(ground: Pixels, frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write the film; it appears whole or not at all.

    Args:
        ground: What every frame is put on; its height and width are multiples of 16, as H.264 likes them.
        path: The ``.mp4`` to write.

    Raises:
        OSError: No encoder can be started.
        RuntimeError: It has no H.264, or did not write all frames.
    """
    height, width = ground.shape[:2]
    with atomic(path) as temporary:
        writer = imageio_ffmpeg.write_frames(
            str(temporary),
            (width, height),
            fps=fps,
            codec="libx264",
            quality=None,
            output_params=[*QUALITY, *SAME_BYTES],
            ffmpeg_log_level="quiet",
        )
        writer.send(None)
        sent = 0
        try:
            for frame in frames:
                writer.send(put_on(ground, frame))
                sent += 1
        finally:
            writer.close()
        written = frames_in(temporary.read_bytes())  # an encoder on a full disk says nothing
        if written != sent:
            raise RuntimeError(f"the encoder wrote {written} of {sent} frames")


def frames_in(film: bytes) -> int:
    """How many frames an MP4 of one track holds; 0 where it is cut off or none."""
    begin, end = 0, len(film)
    if sum(size for _, _, size in _boxes(film, begin, end)) != len(film):
        return 0
    for wanted in (*BOXES, SIZES):
        found = next((box for box in _boxes(film, begin, end) if box[0] == wanted), None)
        if found is None:
            return 0
        begin, end = found[1] + 8, found[1] + found[2]
    return int.from_bytes(film[begin + 8 : begin + 12], "big")


def _boxes(film: bytes, begin: int, end: int) -> Iterator[tuple[bytes, int, int]]:
    """Name, place and size of each box in a part of the file."""
    while begin + 8 <= end:
        size = int.from_bytes(film[begin : begin + 4], "big")
        if size < 8:  # what is larger than 4 GB, or reaches to the file's end, is no film of ours
            return
        yield film[begin + 4 : begin + 8], begin, size
        begin += size


def write_gif(ground: Pixels, frames: Iterable[Frame], path: Path, fps: int) -> None:
    """Write a film as a GIF; arguments as of `write_mp4`."""
    images = [Image.fromarray(put_on(ground, frame)).quantize(128) for frame in frames]
    with atomic(path) as temporary:
        images[0].save(temporary, format="GIF", save_all=True, append_images=images[1:], loop=0, duration=1000 // fps)


PHASES = {
    "approach": "approach to standoff",
    "settle": "settling at standoff",
    "insertion": "insertion",
    "hold": "at the target",
}
CONTACT_SHOWN_S = 3.0
"""How long (time of the rehearsal) a contact stays in large letters."""

LABEL, VALUE = 13, 17

BELOW = 80
"""Pixels: height of the numbers below the views."""

FRAME: Rgb = (150, 156, 164)
RULE: Rgb = (190, 194, 200)
"""The lines about the close-up, and between views and words."""

CELLS = (
    (12, "time"),
    (128, "phase"),
    (338, "true tip to target"),
    (474, "contacts"),
    (560, "needle to nearest structure"),
)
"""Column and name of each number below the overview; the longest phase takes 201 pixels."""


@dataclass(frozen=True)
class FrameText:
    """Where a frame's words come from: measurements, plan, speed, structures to keep away from, what is not drawn."""

    rehearsal: Any
    plan: Any
    speed: float
    demanding: frozenset[str]
    note: str

    def clearance(self, moment: float) -> tuple[str, float] | None:
        """Nearest structure to keep away from, and its clearance, at the latest sample; None before the first."""
        times = self.rehearsal.clearance_times_s
        names = [name for name in self.rehearsal.clearance_mm if name in self.demanding]
        if len(times) == 0 or moment < times[0] or not names:
            return None
        sample = int(np.searchsorted(times, moment, side="right")) - 1
        name = min(names, key=lambda n: float(self.rehearsal.clearance_mm[n][sample]))
        return name, float(self.rehearsal.clearance_mm[name][sample])

    def distance(self, row: int) -> float:
        """True tip to true target, mm."""
        return float(np.linalg.norm(self.rehearsal.tip_true_ct[row] - self.rehearsal.target_true_ct))

    def contacts(self, moment: float) -> list[Any]:
        """The contacts seen so far."""
        return [c for c in self.rehearsal.contacts if c.time_s <= moment]


class FrameWords:
    """Text of frames whose overview is upper left, with the close-up beside it and numbers below.

    Args:
        cameras: Of the overview and of the close-up.
    """

    def __init__(self, source: FrameText, cameras: tuple[ViewCamera, ViewCamera], case: Any) -> None:
        self._source, self._cameras, self._case = source, cameras, case
        wide, near = cameras
        self._over_near = _over_near(near, case)
        self._below = Image.new("RGB", (wide.width + near.width, BELOW), annotate.WHITE)
        draw = ImageDraw.Draw(self._below)
        draw.line([(0, 0), (wide.width, 0)], fill=RULE, width=1)
        for x, label in CELLS:
            annotate.write(draw, (x, 6), label, size=LABEL, colour=annotate.FAINT)

    def rows(self, moments: Sequence[float]) -> list[int]:
        """The records that are shown at some moments."""
        found = np.searchsorted(self._source.rehearsal.times_s, moments, side="right") - 1
        return [int(row) for row in found]

    def still(self, size: tuple[int, int]) -> Image.Image:
        """A frame of that width and height with the words that every frame has, and no view."""
        frame, (wide, near), source = Image.new("RGB", size, annotate.WHITE), self._cameras, self._source
        draw = ImageDraw.Draw(frame)
        left, below = wide.width, near.height
        speed = "real time" if source.speed == 1 else f"playback × {source.speed:g}"
        annotate.write(draw, (left + 10, below + 12), str(self._case.name)[:26], size=17, bold=True)
        standing = source.rehearsal.standing
        shown = "rehearsal in the twin" if standing is None else standing.short
        for line, text in enumerate((shown, f"{speed}; green: planned path")):
            annotate.write(draw, (left + 10, below + 37 + 19 * line), text, size=12)
        annotate.body_axes(draw, wide, self._case.space, (left + near.width / 2, wide.height - 96), 42, size=14)
        about = "directions in the large view"
        annotate.write(draw, (left + 24, wide.height - 204), about, size=11, colour=annotate.FAINT)
        draw.line([(left, below), (size[0], below)], fill=FRAME, width=1)
        draw.line([(left, below), (left, wide.height)], fill=RULE, width=1)
        frame.paste(self._below, (0, wide.height))
        return frame

    def over_wide(self, view: Pixels, moment: float) -> Pixels:
        """The overview, with what touches written into it while that is news, and at the end with the result."""
        done = self._source.rehearsal
        fresh = [c for c in self._source.contacts(moment) if moment - c.time_s <= CONTACT_SHOWN_S]
        ended = moment >= done.times_s[-1]
        if not fresh and not ended:
            return view
        image = Image.fromarray(view)
        draw = ImageDraw.Draw(image)
        _alarm(draw, fresh)
        if ended:
            touched = (
                f"{len(done.contacts)} contact{'' if len(done.contacts) == 1 else 's'}"
                if done.contacts
                else "no contact"
            )
            said = f"The tip ended {number(done.tip_error_mm, 2, 'mm')} from the target; {touched}"
            ink = annotate.RED if done.contacts else annotate.INK
            annotate.write(draw, (12, view.shape[0] - 34), said, size=20, bold=True, colour=ink, halo=4)
        return np.asarray(image)

    def over_near(self, view: Pixels) -> Pixels:
        """The close-up with its name, its scale and its frame."""
        image = Image.fromarray(view)
        image.paste(self._over_near, (0, 0), self._over_near)
        return np.asarray(image)

    def below(self, row: int, moment: float) -> Pixels:
        """The numbers below the views.

        Args:
            moment: Time of the record, s.
        """
        image = self._below.copy()
        _strip(ImageDraw.Draw(image), self._source, row, moment)
        return np.asarray(image)


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
    needle = (
        "needle and tissue are rigid"
        if case.bending is None
        else "tissue pushes on the needle: its end is bent, the drawing is straight"
    )
    breath = "nothing breathes" if case.breathing is None else "the body is drawn still, as in the CT"
    return f"{needle}; {breath}; research software, not a medical device"


def _strip(draw: ImageDraw.ImageDraw, source: FrameText, row: int, moment: float) -> None:
    phase = str(source.rehearsal.phase[row])
    nearest = source.clearance(moment)
    contacts = len(source.contacts(moment))
    near = "– (not yet)" if nearest is None else _nearness(*nearest)
    values = (
        (f"{moment:.1f}/{source.rehearsal.times_s[-1]:.1f} s", annotate.INK),
        (PHASES.get(phase, phase), annotate.INK),
        (number(source.distance(row), 1, "mm"), annotate.INK),
        (str(contacts), annotate.RED if contacts else annotate.INK),
        (near, annotate.INK),
    )
    for (x, _), (value, ink) in zip(CELLS, values, strict=True):
        annotate.write(draw, (x, 22), value, size=VALUE, bold=True, colour=ink)
    r = source.rehearsal
    if row == len(r.times_s) - 1:
        deeper = "deep" if r.depth_mm >= 0 else "shallow"
        parts = f"lateral {number(r.lateral_mm, 2)}, {number(abs(r.depth_mm), 2)} too {deeper}"
        place = "" if r.standing is None else f"; {r.standing.place}"
        if r.truth_is_belief:  # what matters more than the parts of so small an error, and there is room for one
            parts, place = "from the joints alone; the patient is exactly where believed", ""
        result = f"tip error at the end {number(r.tip_error_mm, 2, 'mm')}: {parts}{place}"
        annotate.write(draw, (12, 51), result, size=VALUE, bold=True)
    else:
        annotate.write(draw, (12, 54), source.note, size=11, colour=annotate.FAINT)


def _nearness(name: str, clearance_mm: float) -> str:
    return f"crosses {_short(name)}" if clearance_mm < 0 else f"{number(clearance_mm, 1, 'mm')}  {_short(name)}"


def _alarm(draw: ImageDraw.ImageDraw, fresh: Sequence[Any]) -> None:
    for line, contact in enumerate(fresh[-3:]):
        text = f"CONTACT: {_short(contact.link)} touches {_short(contact.body)}"
        annotate.write(draw, (12, 12 + 24 * line), text, size=17, bold=True, colour=annotate.RED, halo=3)


def _short(name: str) -> str:
    return name.replace("_", " ")
