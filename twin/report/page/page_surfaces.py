"""The surfaces that the page's slices cut: as they were checked, or lighter where the page cannot hold them.

A label map of 0.7 mm gives millions of triangles, most of them stairs of its voxels. `_lightened` smooths these by less
than `APART_MM`, lets the quadrics of Garland and Heckbert (fast-simplification) take triangles away, and then measures
how far the new surface is from the checked one, and back.
"""

import gzip
from collections.abc import Iterable
from typing import Any, NamedTuple

import fast_simplification
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Ints32
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.triangle_distance import lower_squares, squared_distance

MOST_TRIANGLES = 400_000  # of all surfaces: in base64 they take at most 2.5 MB of the page
APART_MM = 0.48  # how far lighter surfaces may be from the checked ones; half a millimetre with the rounding of these
MOST_APART_MM = 8.0  # nothing is made coarser than this: then a page is larger
UNIT_MM = 1 / 16  # to which corners are rounded; doubled until the farthest fits `MOST_UNITS`
FINER = 4  # parts of the unit to which surfaces are rounded that are made lighter
ROUNDED = 0.87  # units by which a corner moves at most: half the diagonal of a cube
MOST_UNITS = 32_000  # a corner's coordinates fit 16 bits
COARSE_MM = 32.0  # how coarse surfaces beyond the box are, and how far beyond: they are not drawn
SMOOTH, ROUNDS = 0.3, 3  # by how much of the allowed distance stairs are smoothed along each axis, and how often
QUADRIC = 2.0  # of the allowed distance, the root of the quadric up to which edges collapse: it sums over many planes
AGGRESSION, LAST_QUADRIC = 5.0, 1e-9 * 102.0**5
"""Settings of fast-simplification: its threshold grows with this power of the pass, to this in its last."""

NEAREST = 8  # corners about which triangles are looked at, where those of a place are far
MOST_ALONE = 40  # corners that are measured from all triangles
TRIES, LESS = 5, 0.85  # how often, each time with less of the distance, before a surface is left as it is
LEVEL = 6  # of gzip's


class Packed(NamedTuple):
    """Packed data of the page: facts as plain values, and bytes that are unpacked by a script."""

    facts: dict[str, Any]
    content: bytes


class _Part(NamedTuple):
    """A surface in whole units; the first triangles, so many, reach the box."""

    corners: Ints
    faces: Ints
    drawn: int


def surfaces(parts: Iterable[tuple[str, str, TriangleMesh]], target_ct: Floats, box_ct: Floats) -> Packed:
    """Surfaces, each with name and role, in a box (2, 3), mm; corners from the target (3,), in whole units.

    Where they have more than `MOST_TRIANGLES`, lighter ones; the facts state as ``off_mm`` how far any point of them is
    from the checked surface, and back. None vanishes but what is smaller than a unit. What lies beyond the box is only
    kept as far as it tells what is inside of a closed surface; the first triangles of each, ``drawn`` of them, are
    those that reach the box. Packed are differences of corners, and of each index how far it is from a new one.
    """
    box = box_ct - target_ct
    named = [
        (name, role, mesh.closed, _boxed(mesh.vertices - target_ct, mesh.faces, box)) for name, role, mesh in parts
    ]
    farthest = max((float(np.abs(boxed[0]).max(initial=0.0)) for *_, boxed in named), default=0.0)
    unit = UNIT_MM
    while farthest / unit > MOST_UNITS:
        unit *= 2
    few = sum(drawn for *_, (_, _, drawn) in named) <= MOST_TRIANGLES
    step = unit if few else unit / FINER
    whole = shown = [_rounded(vertices / step, faces, drawn) for *_, (vertices, faces, drawn) in named]
    apart, off = APART_MM, ROUNDED * step
    while not few and apart < MOST_APART_MM:
        lighter = [
            _lightened(np.multiply(one.corners, step, dtype=np.float64), one.faces.astype(np.int32), unit, box, apart)
            for one in whole
        ]
        shown, off = [one for one, _ in lighter], ROUNDED * step + max(far for _, far in lighter)
        few = sum(len(one.faces) for one in shown) <= MOST_TRIANGLES
        apart *= 2
    packed = [(one, part) for one, part in zip(named, shown, strict=True) if part.drawn or (one[2] and len(part.faces))]
    corners = [_planes(np.diff(part.corners, axis=0, prepend=0).T, 2) for _, part in packed]
    triangles = []
    for _, part in packed:
        index = part.faces.ravel()
        newest = np.maximum.accumulate(np.concatenate([[-1], index[:-1]])) + 1
        triangles.append(_planes(newest - index, 3))  # below the next that no index before had: 0 for a new one
    facts = [
        {"name": one[0], "role": one[1], "closed": one[2]}
        | {"corners": len(part.corners), "triangles": len(part.faces), "drawn": part.drawn}
        for one, part in packed
    ]
    content = gzip.compress(b"".join([*corners, *triangles]), LEVEL, mtime=0)
    return Packed({"unit_mm": unit, "off_mm": off, "parts": facts}, content)


def _planes(values: Ints, count: int) -> bytes:
    """Bytes of values, the lowest of all first, then the next of all: so they pack better."""
    return np.ascontiguousarray(values).astype("<i8").view(np.uint8).reshape(-1, 8)[:, :count].T.tobytes()


def _lightened(vertices: Floats, faces: Ints32, unit: float, box: Floats, apart_mm: float) -> tuple[_Part, float]:
    """A surface of fewer triangles, and how far it is at most from the given one in the box, and back, mm."""
    within = apart_mm
    for _ in range(TRIES if len(faces) > 1 else 0):
        scale = np.sqrt(LAST_QUADRIC) / (QUADRIC * within)
        smooth = _smoothed(vertices, faces, SMOOTH * within) * scale
        corners, left, collapsed = fast_simplification.simplify(
            smooth, faces, target_count=1, agg=AGGRESSION, return_collapses=True
        )
        corners, place = np.round(corners / (scale * unit)) * unit, _places(faces, len(vertices), collapsed)
        gone = (place[faces] < 0).all(axis=1)  # an island of few voxels stays as it is
        off = _farthest(vertices, faces[~gone], corners, left, place, box, apart_mm)
        if off <= apart_mm:
            corners, left = np.concatenate([corners, vertices]), np.concatenate([left, faces[gone] + len(corners)])
            break
        within *= LESS
    else:
        corners, left, off = vertices, faces, 0.0
    boxed, left, drawn = _boxed(corners, left, box)
    return _rounded(boxed / unit, left, drawn), max(off, ROUNDED * unit)


def _smoothed(vertices: Floats, faces: Ints32, most_mm: float) -> Floats:
    """Each corner toward the mean of its neighbours, by so much along each axis at most."""
    times = np.maximum(1, 2 * np.bincount(faces.ravel(), minlength=len(vertices)))[:, None]
    smoothed = vertices
    for _ in range(ROUNDS):
        neighbours = smoothed[faces[:, [1, 2, 0]]] + smoothed[faces[:, [2, 0, 1]]]
        sums = [np.bincount(faces.ravel(), neighbours[..., axis].ravel(), len(vertices)) for axis in range(3)]
        smoothed = vertices + np.clip(np.stack(sums, axis=1) / times - vertices, -most_mm, most_mm)
    return smoothed


def _places(faces: Ints32, count: int, collapsed: Ints) -> Ints:
    """Index of each corner among those left, -1 where its triangles are all gone."""
    root = np.arange(count)
    root[collapsed[:, 1]] = collapsed[:, 0]
    while (root[root] != root).any():
        root = root[root]
    corners = root[faces]
    left = np.unique(corners[(corners != np.roll(corners, 1, axis=1)).all(axis=1)])
    place = np.full(count, -1)
    place[left] = np.arange(len(left))
    return place[root]


def _farthest(
    vertices: Floats, faces: Ints32, lighter: Floats, left: Ints32, place: Ints, box: Floats, near_mm: float
) -> float:
    """Bound on how far corners of either surface are from the other, mm, in the box.

    First they are measured from what came to the place to which they went; those farther than `near_mm` from what is
    about their nearest corners, and few that are left from all.
    """
    if place.max(initial=-1) + 1 != len(lighter):
        return np.inf
    there, back = np.where(_in(vertices, box), np.inf, 0.0), np.where(_in(lighter, box), np.inf, 0.0)
    ours = np.zeros(len(vertices), bool)
    ours[faces] = True
    there[~ours] = 0.0
    came = faces[(place[faces] >= 0).all(axis=1)]
    rows = np.flatnonzero(np.isinf(there) & (place >= 0))
    _lower(lighter, left, vertices, rows, place[rows], there)
    each = np.arange(len(lighter))
    lower_squares(vertices[came], place[came], np.arange(len(lighter) + 1), each, lighter, back)
    for points, squares, corners, triangles in ((vertices, there, lighter, left), (lighter, back, vertices, faces)):
        rows = np.flatnonzero(squares > near_mm**2)
        if len(rows):
            _, nearest = cKDTree(corners).query(points[rows], NEAREST)
            for column in nearest.T:
                _lower(corners, triangles, points, rows, column, squares)
        rows = np.flatnonzero(squares > near_mm**2)[:MOST_ALONE]
        for row in rows if len(triangles) else ():
            squares[row] = squared_distance(points[row], corners[triangles]).min()
    return float(np.sqrt(max(there.max(initial=0.0), back.max(initial=0.0))))


def _in(points: Floats, box: Floats) -> Bools:
    return ((points >= box[0]) & (points <= box[1])).all(axis=1)


def _lower(corners: Floats, triangles: NDArray[Any], points: Floats, rows: Ints, place: Ints, squares: Floats) -> None:
    """Lower the squared distances of some points to those from the triangles about one corner each."""
    order = np.argsort(place, kind="stable")
    starts = np.searchsorted(place[order], np.arange(len(corners) + 1))
    about = triangles[(np.diff(starts)[triangles] > 0).any(axis=1)].astype(np.int64)
    lower_squares(corners[about], about, starts, rows[order], points, squares)


def _boxed(vertices: Floats, faces: Ints32, box: Floats) -> tuple[Floats, Ints32, int]:
    """Triangles that reach a box first, and their number; the corners of all others drawn near, and coarse.

    Each of these others lies beyond one face of the box with all of its corners, before and after: what is inside of a
    closed surface, for a point in the box, stays so.
    """
    corner = vertices[faces]
    reach = ((corner.max(axis=1) >= box[0]) & (corner.min(axis=1) <= box[1])).all(axis=1)
    exact = np.zeros(len(vertices), bool)
    exact[faces[reach]] = True
    coarse = np.clip(np.round(vertices / COARSE_MM) * COARSE_MM, *box)
    beyond = np.where(vertices > box[1], box[1] + COARSE_MM, np.where(vertices < box[0], box[0] - COARSE_MM, coarse))
    placed = np.where(exact[:, None], vertices, beyond)
    return placed, np.concatenate([faces[reach], faces[~reach]]), int(reach.sum())


def _rounded(vertices: Floats, faces: Ints32, drawn: int) -> _Part:
    """Whole corners, each once and in the order of first use; the triangles left of these, and of those to be drawn.

    Of the others two in one place cancel out.
    """
    used, index = np.unique(faces, return_inverse=True)
    whole = np.round(vertices[used]).astype(np.int64)
    key = ((whole + (1 << 20)) << np.array([42, 21, 0])).sum(axis=1)  # one number a corner: 21 bits an axis
    _, merged = np.unique(key, return_inverse=True)
    triangles = merged[index.reshape(-1, 3)]
    apart = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    near, others = triangles[:drawn][apart[:drawn]], triangles[drawn:][apart[drawn:]]
    _, one, count = np.unique(np.sort(others, axis=1), axis=0, return_index=True, return_counts=True)
    left = np.concatenate([near, others[np.sort(one[count % 2 == 1])]])
    used, first = np.unique(left, return_index=True)
    order = np.argsort(first)
    place = np.zeros(len(whole), np.int64)
    place[used[order]] = np.arange(len(order))
    corner = np.zeros((len(whole), 3), np.int64)
    corner[merged] = whole
    return _Part(corner[used[order]], place[left], len(near))
