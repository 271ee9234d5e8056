"""How much of a structure's surface lies inside the skin: what lies elsewhere protects nothing.

Structures against each other: two organs cannot lie in one place, and meshes made together have alike triangles. One
small organ that is off among many that are right has too few edges to be told by the CT. But a body is full: what lies
elsewhere mostly lies in another organ too. How often that tells: ``python -m slips`` in ``tests``.
"""

import itertools
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.anatomy.anatomy import OWN_TARGET, Anatomy
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.default_roles import BONES, LESION, VESSEL_WORDS, default_role, plain_name, words
from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.containment import consistent_crossings, crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, spread_on
from puncture_twin.planning.geometry.parts import voxels_inside
from puncture_twin.planning.geometry.triangle_distance import squared_distance

CELL_MM, MOST_CELLS = 2.0, 30e6
"""Cells in which volumes are counted, wider where there would be more."""
LEAST_SHARED, LEAST_CELLS = 0.05, 20
"""Of the smaller one's volume, and of cells: less is what smoothing and partial volume move."""
NESTED = 0.95
"""From here on one lies in the other: a part, a vessel or a lesion does, and few organs do not."""

TUBES = (VESSEL_WORDS - {"aorta"}) | words("""
    nerve nerves cord canal duct ducts bronchus bronchi trachea airway airways portal urethra ureter catheter stent
    electrode implant cava
""")
"""Words of tubes, which run into organs; but for the cord not into bones."""
TISSUES = words("fat muscle muscles tissue cavity compartment mediastinum peritoneum")
"""Words of tissues that other structures are parts of, or lie in."""

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
    """Two structures, by their rows, that lie in one place; the fraction is of the first one's volume, the smaller."""

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
    cells, pairs = np.zeros(len(meshes)), []
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
            pairs.append(Shared(small, large, float(both[other] / cells[small]), float(both[other] * cell**3 / 1000)))
    return pairs


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


SAMPLES = 1000
"""Points on a structure's surface, each for the same area: a fraction is found to 0.1 %."""
AIMS = 100
"""Lines along which a point inside the skin is sought."""
LEAST_TOLERANCE_MM = 2.0
"""A point this near to the skin counts as inside. Surfaces of label maps run up to half a voxel outside of the organ, a
skin from a CT up to half a voxel inside of the dermis, and meshes of other programs are smoothed by about as much."""
USUAL_INSIDE = 0.99
"""Of a structure's area, inside the skin; a smaller fraction is a warning. One percent is what smoothing moves."""
LEAST_INSIDE = 0.9
"""A smaller fraction is refused: whatever the cause is, the organ is not where the search takes it to be."""
CODE = "outside_skin"
ALLOWED_INSIDE = (
    f"at least {100 * LEAST_INSIDE:g} % of a structure's surface inside the skin; "
    'role "unknown" for a structure known to lie outside'
)
CAUSES = "a part of the body outside the skin (such as an arm), or the wrong space (LPS/RAS) or unit?"


class Inside(NamedTuple):
    """Where the samples of one surface lie; what is beyond a side at which the skin was cut says nothing."""

    inside: int
    outside: int
    beyond: int

    @property
    def fraction(self) -> float:
        """Of the surface's area, 0..1, as far as the skin can tell; 0 where all of it lies beyond a cut."""
        return self.inside / max(self.inside + self.outside, 1)


def inside_skin(meshes: Sequence[TriangleMesh], skin: Skin, tolerance_mm: Floats) -> list[Inside]:
    """Count which part of each surface lies inside a closed skin.

    A ray from a point inside the body leaves it an odd number of times. A sample lies inside if an even number of these
    crossings comes before it. The point is the skin's own, so that the answer is the same for every target. A sample of
    a structure that is as near to the skin as its tolerance (k,) counts as inside.
    """
    points = np.concatenate([spread_on(mesh, SAMPLES).points for mesh in meshes] or [np.empty((0, 3))])
    reach = np.repeat(np.asarray(tolerance_mm, dtype=np.float64), SAMPLES)
    outside = np.flatnonzero(~_before_skin(points, skin))
    outside = outside[~near_surface(points[outside], skin.mesh, reach[outside])]
    beyond = _beyond_cut(points[outside], skin.field_of_view, reach[outside])
    lost = np.bincount(outside[~beyond] // SAMPLES, minlength=len(meshes))
    cut = np.bincount(outside[beyond] // SAMPLES, minlength=len(meshes))
    return [Inside(SAMPLES - int(o) - int(c), int(o), int(c)) for o, c in zip(lost, cut, strict=True)]


def near_surface(points: Floats, mesh: TriangleMesh, distance_mm: Floats) -> Bools:
    """Which points (n, 3) lie within their distance (n,) of a surface; exact.

    Triangles are looked up by their centres, those of about one size together: a few large ones do not make every
    look-up wide.
    """
    near = np.zeros(len(points), bool)
    if len(points) == 0:
        return near
    corners = mesh.triangles
    centres = (corners[:, 0] + corners[:, 1] + corners[:, 2]) / 3.0
    reach = np.sqrt(np.max([((corners[:, k] - centres) ** 2) @ np.ones(3) for k in range(3)], axis=0))
    size = np.ceil(np.log2(np.maximum(reach, distance_mm.min())))
    around_mm = (reach + distance_mm.max())[:, None]
    seen = np.all((centres >= points.min(axis=0) - around_mm) & (centres <= points.max(axis=0) + around_mm), axis=1)
    for one in np.unique(size[seen]):
        rows, left = np.flatnonzero(seen & (size == one)), np.flatnonzero(~near)
        neighbours = scipy.spatial.cKDTree(centres[rows]).query_ball_point(points[left], distance_mm[left] + 2.0**one)
        point = np.repeat(left, [len(some) for some in neighbours])
        triangle = rows[[row for some in neighbours for row in some]]
        squares = squared_distance(points[point], corners[triangle])
        near[point[squares <= distance_mm[point] ** 2]] = True
    return near


def _inner_point(mesh: TriangleMesh) -> Floats:
    """A point deep in a closed surface: of some lines from beside it the middle of the longest first way through."""
    (low, high), margin = mesh.bounds, np.array([LEAST_TOLERANCE_MM, 0.0, 0.0])
    start = np.array([low[0], *(low + high)[1:] / 2.0]) - margin
    away = spread_on(mesh, AIMS).points - start
    away /= np.linalg.norm(away, axis=1, keepdims=True)
    crossed = crossings(mesh, start, away)
    first = crossed.first[(crossed.count > 0) & (crossed.count % 2 == 0)]
    if len(first) == 0:
        return np.asarray((low + high) / 2.0)
    into = first[np.argmax(crossed.depth[first + 1] - crossed.depth[first])]
    return np.asarray(start + away[crossed.ray[into]] * crossed.depth[into : into + 2].mean())


def _before_skin(points: Floats, skin: Skin) -> Bools:
    """Which points the ray from inside meets before it has left the skin, or after it has come in again."""
    inner_ct = _inner_point(skin.mesh)
    away = points - inner_ct
    distance = np.linalg.norm(away, axis=1)
    away[distance == 0] = (0.0, 0.0, 1.0)
    crossed, _ = consistent_crossings(skin.mesh, inner_ct, away / np.where(distance == 0, 1.0, distance)[:, None])
    before = crossed.ray[crossed.depth < distance[crossed.ray]]
    return np.bincount(before, minlength=len(points)) % 2 == 0


def _beyond_cut(points: Floats, view: FieldOfView | None, tolerance_mm: Floats) -> Bools:
    """Which points (n, 3) lie farther than their tolerance (n,) beyond a side at which the skin was cut."""
    if view is None:
        return np.zeros(len(points), bool)
    low = view.to_box(points)
    outward = np.stack([-low, low - view.size_mm], axis=2)
    return np.asarray(np.any((outward > tolerance_mm[:, None, None]) & view.cut, axis=(1, 2)))


def outside_skin(case: Case, anatomy: Anatomy, cache: Cache) -> Iterator[Finding]:
    """Findings on organs outside the skin, but for `unknown` ones and the target's own ball, which may lie there."""
    known = [structure for structure in anatomy.structures if structure.role is not Role.UNKNOWN]
    placed = [structure for structure in known if structure.source != OWN_TARGET]
    elsewhere = [structure for structure in placed if _wholly_outside(anatomy.skin, structure)]
    if elsewhere:
        said = f"structure '{elsewhere[0].name}' is completely outside the skin: wrong space (LPS/RAS) or unit?"
        yield Finding(CODE, Severity.REFUSAL, said, way_out="structures that reach into the body")
        return
    if not anatomy.skin.mesh.closed:
        said = "the skin mesh is open: the part of each structure inside the body is not known"
        yield Finding("skin_open", Severity.WARNING, said)
        return
    volume, view = case.skin_section.ct or case.skin_section.labelmap, anatomy.skin.field_of_view
    skin_mm = 0.0 if volume is None else float(case.volumes.source(volume).grid.spacing_mm.max())
    # Surface and skin may be off by half a voxel each, and no less than a mesh may.
    tolerances = [max(LEAST_TOLERANCE_MM, (skin_mm + structure.voxel_mm) / 2) for structure in placed]
    meshes = [structure.mesh for structure in placed]
    seen = None if view is None else [view.T_ct_box.tolist(), view.size_mm.tolist(), view.cut.tolist()]
    made_from = {"what": "inside the skin", "skin": [anatomy.skin.mesh.digest, seen], "at": tolerances}
    made_from |= {"meshes": [mesh.digest for mesh in meshes]}

    def make() -> Arrays:
        counts = inside_skin(meshes, anatomy.skin, np.array(tolerances))
        return {"counts": np.array(counts, np.int64).reshape(-1, 3)}

    counts = cache.arrays(made_from, make, by=__name__)["counts"].tolist()
    for structure, part in zip(placed, (Inside(*one) for one in counts), strict=True):
        if part.inside + part.outside == 0:
            said = f"structure '{structure.name}' is completely beyond a side at which the skin was cut"
            yield Finding("beyond_skin", Severity.WARNING, said)
        elif part.fraction < USUAL_INSIDE:
            outside = f"{100 * (1 - part.fraction):.1f} % of its surface lies outside the skin"
            said = f"structure '{structure.name}': {outside}: {CAUSES}"
            severity = Severity.REFUSAL if part.fraction < LEAST_INSIDE else Severity.WARNING
            yield Finding(CODE, severity, said, {"inside": round(part.fraction, 4)}, ALLOWED_INSIDE)


def _wholly_outside(skin: Skin, structure: Structure) -> bool:
    """Also where the skin is open, or its cut sides say nothing: no box of an organ lies beside the body's."""
    (low, high), (below, above) = skin.mesh.bounds, structure.mesh.bounds
    if _beyond_cut(structure.mesh.bounds, skin.field_of_view, np.zeros(2)).all():
        return False
    return bool(np.any(below > high) or np.any(above < low))
