"""Triangle meshes of the planner: checked, read-only, in mm; and several of them as the arrays of one cache entry."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, is_frozen, read_only
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.text import Shown, brief
from puncture_twin.planning.geometry.rigid import apply

Faces = NDArray[np.int32]

MIXED = np.array([0x9E3779B97F4A7C15, 0xC2B2AE3D27D4EB4F, 0x165667B19E3779F9], np.uint64)
"""Odd numbers without a pattern: weights of a place's coordinates, as bits, in a sum that tells nearly all apart."""
BOX_CORNERS = np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
BOX_SIDES = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
BOX_FACES = np.array([triangle for a, b, c, d in BOX_SIDES for triangle in ((a, b, c), (a, c, d))])
"""Corners (8, 3) of the unit cube about the origin; its sides, corners in order, seen from outside to the left; and
these as triangles, (12, 3)."""
MOST_IN_ONE = 2_000_000
"""So many places give triples that fit in 63 bits."""


@dataclass(frozen=True, eq=False)
class TriangleMesh(Shown):
    """Vertices (n, 3), mm, and triangles (m, 3) of a surface. Any instance may be trusted: the guard has passed it."""

    vertices: Floats  # shape (n, 3), float64, mm
    faces: Faces  # shape (m, 3), int32, indices into ``vertices``

    @brief
    def __repr__(self) -> str:
        return f"{len(self.vertices):,} vertices, {len(self.faces):,} triangles"

    def __post_init__(self) -> None:
        for name, dtype in (("vertices", np.float64), ("faces", np.int32)):
            array = getattr(self, name)
            if not is_frozen(array, dtype):
                array = np.array(array, dtype=dtype, order="C")
                array.setflags(write=False)
                object.__setattr__(self, name, array)

    def known(self, *, closed: bool, wound_alike: bool) -> TriangleMesh:
        """A mesh whose `closed` and `wound_alike` were found before and need not be found again."""
        vars(self).update(closed=closed, wound_alike=wound_alike)
        return self

    @property
    def triangles(self) -> NDArray[np.float64]:
        """Corner coordinates, shape (m, 3, 3), mm; made anew each time: they take six times what the mesh holds."""
        return np.take(self.vertices, self.faces, axis=0)

    @cached_property
    def closed(self) -> bool:
        """Whether there is an inside: every edge of welded vertices has an even number of triangles."""
        if self.wound_alike and self.distinct.any():
            return True  # as many triangles run an edge one way as the other
        a, b, c = self._welded[self.distinct].T
        ends = np.stack([np.concatenate([a, b, c]), np.concatenate([b, c, a])])
        edges = np.sort(ends.min(axis=0) * len(self.vertices) + ends.max(axis=0))
        starts = np.flatnonzero(np.r_[True, edges[1:] != edges[:-1], True])
        return bool(len(edges) and np.all(np.diff(starts) % 2 == 0))

    @cached_property
    def distinct(self) -> NDArray[np.bool_]:
        """Which triangles have three corners in different places and are not given before, shape (m,)."""
        a, b, c = self._welded.T
        least, most = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        return (a != b) & (b != c) & (c != a) & _first_of_equals(least, a + b + c - least - most, most)

    @cached_property
    def wound_alike(self) -> bool:
        """Whether every edge is run as often one way as the other: else no side of the surface is its outer side.

        Not where a triangle is given again: both ways round, it has no side, and its solid angle is undone.
        """
        a, b, c = self._welded.T
        if not (self.distinct | (a == b) | (b == c) | (c == a)).all():
            return False
        starts, ends = np.concatenate([a, b, c]), np.concatenate([b, c, a])
        count = len(self.vertices)
        return bool(np.array_equal(np.sort(starts * count + ends), np.sort(ends * count + starts)))

    @cached_property
    def _welded(self) -> NDArray[np.int64]:
        """Numbers of the corners' places, equal where the coordinates are, shape (m, 3)."""
        places = self.vertices + 0.0  # makes -0.0 equal to 0.0
        bits = places.view(np.uint64)
        if _all_differ((bits ^ bits >> 32) @ MIXED):  # as of most surfaces; equal places have equal sums
            return self.faces.astype(np.int64)
        _, welded = np.unique(places.view(np.dtype((np.void, 24))).reshape(-1), return_inverse=True)
        return np.asarray(welded[self.faces], dtype=np.int64)

    @cached_property
    def digest(self) -> str:
        """Hexadecimal SHA-256 of its vertices and faces: two meshes of one digest are the same to the bit."""
        digest = hashlib.sha256(f"{self.vertices.shape} {self.faces.shape} ".encode())
        digest.update(self.vertices.data)
        digest.update(self.faces.data)
        return digest.hexdigest()

    @property
    def nbytes(self) -> int:
        """Bytes of vertices and faces."""
        return self.vertices.nbytes + self.faces.nbytes

    @cached_property
    def bounds(self) -> NDArray[np.float64]:
        """Lowest and highest corner of the axis-aligned box, shape (2, 3), mm."""
        return read_only(box_of(self.vertices))

    @property
    def areas(self) -> Floats:
        """Of each triangle, shape (m,), mm^2."""
        areas = np.empty(len(self.faces))
        _areas(self.vertices, self.faces, areas)
        return areas

    @property
    def volume(self) -> float:
        """Enclosed volume where the mesh is closed, mm^3; negative where its triangles face inward."""
        return float(_volume(self.vertices, self.faces, self.bounds.mean(axis=0)))

    def transformed(self, T_b_a: NDArray[np.float64]) -> TriangleMesh:
        """The surface in frame b, by the map (4, 4), mm, of this mesh's frame a to it."""
        return TriangleMesh(apply(T_b_a, self.vertices), self.faces)


class Spread(NamedTuple):
    """Points on a surface (n, 3), mm, and the unit normals (n, 3) of their triangles, as these are wound."""

    points: Floats
    normals: Floats


def spread_on(mesh: TriangleMesh, count: int) -> Spread:
    """Points spread evenly over a surface's area, ``count`` of them, the same in every run.

    Along the triangles by cumulative area, within a triangle by the R2 sequence (Roberts 2018), folded at its diagonal.
    """
    area = np.cumsum(mesh.areas)
    number = np.arange(count)
    at = np.minimum(np.searchsorted(area, (number + 0.5) / count * area[-1]), len(area) - 1)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[at]], 1, 0)
    normal = np.cross(b - a, c - a)
    u, v = (0.5 + 0.7548776662466927 * number) % 1.0, (0.5 + 0.5698402909980532 * number) % 1.0
    folded = u + v > 1.0
    u, v = np.where(folded, 1.0 - u, u)[:, None], np.where(folded, 1.0 - v, v)[:, None]
    normals = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), np.finfo(float).tiny)
    return Spread(np.asarray(a + u * (b - a) + v * (c - a)), normals)


@nb.njit(cache=True)
def _areas(vertices: Any, faces: Any, areas: Any) -> None:
    for f in range(len(faces)):
        i, j, k = faces[f]
        x, y, z = _cross(_from(vertices, j, vertices[i]), _from(vertices, k, vertices[i]))
        areas[f] = np.sqrt(x * x + y * y + z * z) / 2.0


@nb.njit(cache=True)
def _volume(vertices: Any, faces: Any, middle: Any) -> Any:
    total = 0.0
    for f in range(len(faces)):
        i, j, k = faces[f]
        a = _from(vertices, i, middle)
        x, y, z = _cross(_from(vertices, j, middle), _from(vertices, k, middle))
        total += a[0] * x + a[1] * y + a[2] * z
    return total / 6.0


@nb.njit(cache=True)
def _from(vertices: Any, row: Any, point: Any) -> Any:
    return vertices[row, 0] - point[0], vertices[row, 1] - point[1], vertices[row, 2] - point[2]


@nb.njit(cache=True)
def _cross(a: Any, b: Any) -> Any:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


def joined(meshes: Sequence[TriangleMesh]) -> TriangleMesh:
    """Several surfaces of one frame as one mesh; a single one is returned itself."""
    if len(meshes) == 1:
        return meshes[0]
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]], dtype=np.int32)
    vertices = np.concatenate([mesh.vertices for mesh in meshes])
    faces = np.concatenate([mesh.faces + start for mesh, start in zip(meshes, starts, strict=True)])
    for array in (vertices, faces):
        array.setflags(write=False)  # nobody else has it: it is taken as it is
    return TriangleMesh(vertices, faces)


def box(T: Floats, size: Floats | Sequence[float]) -> TriangleMesh:
    """A cuboid about the origin of a frame that ``T`` (4, 4) takes elsewhere, with full edge lengths ``size`` (3,)."""
    return TriangleMesh(apply(T, BOX_CORNERS * np.asarray(size, dtype=np.float64)), BOX_FACES)


def box_of(points: Floats) -> NDArray[np.float64]:
    """Lowest and highest corner of the axis-aligned box about points (n, d), shape (2, d)."""
    columns = points.T  # one by one: numpy is five times slower with axis=0
    return np.array([[column.min() for column in columns], [column.max() for column in columns]])


def _all_differ(numbers: NDArray[Any]) -> bool:
    ordered = np.sort(numbers)
    return bool((ordered[1:] != ordered[:-1]).all())


def _first_of_equals(a: NDArray[np.int64], b: NDArray[np.int64], c: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Which triples of numbers, each (m,) and at least 0, are the first of those that are equal, shape (m,)."""
    count = int(max(a.max(initial=0), b.max(initial=0), c.max(initial=0))) + 1
    pairs = a * count + b
    if count > MOST_IN_ONE:
        pairs = np.unique(pairs, return_inverse=True)[1].astype(np.int64)  # fewer than 2^31: a mesh has no more faces
    triples = pairs * count + c
    if _all_differ(triples):
        return np.ones(len(a), bool)
    _, first = np.unique(triples, return_index=True)
    fresh = np.zeros(len(a), bool)
    fresh[first] = True
    return fresh


def packed_meshes(meshes: Sequence[TriangleMesh]) -> dict[str, NDArray[Any]]:
    """All vertices and faces of some meshes, one after the other, and how many each has, shape (k, 2)."""
    return {
        "sizes": np.array([(len(mesh.vertices), len(mesh.faces)) for mesh in meshes], np.int64).reshape(-1, 2),
        "vertices": np.concatenate([np.empty((0, 3)), *(mesh.vertices for mesh in meshes)]),
        "faces": np.concatenate([np.empty((0, 3), np.int32), *(mesh.faces for mesh in meshes)]),
    }


def unpacked_meshes(arrays: dict[str, NDArray[Any]]) -> tuple[TriangleMesh, ...]:
    """The meshes of `packed_meshes`, equal to the bit. Raises KeyError, ValueError: These arrays are none."""
    ends = np.cumsum(arrays["sizes"], axis=0)[:-1]
    vertices, faces = np.split(arrays["vertices"], ends[:, 0]), np.split(arrays["faces"], ends[:, 1])
    for some, corners in zip(vertices, faces, strict=True):
        if not np.isfinite(some).all() or corners.min(initial=0) < 0 or corners.max(initial=-1) >= len(some):
            raise ValueError("no mesh")
    return tuple(TriangleMesh(some, corners) for some, corners in zip(vertices, faces, strict=True))


CREASE = np.radians(60.0)
"""Two triangles at a larger angle are faces of a thing with an edge. Steps of a meshed voxel mask stay below (55)."""
COHERENT = 0.5
"""Fraction of the areas about a corner that their sum keeps at least, where they are one side of a smooth surface. Of
triangles given both ways round, or wound against each other, it keeps less: their blend is no normal."""


def split_at_creases(mesh: TriangleMesh) -> TriangleMesh:
    """A surface with one vertex for each smooth fan of triangles about a point.

    A normal that is blended from the triangles of a vertex then never mixes two sides of a box, and mixes the
    triangles of a smooth surface even where the file stores each with corners of its own (as STL does). The order of
    the triangles is kept.
    """
    keys = (mesh.vertices + 0.0).view(np.dtype((np.void, 24))).reshape(-1)
    _, welded = np.unique(keys, return_inverse=True)
    pairs = _smooth_pairs(mesh, welded[mesh.faces].astype(np.int64))
    count = 3 * len(mesh.faces)
    graph = scipy.sparse.coo_array((np.ones(len(pairs), np.int8), (pairs[:, 0], pairs[:, 1])), shape=(count, count))
    fans, fan = scipy.sparse.csgraph.connected_components(graph, directed=False)
    vertices = np.empty((fans, 3))
    vertices[fan] = mesh.vertices[mesh.faces.reshape(-1)]
    return TriangleMesh(vertices, fan.reshape(-1, 3))


def _smooth_pairs(mesh: TriangleMesh, corner_vertex: NDArray[np.int64]) -> NDArray[np.int64]:
    """Pairs of triangle corners (3 f + k) at one point, of two triangles that share an edge smoothly."""
    faces = np.repeat(np.arange(len(mesh.faces)), 3)
    first, second = corner_vertex.reshape(-1), np.roll(corner_vertex, -1, axis=1).reshape(-1)
    this, following = np.arange(3 * len(mesh.faces)), 3 * faces + (np.tile([1, 2, 0], len(mesh.faces)))
    swap = first > second
    low_corner, high_corner = np.where(swap, following, this), np.where(swap, this, following)
    edge = np.minimum(first, second) * (corner_vertex.max() + 1) + np.maximum(first, second)
    order = np.argsort(edge, kind="stable")
    same = np.flatnonzero(edge[order][1:] == edge[order][:-1])
    a, b = order[same], order[same + 1]
    normals = _normals(mesh)
    along = np.where(swap[a] == swap[b], -1.0, 1.0)  # of neighbours wound alike one runs the edge back
    smooth = along * np.einsum("ij,ij->i", normals[faces[a]], normals[faces[b]]) >= np.cos(CREASE)
    a, b = a[smooth], b[smooth]
    return np.concatenate([np.stack([corner[a], corner[b]], axis=1) for corner in (low_corner, high_corner)])


def _normals(mesh: TriangleMesh) -> NDArray[np.float64]:
    corners = mesh.triangles
    areas = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    lengths = np.linalg.norm(areas, axis=1, keepdims=True)
    return np.asarray(areas / np.where(lengths > 0, lengths, 1.0))


def blended_normals(corners: Floats, normals: Floats, points: Floats) -> Floats:
    """Unit normals at points (n, 3) of triangles, from those at their corners; all corners (n, 3, 3); shape (n, 3)."""
    a, b, c = np.moveaxis(corners, 1, 0)
    across = np.cross(b - a, c - a)
    parts = [np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)]
    weights = np.stack([np.einsum("ij,ij->i", part, across) for part in parts], axis=1)  # as the areas opposite
    return unit_vectors(np.einsum("ij,ijk->ik", weights, normals))


def smooth_normals(mesh: TriangleMesh, face: NDArray[np.int64], points: Floats) -> Floats:
    """Unit normals at points of triangles: the corners' normals (area weighted), blended; shape (n, 3).

    The triangle's own where those about one of its corners have no common side.
    """
    number = np.full(len(mesh.vertices), -1)  # of each vertex among those that are used
    number[mesh.faces[face]] = 0
    used = np.flatnonzero(number == 0)
    number[used] = np.arange(len(used))
    around = np.flatnonzero(np.maximum.reduce(number[mesh.faces.T]) >= 0)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[around]], 1, 0)
    areas = np.cross(b - a, c - a)
    corners, at_vertex = number[mesh.faces[around]].T.reshape(-1), np.empty((len(used), 3))

    def about_vertices(part: Floats) -> Floats:
        return np.asarray(np.bincount(corners[corners >= 0], np.tile(part, 3)[corners >= 0], len(used)))

    for axis, part in enumerate(areas.T):
        at_vertex[:, axis] = about_vertices(part)
    kept, whole = np.linalg.norm(at_vertex, axis=1), about_vertices(np.linalg.norm(areas, axis=1))
    crossed, corner = TriangleMesh(mesh.vertices, mesh.faces[face]), number[mesh.faces[face]]
    own, normals = _normals(crossed), unit_vectors(at_vertex)[corner]
    signs = np.where(np.einsum("ijk,ik->ij", normals, own) < 0.0, -1.0, 1.0)
    blended = blended_normals(crossed.triangles, signs[:, :, None] * normals, points)
    coherent = (kept >= COHERENT * whole)[corner].all(axis=1)
    return np.where(coherent[:, None], blended, own)


def unit_vectors(vectors: Floats) -> Floats:
    """Vectors (n, 3) of length 1; those of none stay 0."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
