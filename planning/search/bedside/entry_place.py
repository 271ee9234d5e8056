"""How far the skin entry lies from a marker, along the patient's own axes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.spaces import Space

LEAST_MM = 0.5
"""What a ruler on the skin does not show; words are in whole mm."""

PATIENT = (
    (0, "to the left", "to the right"),
    (2, "toward the head", "toward the feet"),
    (1, "toward the back", "toward the front"),
)
"""Axis of LPS, and its positive and negative direction; in the order in which they are measured on a lying patient."""

LOCAL = tuple((axis, f"along +{name}", f"along -{name}") for axis, name in enumerate("xyz"))
"""A space of its own has no anatomy."""


class Landmark(NamedTuple):
    """A point that can be found again at the patient; ``point_ct`` has shape (3,), mm."""

    name: str
    point_ct: Floats


@dataclass(frozen=True, eq=False)
class EntryPlace:
    """A skin entry as seen from a landmark.

    Attributes:
        landmark: From where it is measured.
        offset_ct: Shape (3,), from the landmark to the entry, mm.
    """

    landmark: Landmark
    offset_ct: Floats

    @property
    def distance_mm(self) -> float:
        """Straight through the air."""
        return float(np.linalg.norm(self.offset_ct))

    def text(self, space: Space) -> str:
        """Such as "52 mm to the right and 32 mm toward the feet of marker A"."""
        axes = LOCAL if space is Space.LOCAL else PATIENT
        parts = [
            f"{abs(mm):.0f} mm {positive if mm > 0 else negative}"
            for mm, positive, negative in ((self.offset_ct[axis], up, down) for axis, up, down in axes)
            if abs(mm) >= LEAST_MM
        ]
        if not parts:
            return f"at {self.landmark.name}"
        listed = " and ".join([", ".join(parts[:-1]), parts[-1]]) if len(parts) > 1 else parts[0]
        return f"{listed} {'from' if space is Space.LOCAL else 'of'} {self.landmark.name}"


def entry_place(entry_ct: Floats, landmarks: Sequence[Landmark]) -> EntryPlace | None:
    """The entry, shape (3,), as seen from the nearest landmark; of equally near ones the first. None without any."""
    if not (len(landmarks) and np.isfinite(entry_ct).all()):
        return None
    offsets = [entry_ct - one.point_ct for one in landmarks]
    nearest = int(np.argmin([np.linalg.norm(offset) for offset in offsets]))
    return EntryPlace(landmarks[nearest], offsets[nearest])
