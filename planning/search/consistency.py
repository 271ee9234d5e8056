"""Do the inputs fit each other? What one file alone cannot tell: a slip of space or unit, a map that ends too early."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Role, Structure
from puncture_twin.planning.anatomy.default_roles import never_crossed
from puncture_twin.planning.anatomy.inside_skin import LEAST_TOLERANCE_MM, kept_inside_skin
from puncture_twin.planning.anatomy.label_grids import label_grids
from puncture_twin.planning.anatomy.own_target import OWN_TARGET
from puncture_twin.planning.anatomy.regions import absent_organs
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.triangle_distance import squared_distance
from puncture_twin.planning.geometry.winding import odd_fraction, winding_number
from puncture_twin.planning.registration.checks.marker_check import check_markers
from puncture_twin.planning.registration.checks.stated_transform import check_transform
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.search.constraints import longest_path
from puncture_twin.planning.search.resolution import resolution_warnings

Headers = Mapping[str, VolumeGrid]

USUAL_INSIDE = 0.99
"""Of a structure's area, inside the skin; a smaller fraction is a warning. One percent is what smoothing moves."""

LEAST_INSIDE = 0.9
"""A smaller fraction is refused: whatever the cause is, the organ is not where the search takes it to be."""

ALLOWED_INSIDE = (
    f"at least {100 * LEAST_INSIDE:g} % of a structure's surface inside the skin; "
    'role "unknown" for what is known to lie outside'
)

CAUSES = "a part of the body that the skin does not hold (such as an arm), or a slip of space (LPS/RAS) or unit?"

MOST_AROUND = 0.5
"""An open mesh may go so far around the target: of the rays that cross it oddly, and of its winding number."""


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
    outside = _outside_warnings(case, anatomy, headers, cache)
    _refuse_open_around_target(case, anatomy)
    return (
        *_target_warnings(case),
        *outside,
        *_marker_warnings(case, anatomy, placement, cache),
        *_needle_warnings(case, anatomy.skin),
        *resolution_warnings(case, anatomy, headers),
        *_region_warnings(case, anatomy),
    )


def _target_warnings(case: Case) -> tuple[str, ...]:
    """That the target is a vessel or the like: its structure is not avoided, so paths that end in it are safe."""
    line = never_crossed(case.target_structure)
    if line is None or case.own_target:
        return ()
    return (
        f"the target lies in '{case.target_structure}', of '{line.group}' ({line.reason}): every safe path ends in it; "
        "is the target's place right?",
    )


def _outside_warnings(case: Case, anatomy: Anatomy, headers: Headers, cache: Cache) -> tuple[str, ...]:
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


def volume_headers(case: Case) -> dict[str, VolumeGrid]:
    """The headers of the CT and the label maps that the case's structures come from, by file name.

    Raises:
        InputError: A header that cannot be trusted.
    """
    named = {section.ct for section in case.structure if section.ct is not None}
    files = sorted(named.union(*(grid.files for grid in label_grids(case))))
    return {name: case.volumes.source(name).grid for name in files}


def _refuse_open_around_target(case: Case, anatomy: Anatomy) -> None:
    """Of an open surface the inside is not known; but one that goes more than half around the target is no way out.

    Two numbers tell: rays from the target say it however the triangles are wound, and the winding number says it of
    shells in shells, which a ray leaves an even number of times. Neither is the inside, so none is claimed.
    """
    for structure in anatomy.structures:
        if not structure.demands_margin or structure.mesh.closed:
            continue
        odd, turns = odd_fraction(structure.mesh, case.target_ct), winding_number(structure.mesh, case.target_ct)
        if max(odd, abs(turns)) > MOST_AROUND:
            raise InputError(
                f"'{structure.name}' is an open mesh about the target: whether the target lies inside is not known "
                f"({100 * odd:.0f} % of all rays from it cross the mesh an odd number of times; winding number "
                f"{turns:.2f})",
                where=case.path,
                allowed="a closed mesh, or one that goes less than half around the target",
            )


def _needle_warnings(case: Case, skin: Skin) -> tuple[str, ...]:
    """A needle that is shorter than the shortest path from the target to the skin."""
    triangles = skin.mesh.triangles[~skin.cut_faces]
    if len(triangles) == 0:
        return ()
    nearest = float(np.sqrt(squared_distance(case.target_ct, triangles).min()))
    longest = longest_path(case.needle)
    if longest >= nearest:
        return ()
    said = f"the needle's longest path is {longest:g} mm, and the skin is {nearest:.1f} mm away"
    return (f"{said}: every path is too long",)


def _region_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """The usual organs of the case's region that nobody named: they count as free."""
    if case.region is None:
        return ()
    absent = absent_organs(case.region, [*(structure.name for structure in anatomy.structures), *anatomy.ignored])
    if not absent:
        return ()
    like = ", ".join(absent)
    return (f"region {case.region}: no structure is named like {like}; what has no structure counts as free",)


def _marker_warnings(case: Case, anatomy: Anatomy, placement: Placement | None, cache: Cache) -> tuple[str, ...]:
    if placement is None:
        return ()
    if placement.registration is None:
        return check_transform(case, anatomy.skin.mesh, placement.T_base_ct)
    weak = tuple(f"registration: {flag}" for flag in placement.registration.flags)
    return (*weak, *check_markers(case, anatomy.skin, placement.registration, cache).warnings)
