"""A placement whose markers, or stated transform, have been compared with what else is known.

A transform file says neither which way it goes nor what its axes are at the robot, and each slip is a rigid motion like
any other. Markers tell it in mm; without them physics excludes. So what the case states is held against the three other
readings of its keys.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import load_couch, load_skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.tables import NO_RESIDUALS, MarkerSection, RegistrationSection, other_readings
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.checks.markers import (
    OF_MARKERS,
    OF_MOUNT,
    Surroundings,
    base_place,
    check_markers,
    place_warnings,
    up_base,
)
from puncture_twin.planning.registration.placement import Placement, load_placement, registered
from puncture_twin.planning.registration.registration import Registration, weak_points

UPRIGHT = np.radians(30.0)
"""Angle of the base's z axis from up up to which an arm is upright: on a floor, a rail or a cart, as most are."""
EXPLAINED = 3.29
"""Times the expected (rms) error of a point: normal errors exceed it at most once in 1,000, in whatever directions they
lie. It is the normal distribution's own bound, and errors along one line, of one size, reach it most often."""
MAX_APART_MM = 5.0
"""Markers and a transform that differ by more, and by more than both errors explain, are of two patients or robots."""
CAUSES = (
    "the usual causes are a transform in the other direction (transform_maps), other axes at the robot (base_axes; a "
    "URDF's base_link is rotated in this way), and a transform of another image"
)
MARKERS_TELL = " (markers_ct and markers_base with it would check it)"
BOX_TELLS = " (so does the patient support, as an obstacle of frame base)"
"""Further evidence that would make a warning needless."""
ALLOWED = "a transform between this CT and this robot's base, with transform_maps and base_axes as saved"


@dataclass(frozen=True, eq=False)
class Reading:
    """The transform that the file would state under some of its keys."""

    keys: str  # those that differ from the case's; empty as stated
    T_base_ct: Floats  # shape (4, 4), mm
    impossible: str
    unlikely: str
    rests_on: str  # the obstacle of frame ``base`` that the patient lies on, or empty
    tilt: float  # between the robot's z axis and up, rad

    @property
    def plausible(self) -> bool:
        """Whether nothing speaks against it."""
        return not self.impossible and not self.unlikely

    @property
    def usual(self) -> tuple[bool, bool]:
        """Whether the patient lies on something, and whether the arm is mounted upright, as is usual."""
        return bool(self.rests_on), self.tilt <= UPRIGHT

    def better_than(self, other: Reading) -> bool:
        """Whether something speaks for it that does not for the other."""
        return any(mine and not theirs for mine, theirs in zip(self.usual, other.usual, strict=True))

    def text(self) -> str:
        """Arguments for and against this reading, in words."""
        lies = f"on '{self.rests_on}'" if self.rests_on else "on no obstacle of frame base"
        return f"the patient lies {lies} and the robot's z axis {np.degrees(self.tilt):.0f} deg from up"


def marker_registration(case: Case, stated: RegistrationSection) -> Registration | None:
    """The registration by the markers that a case states besides a transform; None without them."""
    return None if stated.markers_ct is None else registered(case, MarkerSection(**stated.model_dump()))


def check_transform(
    case: Case, skin: TriangleMesh, T_base_ct: Floats, registration: Registration | None = None
) -> Iterator[Finding]:
    """Compare a stated transform (4, 4), mm, with the markers beside it, if any, and with what physics excludes.

    Yields warnings, and a note on how far markers that agree (of `marker_registration`; their own checks are
    `check_markers`) are from it; nothing where the case states none.
    """
    stated = case.robot.stated
    if stated is None:
        return
    given = _reading(case, skin, "", T_base_ct)
    others = [_reading(case, skin, keys, T) for keys, T in other_readings(stated, T_base_ct).items()]
    if given.impossible:
        _refuse(case, f"{given.impossible}: {CAUSES}{_better(others)}")
    if registration is None:
        doubts, alike = _doubts(case, given, others)
        as_plausible = "".join(f"; {one.sentence.removeprefix('registration: ')}" for one in alike)
        said = f"registration: {NO_RESIDUALS.format(file=case.robot.transform)}{MARKERS_TELL}{as_plausible}"
        yield from (Finding("transform_not_measured", Severity.WARNING, said), *doubts)
        return
    distinct = [one for one in others if not _apart(case, registration, one.T_base_ct).contradicts]
    yield _held_against_markers(case, registration, given, distinct)
    doubts, alike = _doubts(case, given, distinct)
    yield from (*doubts, *alike)


def _reading(case: Case, skin: TriangleMesh, keys: str, T_base_ct: Floats) -> Reading:
    tilt = float(np.arccos(np.clip(up_base(case, T_base_ct)[2], -1.0, 1.0)))  # pi for an arm that hangs
    return Reading(keys, T_base_ct, *base_place(case, skin, T_base_ct), tilt)


def _better(others: Sequence[Reading]) -> str:
    plausible = [one for one in others if one.plausible]
    return f"; alternatives: {_named(plausible)}" if plausible else "; no other reading of these keys is plausible"


def _named(readings: Sequence[Reading]) -> str:
    """Their keys with what speaks for them, the most usual first."""
    usual_first = sorted(readings, key=lambda one: one.usual, reverse=True)
    return ", or ".join(f"{one.keys} ({one.text()})" for one in usual_first)


def _doubts(case: Case, given: Reading, others: Sequence[Reading]) -> tuple[list[Finding], list[Finding]]:
    """What hardly is so as stated, or the other readings that are more usual; else, apart, those as plausible."""
    if given.unlikely:
        said = f"registration: by the stated transform {given.unlikely}: {CAUSES}{_better(others)}"
        return [Finding("transform_unlikely", Severity.WARNING, said)], []
    rivals = [one for one in others if one.plausible and not np.allclose(one.T_base_ct, given.T_base_ct, atol=1e-6)]
    if better := [one for one in rivals if one.better_than(given) and not given.better_than(one)]:
        said = (
            f"registration: {_named(better)} would be more usual than the stated keys ({given.text()}; place.up sets "
            f"which way is up): {CAUSES}"
        )
        return [Finding("transform_unlikely", Severity.WARNING, said)], []
    alike = [one for one in rivals if one.better_than(given) == given.better_than(one)]
    away = [np.linalg.norm(apply(one.T_base_ct - given.T_base_ct, case.target_ct)) for one in alike]
    named = ", ".join(f"{one.keys} ({mm:.0f} mm away)" for one, mm in zip(alike, away, strict=True))
    said = (
        "registration: the stated transform cannot be distinguished from other readings, which place the target "
        f"elsewhere: {named}{BOX_TELLS}"
    )
    return [], [Finding("transform_alike", Severity.WARNING, said)] if alike else []


def _held_against_markers(
    case: Case, registration: Registration, given: Reading, fitting: Sequence[Reading]
) -> Finding:
    """How far the transform is from what the markers say: a warning where their errors do not explain it."""
    apart = _apart(case, registration, given.T_base_ct)
    said = (
        f"the markers put {apart.where} {apart.apart_mm:.1f} mm from its position by the stated transform; expected "
        f"from the markers there: {apart.expected_mm:.1f} mm (rms)"
    )
    if apart.contradicts:
        _refuse(case, f"{said}: {CAUSES}{''.join(f'; with {one.keys} they agree' for one in fitting)}")
    unexplained = apart.apart_mm > EXPLAINED * apart.expected_mm
    remark = ", more than their errors explain" if unexplained else ""
    said = f"registration: stated transform: {said}{remark}; the transform's own expected error is unknown"
    severity = Severity.WARNING if unexplained else Severity.NOTE
    return Finding("transform_and_markers", severity, said, {"apart_mm": apart.apart_mm})


class Apart(NamedTuple):
    """Where markers and a stated transform differ most, over the error expected of the markers there."""

    where: str
    apart_mm: float
    expected_mm: float  # the expected (rms) error of the markers there
    contradicts: bool
    """Whether some point differs by more than both errors explain, and by more than `MAX_APART_MM`."""


def _apart(case: Case, registration: Registration, T_base_ct: Floats) -> Apart:
    markers = registration.markers
    points = np.vstack([case.target_ct, markers.points_ct])
    names = ["the target", *(f"marker {name}" for name in markers.names)]
    apart = np.linalg.norm(apply(T_base_ct, points) - apply(registration.T_base_ct, points), axis=1)
    expected = np.maximum(registration.expected_tre_mm(points), np.finfo(float).tiny)
    row = int(np.argmax(apart / expected))
    both = np.maximum(MAX_APART_MM, np.sqrt(2.0) * EXPLAINED * expected)
    return Apart(names[row], float(apart[row]), float(expected[row]), bool(np.any(apart > both)))


def _refuse(case: Case, what: str) -> None:
    refuse(what, f"{case.path}: registration.transform", ALLOWED, "transform_implausible")


class CheckedPlacement(NamedTuple):
    """A placement and what its checks found."""

    placement: Placement
    findings: tuple[Finding, ...]


def checked_placement(case: Case, cache: Cache) -> CheckedPlacement | None:
    """The patient's pose for the robot, its markers checked; None where the case does not say it.

    Raises InputError: As `load_placement` and `placement_findings`, or a skin or CT that cannot be read.
    """
    placement = load_placement(case)
    if placement is None:
        return None
    skin = load_skin(case, cache)
    around = Surroundings(skin, load_couch(case, skin, cache))
    return CheckedPlacement(placement, placement_findings(case, around, placement, cache))


def placement_findings(
    case: Case, around: Surroundings, placement: Placement, cache: Cache = NO_CACHE
) -> tuple[Finding, ...]:
    """Check what places the robot: the markers, a mount, or a stated transform and the markers beside it.

    However it is stated, what physics says of the place of the base is told (`base_place`).

    Markers that agree with a transform are checked as those that place the robot are: who made the transform from the
    same two lists has the slip of a list in both.
    """
    skin = around.skin
    if placement.registration is not None:
        own = tuple(check_markers(case, around, placement.registration, cache))
        return (*place_warnings(case, skin.mesh, placement.T_base_ct, OF_MARKERS, cache.memory), *own)
    if case.robot.stated is None:
        return tuple(place_warnings(case, skin.mesh, placement.T_base_ct, OF_MOUNT, cache.memory))
    registration = marker_registration(case, case.robot.stated)
    said = tuple(check_transform(case, skin.mesh, placement.T_base_ct, registration))
    if registration is None:
        return said
    return (*said, *weak_points(registration), *check_markers(case, around, registration, cache))
