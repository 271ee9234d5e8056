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
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.spaces import Space, to_lps


@dataclass(frozen=True, eq=False)
class EntryFacts:
    """One path from outside to the target, as described to a person at the patient."""

    space: Space  # of the case: what a person typed is answered in it
    entry_mm: Floats  # shape (3,), the skin entry in that space, mm; NaN without one
    place: EntryPlace | None
    """Seen from the nearest marker, or from the target where the case has none; None without an entry."""
    planes: NeedlePlanes | None
    """Its angles in the scanner; None in a local space, which has no anatomy."""
    scanned: ScannedEntry | None = None
    """Where the entry is in the scan; None without a CT or an entry, and in a local space."""
    needle_mm: float | None = None
    """The shortest needle of the case's catalogue that reaches, tip to flange; NaN where none does, None without a
    catalogue."""

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a label and its text, for people."""
        stated: list[tuple[str, str]] = []
        if self.place is not None:
            point = ", ".join(f"{mm:.1f}" for mm in self.entry_mm)
            stated = [("skin entry", f"({point}) mm {self.space}"), ("on the skin", self.place.text(self.space))]
        if self.needle_mm is not None:
            fits = "none reaches" if np.isnan(self.needle_mm) else f"{self.needle_mm:g} mm, the shortest that reaches"
            stated.append(("needle to take", fits))
        parts = (part.rows() for part in (self.scanned, self.planes) if part is not None)
        return (*stated, *(row for part in parts for row in part))

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
            "in_scan": None if self.scanned is None else self.scanned._asdict(),
            "needle_mm": None if self.needle_mm is None or np.isnan(self.needle_mm) else self.needle_mm,
        }


class ScannedEntry(NamedTuple):
    """Where a skin entry is in the scan."""

    slice: int  # its slice, 1 at the feet; 0 or beyond ``slices`` outside of the image
    slices: int
    table_mm: float
    """The slice's z, as DICOM has it: a console's slice location or, with its own sign, table position."""
    sagittal_mm: float
    """From the sagittal laser's line, positive to the patient's left, if x = 0 is the isocentre."""
    coronal_mm: float
    """From the coronal laser's line, positive toward the back, if y = 0 is the isocentre."""

    def rows(self) -> tuple[tuple[str, str], ...]:
        """Pairs of a label and its text for people."""
        inside = 1 <= self.slice <= self.slices
        place = f"{self.slice} of {self.slices} from the feet, {self.slices + 1 - self.slice} from the head"
        side, height = "left" if self.sagittal_mm > 0 else "right", "behind" if self.coronal_mm > 0 else "in front of"
        return (
            ("slice of the entry", place if inside else "outside of the image"),
            ("table position", f"z = {self.table_mm:.1f} mm, as DICOM has it"),
            (
                "laser lines",
                f"{abs(self.sagittal_mm):.0f} mm to the {side} of the sagittal one, {abs(self.coronal_mm):.0f} mm "
                f"{height} the coronal one, if x = y = 0 is the isocentre",
            ),
        )


def slice_numbers(grid: VolumeGrid) -> tuple[Floats, int]:
    """Coefficients (4,) that make a slice's number, 1 at the feet, of a point (x, y, z, 1), mm, and how many there are.

    Slices lie along the axis of the image that is nearest to the patient's.
    """
    axis = int(np.argmax(np.abs(grid.T_ct_index[2, :3])))
    count, index = grid.shape[axis], np.linalg.inv(grid.T_ct_index)[axis]
    return (index + [0, 0, 0, 1] if grid.T_ct_index[2, axis] > 0 else [0, 0, 0, count] - index), count


def entry_facts(
    case: Case, markers: Sequence[Landmark], entry_ct: Floats, outward_ct: Floats, grid: VolumeGrid | None = None
) -> EntryFacts:
    """Skin entry (3,), mm (NaN without one), nearest landmark and scanner angles of one path outward (3,), unit."""
    landmarks = markers or (Landmark("the target", np.asarray(case.target_ct)),)
    planes = None if case.space is Space.LOCAL else needle_planes(outward_ct)
    place, scanned = entry_place(entry_ct, landmarks), None
    entry_mm = to_lps(entry_ct[None], case.space)[0]  # the change of signs undoes itself
    if grid is not None and place is not None and planes is not None:
        number, count = slice_numbers(grid)
        x, y, z = entry_ct.tolist()
        scanned = ScannedEntry(int(np.rint(number @ [x, y, z, 1.0])), count, z, x, y)
    path_mm, needle, needle_mm = float(np.linalg.norm(entry_ct - case.target_ct)), case.needle, None
    if place is not None and needle.lengths_mm:
        reaching = [mm for mm in needle.lengths_mm if needle.of_length(mm).longest_path_mm >= path_mm]
        needle_mm = min(reaching, default=np.nan)
    return EntryFacts(case.space, entry_mm, place, planes, scanned, needle_mm)


class NeedlePlanes(NamedTuple):
    """Angles of one needle in the scanner, rad."""

    in_plane: float
    """Between the patient's front and the needle as it is seen in the axial slice, -π..π; positive: the hub is on the
    patient's left. NaN for a needle along the patient."""
    out_of_plane: float
    """Between the axial slice and the needle, -π/2..π/2; positive: the hub leans toward the head."""
    gantry_tilt: float
    """At which the needle lies in the slice, -π/2..π/2; positive: the top leans toward the feet."""

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
    """A point that a person recognises at the patient; ``point_ct`` has shape (3,), mm."""

    name: str
    point_ct: Floats


@dataclass(frozen=True, eq=False)
class EntryPlace:
    """A skin entry as seen from a landmark, ``offset_ct`` (3,), mm, from there."""

    landmark: Landmark
    offset_ct: Floats

    @property
    def distance_mm(self) -> float:
        """Distance of the entry from the landmark, straight through the air."""
        return float(np.linalg.norm(self.offset_ct))

    def text(self, space: Space) -> str:
        """Place relative to the landmark, such as "52 mm to the right and 32 mm toward the feet of marker A"."""
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
