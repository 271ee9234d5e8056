"""A placement whose markers, or stated transform, have been compared with what else is known."""

from __future__ import annotations

from typing import NamedTuple

from puncture_twin.planning.anatomy.anatomy import load_couch, load_skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.base_place import OF_MARKERS, OF_MOUNT, place_warnings
from puncture_twin.planning.registration.checks.marker_check import MarkerFindings, check_markers
from puncture_twin.planning.registration.checks.marker_list import Surroundings
from puncture_twin.planning.registration.checks.stated_transform import check_transform, markers_beside
from puncture_twin.planning.registration.placement import Placement, load_placement


class CheckedPlacement(NamedTuple):
    """A placement and what its checks found."""

    placement: Placement
    findings: MarkerFindings


def checked_placement(case: Case, cache: Cache) -> CheckedPlacement | None:
    """Where the patient lies for the robot, with its markers checked; None where the case does not say it.

    Raises:
        InputError: As `load_placement` and `placement_findings`, or a skin or CT that cannot be read.
    """
    placement = load_placement(case)
    if placement is None:
        return None
    skin = load_skin(case, cache)
    around = Surroundings(skin, load_couch(case, skin, cache))
    return CheckedPlacement(placement, placement_findings(case, around, placement, cache))


def placement_findings(
    case: Case, around: Surroundings, placement: Placement, cache: Cache = NO_CACHE
) -> MarkerFindings:
    """Check what places the robot: the markers, a mount, or a stated transform and the markers beside it.

    However it is stated, what physics says of the place of the base is told (`base_place`).

    Markers that agree with a transform are checked as those that place the robot are: who made the transform from the
    same two lists has the slip of a list in both.

    Raises:
        InputError: As `check_markers` and `check_transform`.
    """
    skin = around.skin
    if placement.registration is not None:
        found = check_markers(case, around, placement.registration, cache)
        place = place_warnings(case, skin.mesh, placement.T_base_ct, OF_MARKERS)
        return MarkerFindings((*place, *found.warnings), found.notes)
    if case.robot.stated is None:
        return MarkerFindings(tuple(place_warnings(case, skin.mesh, placement.T_base_ct, OF_MOUNT)), ())
    registration = markers_beside(case, case.robot.stated)
    said = check_transform(case, skin.mesh, placement.T_base_ct, registration)
    if registration is None:
        return said
    weak = tuple(f"registration: {flag}" for flag in registration.flags)
    own = check_markers(case, around, registration, cache)
    return MarkerFindings((*said.warnings, *weak, *own.warnings), (*said.notes, *own.notes))
