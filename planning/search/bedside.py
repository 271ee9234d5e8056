"""One path as a person finds it again at the patient: skin entry, nearest marker, and angles in the scanner.

`entry_facts` makes the one table that terminal, JSON and page show; the entry lies so far from a marker along the
patient's own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.spaces import Space, to_lps


@dataclass(frozen=True, eq=False)
class EntryFacts:
    """One path from outside to the target, as described to a person at the patient.

    Attributes:
        space: Of the case: what a person typed is answered in it.
        entry_mm: Shape (3,), the skin entry in that space, mm; NaN without one.
        place: Seen from the nearest marker, or from the target where the case has none; None without an entry.
        planes: Its angles in the scanner; None in a local space, which has no anatomy.
    """

    space: Space
    entry_mm: Floats
    place: EntryPlace | None
    planes: NeedlePlanes | None

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a label and its text for people."""
        stated: list[tuple[str, str]] = []
        if self.place is not None:
            point = ", ".join(f"{mm:.1f}" for mm in self.entry_mm)
            stated = [("skin entry", f"({point}) mm {self.space}"), ("on the skin", self.place.text(self.space))]
        return (*stated, *(() if self.planes is None else self.planes.rows()))

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON: mm and degrees; null where there is no number."""
        place = None
        if self.place is not None:
            x, y, z = self.place.offset_ct.tolist()
            names = ("x_mm", "y_mm", "z_mm") if self.space is Space.LOCAL else ("left_mm", "back_mm", "head_mm")
            place = {
                "of": self.place.landmark.name,
                **dict(zip(names, (x, y, z), strict=True)),
                "distance_mm": self.place.distance_mm,
                "text": self.place.text(self.space),
            }
        return {
            "space": str(self.space),
            "entry_mm": None if self.place is None else self.entry_mm.tolist(),
            "entry_from": place,
            "in_scanner": None if self.planes is None else self.planes.summary(),
        }


def entry_facts(case: Case, markers: Sequence[Landmark], entry_ct: Floats, outward_ct: Floats) -> EntryFacts:
    """Skin entry, nearest landmark and scanner angles of one path.

    Args:
        case: Its space and target.
        markers: Those of its registration; may be none.
        entry_ct: Shape (3,), mm; NaN without a skin entry.
        outward_ct: Shape (3,), unit, from the target outward.
    """
    landmarks = markers or (Landmark("the target", np.asarray(case.target_ct)),)
    planes = None if case.space is Space.LOCAL else needle_planes(outward_ct)
    entry_mm = to_lps(entry_ct[None], case.space)[0]  # the change of signs undoes itself
    return EntryFacts(case.space, entry_mm, entry_place(entry_ct, landmarks), planes)


class NeedlePlanes(NamedTuple):
    """Angles of one needle, rad.

    Attributes:
        in_plane: Between the patient's front and the needle as it is seen in the axial slice, -π..π; positive: the hub
            is on the patient's left. NaN for a needle along the patient.
        out_of_plane: Between the axial slice and the needle, -π/2..π/2; positive: the hub leans toward the head.
        gantry_tilt: At which the needle lies in the slice, -π/2..π/2; positive: the top leans toward the feet.
    """

    in_plane: float
    out_of_plane: float
    gantry_tilt: float

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a label and its text for people."""
        beyond = f", more than the usual {np.degrees(MOST_TILT):.0f}" if abs(self.gantry_tilt) > MOST_TILT else ""
        seen = _angle(self.in_plane, " from the front", ", hub to the left", ", hub to the right")
        along = _angle(self.out_of_plane, "", ", hub toward the head", ", hub toward the feet")
        tilt = _angle(self.gantry_tilt, "", ", top toward the feet", ", top toward the head")
        return (
            ("in-plane angle", seen if np.isfinite(self.in_plane) else "none: the needle runs along the patient"),
            ("out-of-plane angle", along),
            ("gantry tilt", tilt + beyond),
        )

    def summary(self) -> dict[str, Any]:
        """Plain values: degrees; null where there is no angle."""
        angles = {f"{name}_deg": float(np.degrees(angle)) for name, angle in self._asdict().items()}
        return {name: angle if np.isfinite(angle) else None for name, angle in angles.items()}


LEAST_IN_PLANE = 1e-6
"""Least part of a unit direction within the slice: a needle along the patient has no angle there."""

MOST_TILT = np.radians(30.0)
"""rad: gantries of CT scanners tilt no farther."""


def _angle(angle: float, of: str, positive: str, negative: str) -> str:
    """An angle as text with its side; no side for what is shown as 0."""
    size = f"{abs(np.degrees(angle)):.1f}"
    side = "" if float(size) == 0.0 else positive if angle > 0 else negative
    return f"{size} deg{of}{side}"


def needle_planes(outward_ct: Floats) -> NeedlePlanes:
    """The angles of a direction from the target outward, shape (3,), unit, LPS."""
    left, front, head = float(outward_ct[0]), -float(outward_ct[1]), float(outward_ct[2])
    in_plane = np.arctan2(left, front) if np.hypot(left, front) > LEAST_IN_PLANE else np.nan
    tilt = np.arctan2(-head * np.copysign(1.0, front), abs(front))
    return NeedlePlanes(float(in_plane), float(np.arcsin(np.clip(head, -1.0, 1.0))), float(tilt) + 0.0)


LEAST_MM = 0.5
"""mm: a ruler on the skin does not show less; texts are in whole mm."""

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
