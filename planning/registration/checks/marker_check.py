"""Can the markers be trusted? What their residuals cannot show: permuted names, slipped axes, markers off the skin."""

from __future__ import annotations

from typing import NamedTuple

from puncture_twin.planning.anatomy.anatomy import load_skin
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.checks.axis_slips import check_axes
from puncture_twin.planning.registration.checks.marker_list import marker_list
from puncture_twin.planning.registration.checks.name_slips import check_names
from puncture_twin.planning.registration.checks.off_the_skin import off_the_skin
from puncture_twin.planning.registration.checks.stated_transform import check_transform
from puncture_twin.planning.registration.placement import Placement, load_placement
from puncture_twin.planning.registration.registration import Registration

LOCAL_AXES = 'space "local": nothing tells whether the axes of markers_ct have slipped by a half turn'

BASE_AXES = (
    "not checked: a half turn of markers_base (such as ROS base_link for the controller's base); residuals, skin and "
    "couch are blind to it"
)


class MarkerFindings(NamedTuple):
    """What is to be known about a case's markers or transform."""

    warnings: tuple[str, ...]
    """What these markers leave open, one sentence each."""
    notes: tuple[str, ...]
    """What no markers can show."""


class CheckedPlacement(NamedTuple):
    """A placement whose markers, or stated transform, have been compared with what else is known."""

    placement: Placement
    findings: MarkerFindings


def checked_placement(case: Case, cache: Cache) -> CheckedPlacement | None:
    """Where the patient lies for the robot, with its markers checked; None where the case does not say it.

    Raises:
        InputError: As `load_placement`, `check_markers` and `check_transform`, or a skin that cannot be read.
    """
    placement = load_placement(case)
    if placement is None:
        return None
    if placement.registration is None:
        said = () if case.robot.stated is None else _of_transform(case, placement, cache)
        return CheckedPlacement(placement, MarkerFindings(said, ()))
    return CheckedPlacement(placement, check_markers(case, load_skin(case, cache), placement.registration, cache))


def _of_transform(case: Case, placement: Placement, cache: Cache) -> tuple[str, ...]:
    return check_transform(case, load_skin(case, cache).mesh, placement.T_base_ct)


def check_markers(case: Case, skin: Skin, registration: Registration, cache: Cache = NO_CACHE) -> MarkerFindings:
    """Check a registration's markers against permuted names, half turns, skin and couch.

    How the markers lie on the skin depends on no target: ``cache`` keeps it.

    Raises:
        InputError: Names that fit much better permuted, or as well where nothing tells them apart; a list that lies on
            the skin only after a half turn.
    """
    names = check_names(case, skin, registration)
    given = marker_list(case, skin, registration, cache=cache)
    local = case.space is Space.LOCAL
    axes = () if local else check_axes(case, skin, registration, given, cache)
    warnings = (*names, *axes, *off_the_skin(registration, given))
    return MarkerFindings(warnings, (LOCAL_AXES, BASE_AXES) if local else (BASE_AXES,))
