"""A placement whose markers, or stated transform, have been compared with what else is known."""

from __future__ import annotations

from typing import NamedTuple

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.marker_check import MarkerFindings, check_markers
from puncture_twin.planning.registration.checks.stated_transform import check_transform, markers_beside
from puncture_twin.planning.registration.placement import Placement, load_placement

NOTHING = MarkerFindings((), ())


class CheckedPlacement(NamedTuple):
    """A placement and what its checks found."""

    placement: Placement
    findings: MarkerFindings


def checked_placement(case: Case, cache: Cache) -> CheckedPlacement | None:
    """Where the patient lies for the robot, with its markers checked; None where the case does not say it.

    Raises:
        InputError: As `load_placement` and `placement_findings`, or a skin that cannot be read.
    """
    placement = load_placement(case)
    if placement is None:
        return None
    if placement.registration is None and case.robot.stated is None:
        return CheckedPlacement(placement, NOTHING)
    return CheckedPlacement(placement, placement_findings(case, load_skin(case, cache), placement, cache))


def placement_findings(case: Case, skin: Skin, placement: Placement, cache: Cache = NO_CACHE) -> MarkerFindings:
    """Check what places the robot: the markers, or a stated transform and the markers beside it.

    Markers that agree with a transform are checked as those that place the robot are: who made the transform from the
    same two lists has the slip of a list in both.

    Raises:
        InputError: As `check_markers` and `check_transform`.
    """
    if placement.registration is not None:
        return check_markers(case, skin, placement.registration, cache)
    if case.robot.stated is None:
        return NOTHING
    registration = markers_beside(case, case.robot.stated)
    said = check_transform(case, skin.mesh, placement.T_base_ct, registration)
    if registration is None:
        return MarkerFindings(said, ())
    weak = tuple(f"registration: {flag}" for flag in registration.flags)
    own = check_markers(case, skin, registration, cache)
    return MarkerFindings((*said, *weak, *own.warnings), own.notes)
