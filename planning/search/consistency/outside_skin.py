"""Structures that lie outside the skin: an organ that is elsewhere protects nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy, Role, Structure
from puncture_twin.planning.anatomy.inside_skin import LEAST_TOLERANCE_MM, kept_inside_skin
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.search.consistency.volume_headers import Headers

USUAL_INSIDE = 0.99
"""Of a structure's area, inside the skin; a smaller fraction is a warning. One percent is what smoothing moves."""

LEAST_INSIDE = 0.9
"""A smaller fraction is refused: whatever the cause is, the organ is not where the search takes it to be."""

ALLOWED_INSIDE = (
    f"at least {100 * LEAST_INSIDE:g} % of a structure's surface inside the skin; "
    'role "unknown" for what is known to lie outside'
)

CAUSES = "a part of the body that the skin does not hold (such as an arm), or a slip of space (LPS/RAS) or unit?"


def outside_warnings(case: Case, anatomy: Anatomy, headers: Headers, cache: Cache) -> tuple[str, ...]:
    """An organ that is elsewhere protects nothing; what is `unknown`, or a ball about the target, may lie anywhere."""
    known = [structure for structure in anatomy.structures if structure.role is not Role.UNKNOWN]
    placed = [structure for structure in known if structure.source != OWN_TARGET]
    _refuse_wholly_outside(case, anatomy.skin, placed)
    if not anatomy.skin.mesh.closed:
        return ("the skin mesh is open: how much of each structure lies inside the body is not known",)
    skin_volume = case.skin_section.ct or case.skin_section.labelmap
    tolerances = np.array([_surface_tolerance_mm(structure, skin_volume, headers) for structure in placed])
    meshes = [structure.mesh for structure in placed]
    parts = kept_inside_skin(meshes, anatomy.skin, case.target_ct, tolerances, cache)
    warnings = []
    for structure, part in zip(placed, parts, strict=True):
        outside = f"{100 * (1 - part.fraction):.1f} % of its surface lies outside the skin"
        said = f"structure '{structure.name}': {outside}: {CAUSES}"
        if part.fraction < LEAST_INSIDE:
            raise InputError(said, where=case.path, allowed=ALLOWED_INSIDE)
        if part.fraction < USUAL_INSIDE:
            warnings.append(said)
    return tuple(warnings)


def _refuse_wholly_outside(case: Case, skin: Skin, structures: Sequence[Structure]) -> None:
    """Also where the skin is open, or its cut sides say nothing: no box of an organ lies beside the body's."""
    low, high = skin.mesh.bounds
    for structure in structures:
        below, above = structure.mesh.bounds
        if np.any(below > high) or np.any(above < low):
            raise InputError(
                f"structure '{structure.name}' lies wholly outside the skin: a slip of space (LPS/RAS) or unit?",
                where=case.path,
                allowed="structures that reach into the body",
            )


def _surface_tolerance_mm(structure: Structure, skin_volume: str | None, headers: Headers) -> float:
    """How far a structure's surface and the skin may be off: half a voxel each, and no less than a mesh may."""
    names = (skin_volume, structure.source.rpartition(":")[0])
    halves = [float(headers[name].spacing_mm.max()) / 2 for name in names if name and name in headers]
    return max(LEAST_TOLERANCE_MM, sum(halves))
