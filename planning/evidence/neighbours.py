"""Structures against each other: two organs cannot lie in one place, and meshes made together have alike triangles.

One small organ that is off among many that are right has too few edges to be told by the CT. But a body is full: what
lies elsewhere mostly lies in another organ too. How often that tells: ``python -m slips`` in ``tests``.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy
from puncture_twin.planning.anatomy.default_roles import BONES, LESION, VESSEL_WORDS, default_role, plain_name
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of
from puncture_twin.planning.geometry.voxelize import voxels_inside

CELL_MM = 2.0
MOST_CELLS = 30e6
"""Cells in which volumes are counted, wider where there would be more."""

LEAST_SHARED = 0.05
LEAST_CELLS = 20
"""Of the smaller one's volume, and of cells: less is what smoothing and partial volume move."""

NESTED = 0.95
"""From here on one lies in the other: a part, a vessel or a lesion does, and few organs do not."""

TUBES = (VESSEL_WORDS - {"aorta"}) | frozenset(
    (
        *("nerve", "nerves", "cord", "canal", "duct", "ducts", "bronchus", "bronchi", "trachea", "airway", "airways"),
        *("portal", "urethra", "ureter", "catheter", "stent", "electrode", "implant", "cava"),
    )
)
"""What runs into organs; but for the cord not into bones."""

TISSUES = frozenset(("fat", "muscle", "muscles", "tissue", "cavity", "compartment", "mediastinum", "peritoneum"))
"""What other structures are parts of, or lie in."""

COMPACT = frozenset(
    (
        *("liver", "spleen", "kidneys", "pancreas", "adrenal glands", "heart", "stomach and bowel"),
        *("gallbladder and bile ducts", "urinary bladder and ureters", "vertebrae, spine", "pelvis"),
    )
)
"""Groups of the table of default roles of which none lies in another one."""

ENLARGED = {"cm": 10.0, "m": 1000.0}
"""Units of a mesh that was read in mm."""

ALIKE, UNLIKE = 2.5, 4.0
"""Times by which the lengths of triangles of meshes that were made together may differ; and from where on they do."""

TRIANGLES = 2_000
"""Whose edges tell of a mesh's."""


class Shared(NamedTuple):
    """Two structures that lie in one place.

    Attributes:
        one, other: Rows of the structures; the first is the smaller.
        fraction: Of the smaller one's volume.
    """

    one: int
    other: int
    fraction: float
    ml: float


def shared(meshes: Sequence[TriangleMesh]) -> list[Shared]:
    """Pairs of closed surfaces that share volume: cells of a grid, where the smaller ones come last and are kept."""
    bounds = np.array([mesh.bounds for mesh in meshes])
    low, high = box_of(bounds.reshape(-1, 3))
    cell = max(CELL_MM, float(np.cbrt(np.prod(high - low) / MOST_CELLS)))
    first = np.floor((bounds[:, 0] - low) / cell).astype(int)
    count = np.ceil((bounds[:, 1] - low) / cell).astype(int) + 1 - first
    owner = np.full((first + count).max(axis=0), -1, np.int16)
    cells, found = np.zeros(len(meshes)), []
    for row in np.argsort(-np.prod(bounds[:, 1] - bounds[:, 0], axis=1), kind="stable"):
        T_ct_cell = np.diag([cell, cell, cell, 1.0])
        T_ct_cell[:3, 3] = low + cell * first[row]
        nx, ny, nz = (int(n) for n in count[row])
        inside = voxels_inside(meshes[row], T_ct_cell, (nx, ny, nz))
        part = owner[tuple(slice(f, f + n) for f, n in zip(first[row], count[row], strict=True))]
        cells[row] = np.count_nonzero(inside)
        both = np.bincount(part[inside] + 1, minlength=1)[1:]
        part[inside] = row
        for other in np.flatnonzero(both >= LEAST_CELLS):
            small, large = sorted((int(row), int(other)), key=lambda one: cells[one])
            found.append(Shared(small, large, float(both[other] / cells[small]), float(both[other] * cell**3 / 1000)))
    return found


def overlaps(case: Case, anatomy: Anatomy, cache: Cache) -> Iterator[Finding]:
    """Two structures in one place, unless their names say that one belongs into the other.

    Labels of one map, which lie in one place each, are not asked.
    """
    placed = [one for one in anatomy.structures if one.role is not Role.UNKNOWN and one.source != OWN_TARGET]
    placed = [one for one in placed if one.mesh.closed and len(one.mesh.faces)]
    if len({one.source.rpartition(":")[0] or one.source for one in placed}) < 2:
        return
    meshes = [one.mesh for one in placed]

    def make() -> Arrays:
        return {"pairs": np.array(shared(meshes), np.float64).reshape(-1, 4)}

    made_from = {"what": "shared volume", "meshes": [mesh.digest for mesh in meshes]}
    for row, other_row, fraction, ml in cache.arrays(made_from, make, by=__name__)["pairs"].tolist():
        one, other = placed[int(row)], placed[int(other_row)]
        if fraction >= LEAST_SHARED and not _belong(case, one, other, nested=fraction >= NESTED):
            said = f"'{one.name}' has {100 * fraction:.0f} % of its volume ({ml:.1f} ml) in '{other.name}'"
            numbers = {"fraction": round(fraction, 3), "ml": round(ml, 2), "names": f"{one.name}, {other.name}"}
            yield Finding("structures_overlap", Severity.WARNING, f"{said}: is each in the right place?", numbers)


def _belong(case: Case, one: Structure, other: Structure, *, nested: bool) -> bool:
    """Whether a structure may lie in another one: a part of it, a tube or a lesion within it, a piece of a tissue."""
    words, others = (set(plain_name(each.name).split("_")) for each in (one, other))
    line, other_line = (default_role(each.name, case.region or "other") for each in (one, other))
    if words <= others or others <= words or LESION in (line, other_line) or (words | others) & TISSUES:
        return True
    if nested:
        groups = {each.group for each in (line, other_line) if each is not None}
        return len(groups & COMPACT) < 2 or bool(words & TUBES)
    return bool((words | others) & TUBES) and ("cord" in words | others or not (words | others) & BONES)


def odd_units(anatomy: Anatomy) -> Iterator[Finding]:
    """A mesh whose triangles are as long as its siblings' in a larger unit, in which it would lie in the body too."""
    meshes = {one.name: one.mesh for one in anatomy.structures if one.voxel_ct is None and len(one.mesh.faces)}
    edges = {name: _edge_mm(mesh) for name, mesh in meshes.items()}
    low, high = anatomy.skin.mesh.bounds
    for (name, mesh), (unit, factor) in itertools.product(meshes.items(), ENLARGED.items()):
        rest = [edge for other, edge in edges.items() if other != name]
        if len(rest) < 2 or np.any(factor * mesh.bounds[0] < low) or np.any(factor * mesh.bounds[1] > high):
            continue
        times = float(np.median(rest)) / edges[name]
        if times > UNLIKE and max(times / factor, factor / times) < ALIKE:
            said = f"'{name}': its triangles are {times:.3g} times smaller than those of the other meshes"
            yield Finding("mesh_in_other_unit", Severity.WARNING, f"{said}: is it in {unit}?", {"times": times})


def _edge_mm(mesh: TriangleMesh) -> float:
    """The median length of a mesh's edges, of some of its triangles; above 0."""
    some: Floats = mesh.triangles[:: max(1, len(mesh.faces) // TRIANGLES)]
    lengths = np.linalg.norm(some - np.roll(some, 1, axis=1), axis=2)
    return max(float(np.median(lengths)), float(np.finfo(np.float32).tiny))
