"""What is written into a frame of the film: time, phase, distances, contacts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from PIL import Image, ImageDraw

from puncture_twin.twin.report import annotate
from puncture_twin.twin.report.numbers import number
from puncture_twin.twin.report.raster.camera import ViewCamera

PHASES = {
    "approach": "approach to standoff",
    "settle": "settling at standoff",
    "insertion": "insertion",
    "hold": "at the target",
}
CONTACT_SHOWN_S = 3.0
"""How long (time of the rehearsal) a contact stays in large letters."""

LABEL, VALUE = 13, 17

CELLS = (
    (12, "time"),
    (95, "phase"),
    (320, "true tip to target"),
    (470, "contacts"),
    (560, "needle to nearest structure"),
)
"""Column and name of each number below the overview."""


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


def draw_still_text(frame: Image.Image, source: FrameText, cameras: tuple[ViewCamera, ViewCamera], case: Any) -> None:
    """Write the words beside the views that every frame has.

    Args:
        frame: What the views are put on: the overview upper left, the close-up beside it.
        source: Where the words come from.
        cameras: Of the overview and of the close-up.
        case: For names and the space.
    """
    draw = ImageDraw.Draw(frame)
    wide, near = cameras
    left, below = wide.width, near.height
    speed = "real time" if source.speed == 1 else f"playback × {source.speed:g}"
    annotate.write(draw, (left + 10, below + 12), str(case.name)[:26], size=17, bold=True)
    standing = source.rehearsal.standing
    shown = "rehearsal in the twin" if standing is None else standing.short
    for line, text in enumerate((shown, f"{speed}; green: planned path")):
        annotate.write(draw, (left + 10, below + 37 + 19 * line), text, size=13)
    annotate.body_axes(draw, wide, case.space, (left + near.width / 2, wide.height - 96), 42, size=14)
    annotate.write(draw, (left + 24, wide.height - 204), "directions in the large view", size=11, colour=annotate.FAINT)
    for x, label in CELLS:
        annotate.write(draw, (x, wide.height + 6), label, size=LABEL, colour=annotate.FAINT)


def draw_frame_text(
    frame: Image.Image, source: FrameText, row: int, moment: float, cameras: tuple[ViewCamera, ViewCamera], case: Any
) -> None:
    """Write what changes from frame to frame, and what stands in the views.

    Args:
        frame: The picture, with `draw_still_text` and its views.
        source: Where the numbers come from.
        row: The rehearsal's record shown.
        moment: Its time, s.
        cameras: Of the overview and of the close-up.
        case: For the target.
    """
    draw = ImageDraw.Draw(frame)
    wide, near = cameras
    left, below = wide.width, near.height
    draw.rectangle([left, 0, frame.width, below], outline=(150, 156, 164), width=1)
    draw.line([(left, below), (left, wide.height), (0, wide.height)], fill=(190, 194, 200), width=1)
    annotate.write(draw, (left + 8, 7), "close-up", size=13, bold=True, halo=2)
    annotate.scale_bar(draw, near, case.target_ct, left + 12, below - 12, 90, note="")
    _strip(draw, source, row, moment, wide.height)
    _alarm(draw, source, moment)


def model_note(case: Any) -> str:
    """What a film shows of needle, tissue and breath: what the case declares of them is computed, not drawn."""
    needle = (
        "needle and tissue are rigid"
        if case.bending is None
        else "tissue pushes on the needle; its bend is in where it ends, drawn straight"
    )
    breath = "nothing breathes" if case.breathing is None else "the body stands still as in the CT"
    return f"{needle}; {breath}; research software, not a medical device"


def _strip(draw: ImageDraw.ImageDraw, source: FrameText, row: int, moment: float, top: int) -> None:
    phase = str(source.rehearsal.phase[row])
    nearest = source.clearance(moment)
    contacts = len(source.contacts(moment))
    near = "– (not yet)" if nearest is None else f"{number(nearest[1], 1, 'mm')}  {_short(nearest[0])}"
    values = (
        (f"{moment:.1f} s", annotate.INK),
        (PHASES.get(phase, phase), annotate.INK),
        (number(source.distance(row), 1, "mm"), annotate.INK),
        (str(contacts), annotate.RED if contacts else annotate.INK),
        (near, annotate.INK),
    )
    for (x, _), (value, ink) in zip(CELLS, values, strict=True):
        annotate.write(draw, (x, top + 22), value, size=VALUE, bold=True, colour=ink)
    r = source.rehearsal
    if row == len(r.times_s) - 1:
        deeper = "deep" if r.depth_mm >= 0 else "shallow"
        parts = f"lateral {number(r.lateral_mm, 2)}, {number(abs(r.depth_mm), 2)} too {deeper}"
        place = "" if r.standing is None else f"; {r.standing.place}"
        result = f"tip error at the end {number(r.tip_error_mm, 2, 'mm')}: {parts}{place}"
        annotate.write(draw, (12, top + 51), result, size=VALUE, bold=True)
    else:
        annotate.write(draw, (12, top + 54), source.note, size=11, colour=annotate.FAINT)


def _alarm(draw: ImageDraw.ImageDraw, source: FrameText, moment: float) -> None:
    fresh = [c for c in source.contacts(moment) if moment - c.time_s <= CONTACT_SHOWN_S]
    for line, contact in enumerate(fresh[-3:]):
        text = f"CONTACT: {_short(contact.link)} touches {_short(contact.body)}"
        annotate.write(draw, (12, 12 + 24 * line), text, size=17, bold=True, colour=annotate.RED, halo=3)


def _short(name: str) -> str:
    return name.replace("_", " ")
