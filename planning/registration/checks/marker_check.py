"""Can the markers be trusted? What their residuals cannot show: permuted names, slipped axes, markers off the skin."""

from __future__ import annotations

from typing import NamedTuple

from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.checks.axis_slips import check_axes
from puncture_twin.planning.registration.checks.marker_list import Surroundings, marker_list
from puncture_twin.planning.registration.checks.name_slips import check_names
from puncture_twin.planning.registration.checks.off_the_skin import off_the_skin
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


def check_markers(
    case: Case, around: Surroundings, registration: Registration, cache: Cache = NO_CACHE
) -> MarkerFindings:
    """Check a registration's markers against permuted names, half turns, skin and couch.

    How the markers lie on the skin depends on no target: ``cache`` keeps it.

    Raises:
        InputError: Names that fit much better permuted, or as well where nothing tells them apart; a list that lies on
            the skin only after a half turn.
    """
    names = check_names(case, around.skin, registration)
    given = marker_list(case, around, registration, cache=cache)
    local = case.space is Space.LOCAL
    axes = () if local else check_axes(case, around, registration, given, cache)
    warnings = (*names, *axes, *off_the_skin(registration, given))
    return MarkerFindings(warnings, (LOCAL_AXES, BASE_AXES) if local else (BASE_AXES,))
