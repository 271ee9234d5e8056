"""What weakens the markers, or the stated transform, and what they leave open."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.checked_placement import placement_findings
from puncture_twin.planning.registration.checks.marker_list import Surroundings
from puncture_twin.planning.registration.placement import Placement


def marker_warnings(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache) -> tuple[str, ...]:
    """Warnings, one sentence each; none where nothing places the base.

    Raises:
        InputError: Names or axes that have likely slipped, or a transform that cannot be; see `placement_findings`.
    """
    if placement is None:
        return ()
    weak = () if placement.registration is None else placement.registration.flags
    found = placement_findings(case, Surroundings(anatomy.skin, anatomy.couch), placement, cache)
    return (*(f"registration: {flag}" for flag in weak), *found.warnings)
