"""Do the inputs fit each other? What one file alone cannot tell: a slip of space or unit, a map that ends too early."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.search.consistency.around_target import refuse_open_around_target
from puncture_twin.planning.search.consistency.markers import marker_warnings
from puncture_twin.planning.search.consistency.needle_length import needle_warnings
from puncture_twin.planning.search.consistency.outside_skin import outside_warnings
from puncture_twin.planning.search.consistency.resolution import resolution_warnings
from puncture_twin.planning.search.consistency.target_space import space_warnings
from puncture_twin.planning.search.consistency.target_vessel import target_warnings
from puncture_twin.planning.search.consistency.usual_organs import region_warnings
from puncture_twin.planning.search.consistency.volume_headers import volume_headers


def check_consistency(
    case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache = NO_CACHE
) -> tuple[str, ...]:
    """Hold the inputs against each other; ``cache`` keeps what takes long.

    Returns:
        Warnings, one sentence each.

    Raises:
        InputError: A structure of which too much lies outside the body, an open one that may hold the target, or
            markers whose names or axes have likely slipped, or a stated transform that cannot be.
    """
    headers = volume_headers(case)
    outside = outside_warnings(case, anatomy, headers, cache)
    refuse_open_around_target(case, anatomy)
    return (
        *target_warnings(case),
        *space_warnings(case, anatomy),
        *outside,
        *marker_warnings(case, anatomy, placement, cache),
        *needle_warnings(case, anatomy.skin),
        *resolution_warnings(case, anatomy, headers),
        *region_warnings(case, anatomy),
    )
