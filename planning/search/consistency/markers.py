"""What weakens the markers, or the stated transform, and what they leave open."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.checks.marker_check import check_markers
from puncture_twin.planning.registration.checks.stated_transform import check_transform
from puncture_twin.planning.registration.placement import Placement


def marker_warnings(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache) -> tuple[str, ...]:
    """Warnings, one sentence each; none where nothing places the base.

    Raises:
        InputError: Names or axes that have likely slipped, see `check_markers`, or a transform that cannot be.
    """
    if placement is None:
        return ()
    if placement.registration is None:
        return check_transform(case, anatomy.skin.mesh, placement.T_base_ct)
    weak = tuple(f"registration: {flag}" for flag in placement.registration.flags)
    return (*weak, *check_markers(case, anatomy.skin, placement.registration, cache).warnings)
