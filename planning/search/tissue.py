"""How much of other structures a path crosses on its way to the target."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Role, Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.containment import holds
from puncture_twin.planning.geometry.crossings import crossings


def tissue_crossed(
    structures: tuple[Structure, ...], target_structure: str, target_ct: Floats, outward_ct: Floats, path_length: Floats
) -> Floats:
    """Length of each path, target to skin, inside structures that may be crossed; shape (n,), mm.

    Counted are roles ``traverse`` and ``target``, but not the target's own structure, and only closed surfaces: of an
    open one the inside is not known. Nested structures count each.
    """
    total = np.zeros(len(outward_ct))
    for structure in structures:
        crossable = structure.role in {Role.TRAVERSE, Role.TARGET} and structure.name != target_structure
        if crossable and structure.mesh.closed:
            total += inside_length(structure, target_ct, outward_ct, path_length)
    return np.where(np.isnan(path_length), np.nan, total)


def inside_length(structure: Structure, target_ct: Floats, outward_ct: Floats, path_length: Floats) -> Floats:
    """Length of each path inside one closed structure, shape (n,), mm.

    Crossings alternate between leaving and entering, so the length is their alternating sum, closed by the path's
    end where the path ends inside.
    """
    found = crossings(structure.mesh, target_ct, outward_ct)
    starts_inside = holds(structure.mesh, target_ct)
    limit = np.nan_to_num(path_length, nan=0.0)
    number = np.arange(len(found.ray)) - found.first[found.ray]
    sign = np.where((number % 2 == 0) == starts_inside, 1.0, -1.0)
    signed = sign * np.minimum(found.depth, limit[found.ray])
    inside = np.bincount(found.ray, weights=signed, minlength=len(outward_ct))
    ends_inside = (found.count % 2 == 0) == starts_inside
    return np.asarray(np.maximum(inside + np.where(ends_inside, limit, 0.0), 0.0))
