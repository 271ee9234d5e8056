"""The fast engine: exact distances of all needle axes from all surfaces at once (docs/concepts/fast-search.md).

A surface is packed once into blocks of 16 triangles under a tree (`kernels.blocks`) and placed about each target. The
directions are cut into bundles of neighbours, which go through the tree together (`kernels.surface_search`).
`near_faces` gives the faces that a slightly displaced needle can touch.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.cache.array_cache import NO_MEMORY, Memory
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.fcl_engine import capsule_touches_any
from puncture_twin.planning.clearance.kernels.blocks import Blocks, pack
from puncture_twin.planning.clearance.kernels.bundle_search import ROUNDED_UP
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import (
    axis_triangle,
    blocks_near,
    displaced_distances,
    spheres_around,
)
from puncture_twin.planning.clearance.kernels.side_by_side import SearchOutput
from puncture_twin.planning.clearance.kernels.surface_search import COUNTED, STACK, scratch_for, search_bundles
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

FCL_BEYOND_MM = 1.0
"""Farther from a capsule FCL sees nothing: its tolerance is 1e-6 mm, and the bounds' rounding 1e-5 mm."""
MOST_THREADS = 16
"""Threads at most: more were never tried."""
PIECE_TRIANGLES = 20_000
"""A structure is searched in two pieces and one more for every so many triangles, each with a part of the directions,
so that no thread waits long for another at the end: a small one close to the target takes as long as a large one. The
pieces do not depend on the number of threads: they may decide which of equally near triangles is named."""
WORTH_THREADS = 20_000
"""Answers, or triangles to pack: a few milliseconds of work. Below, starting threads takes as long."""
LONGEST_MM = 1e9
"""Longest axis that is measured: a longer one could reach the empty nodes that fill up a level of the tree
(`blocks.FAR_MM`)."""


class FastEngine:
    """Exact distances by bundles of directions over trees of discs; FCL where a verdict hangs on rounding.

    Answers what `FclEngine` answers, to rounding of float64. Surfaces are packed at its first query, once for all
    targets.

    Args:
        meshes: The k surfaces, in the CT frame, mm.
        memory: Holds packed surfaces.
        threads: Threads at most, one a core; the answer does not depend on them, to the bit.

    Attributes:
        counts: Shape (7,), how much work all searches so far have done, see `surface_search.COUNTED`.
    """

    def __init__(
        self,
        meshes: Sequence[TriangleMesh],
        progress: Count | None = None,
        memory: Memory = NO_MEMORY,
        threads: int = MOST_THREADS,
    ) -> None:
        self._meshes, self._memory = tuple(meshes), memory
        self._placed: tuple[Floats, tuple[PlacedSurface, ...]] | None = None
        self._threads = threads
        self._progress = progress
        self.counts = np.zeros(len(COUNTED), np.int64)

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """Triangles of each structure, in blocks; see `ClearanceEngine`."""
        return tuple(blocks.triangles for blocks in self.blocks)

    @cached_property
    def blocks(self) -> tuple[Blocks, ...]:
        """Packed blocks of each structure; see `ClearanceEngine`."""
        if self._memory is NO_MEMORY:
            return _packed(self._meshes, self._threads)
        return _remembered(self._meshes, self._memory)

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """Exact distances of n axes from all k structures; see `ClearanceEngine`."""
        target = np.ascontiguousarray(target_ct, dtype=np.float64)
        outward = np.ascontiguousarray(outward_ct, dtype=np.float64).reshape(-1, 3)
        shape = (len(self._meshes), len(outward))
        lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), shape[::-1]).T
        _refuse_unsound(target, outward, lengths)
        answer = AxisDistances(np.empty(shape), np.empty(shape), np.empty(shape, np.int32))
        pieces = self._pieces(target, outward, lengths, answer)
        counts = np.zeros((len(pieces), len(COUNTED)), np.int64)  # a row per piece: no two threads write to the same
        threads = self._threads if np.prod(shape) >= WORTH_THREADS else 1
        for done in on_threads(lambda k: measure_structure(target, *pieces[k], counts[k]), len(pieces), threads):
            if shown and self._progress is not None:
                self._progress(done * shape[0] // len(pieces), shape[0])
        self.counts += counts.sum(axis=0)
        return AxisDistances(answer.distance.T, answer.depth.T, answer.nearest.T)

    def _pieces(
        self, target: Floats, outward: Floats, lengths: Floats, answer: AxisDistances
    ) -> list[tuple[Bundles, Blocks, PlacedSurface, Floats, AxisDistances]]:
        """Arguments of each call of `measure_structure`: one structure and a run of bundles; largest structures first.

        The rows of ``answer`` and ``lengths`` are structures here.
        """
        placed, bundles, pieces = self._placed_about(target), bundle(outward), []
        for row in sorted(range(len(self.blocks)), key=lambda row: -len(self.blocks[row].triangles)):
            blocks = self.blocks[row]
            own = AxisDistances(answer.distance[row], answer.depth[row], answer.nearest[row])
            for part in bundles.parts(2 + len(blocks.triangles) // PIECE_TRIANGLES):
                pieces.append((part, blocks, placed[row], lengths[row], own))
        return pieces

    def _placed_about(self, target: Floats) -> tuple[PlacedSurface, ...]:
        """All surfaces placed about a target; those of the last target are cached."""
        placed = self._placed  # looked at once: another thread may ask about another target
        if placed is None or not np.array_equal(placed[0], target):
            placed = self._placed = (target.copy(), tuple(placed_surface(blocks, target) for blocks in self.blocks))
        return placed[1]

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL collision of a capsule with one structure; see `ClearanceEngine`.

        FCL is queried for the triangles near the axis alone, with the same result as for all of them: FCL tests each
        triangle by itself, and calls one free that is farther from the axis than the radius and its tolerance.
        `near_faces` leaves out no block that may be nearer than the radius and `FCL_BEYOND_MM`.
        """
        reach = radius + FCL_BEYOND_MM
        near = near_faces(self.blocks[structure], target_ct, outward_ct, length, (reach, reach))
        return len(near) > 0 and capsule_touches_any(near.triangles, target_ct, outward_ct, length, radius)

    def of(self, columns: Ints) -> FastEngine:
        """This engine for some of its structures; see `ClearanceEngine`."""
        part = copy(self)
        part._meshes = tuple(self._meshes[column] for column in columns)
        vars(part)["blocks"] = tuple(self.blocks[column] for column in columns)
        part._placed, part._progress = None, None
        return part


def _refuse_unsound(target: Floats, outward: Floats, lengths: Floats) -> None:
    sound = np.isfinite(target).all() and np.isfinite(outward).all()
    if not (sound and np.all((lengths >= 0.0) & (lengths <= LONGEST_MM))):
        refuse("a needle axis is not finite", "clearance", "finite mm, unit directions", "not_finite")


def _packed(meshes: Sequence[TriangleMesh], threads: int) -> tuple[Blocks, ...]:
    """Each surface packed into blocks, on threads, the largest first; blocks do not depend on the target."""
    packed: dict[int, Blocks] = {}
    order = sorted(range(len(meshes)), key=lambda row: -len(meshes[row].faces))

    def work(k: int) -> None:
        packed[order[k]] = pack(meshes[order[k]])

    for _ in on_threads(work, len(meshes), threads if sum(len(mesh.faces) for mesh in meshes) >= WORTH_THREADS else 1):
        pass
    return tuple(packed[row] for row in range(len(meshes)))


def _remembered(meshes: Sequence[TriangleMesh], memory: Memory) -> tuple[Blocks, ...]:
    return tuple(
        memory.get((__name__, mesh.digest), partial(pack, mesh), lambda blocks: blocks.nbytes) for mesh in meshes
    )


def measure_structure(
    target: Floats,
    bundles: Bundles,
    blocks: Blocks,
    placed: PlacedSurface,
    lengths: Floats,
    answer: AxisDistances,
    counts: NDArray[np.int64],
) -> None:
    """Fill the distances of some axes from one structure.

    Args:
        target: Shape (3,), mm: where every axis starts.
        placed: The structure of the blocks, placed about the target.
        lengths: Shape (n,), of the axes in the caller's order, mm.
        answer: Arrays of shape (n,) in the caller's order; the rows that ``bundles`` holds are filled.
        counts: Shape (7,), added to: see `surface_search.COUNTED`.
    """
    distance, depth, nearest, rows = answer.distance, answer.depth, answer.nearest, bundles.order
    if placed.distance == 0.0:  # the target lies on the surface, and every axis starts there
        distance[rows], depth[rows], nearest[rows] = 0.0, 0.0, placed.nearest
        return
    n = len(rows)
    output = SearchOutput(np.empty(n), np.empty(n), np.empty(n, np.int64), counts)
    search_bundles(
        (blocks.triangles, blocks.local, blocks.base), placed.nodes, placed.slack, target, lengths[rows],
        placed.distance, placed.nearest, (bundles.outward, bundles.starts, bundles.middle, bundles.chord),
        scratch_for(len(placed.nodes)), output, LANES,
    )  # fmt: skip
    distance[rows], depth[rows], nearest[rows] = np.sqrt(output.square), output.depth, output.triangle


MOST_MEMBERS = 12
"""Directions of a bundle at most: up to 16 are bounded at once."""
WIDEST_CHORD = 0.12
"""Longest chord |u - u'| from a bundle's first direction to another: about 7 degrees."""
LEAST_BUNDLES = 256
"""A run of fewer bundles is not worth a piece of work of its own."""
CHORD_SLACK = 1e-6
"""Added to a chord, and a fraction of it: more than the rounding of a chord or a unit vector to float32."""


@dataclass(frozen=True, eq=False)
class Bundles:
    """Directions cut into bundles: cones of neighbouring directions, each about one of its members."""

    order: NDArray[np.int64]  # shape (n,), row of each direction in the caller's order
    outward: Floats  # shape (n, 3), unit vectors in the order of the bundles
    starts: NDArray[np.int64]  # shape (b + 1,), row in ``outward`` of each bundle's first member
    middle: NDArray[np.int64]  # shape (b,), row in ``outward`` of the member that is each bundle's axis
    chord: Floats  # shape (b,), largest |u - axis| of its members, rounded up

    def parts(self, most: int) -> list[Bundles]:
        """The bundles divided into at most ``most`` runs of equal length, none shorter than ``LEAST_BUNDLES``."""
        count = max(1, min(most, len(self.middle) // LEAST_BUNDLES))
        edges = np.linspace(0, len(self.middle), count + 1).astype(int)
        return [self._run(low, high) for low, high in itertools.pairwise(edges)]

    def _run(self, low: int, high: int) -> Bundles:
        first = self.starts[low]
        members = slice(first, self.starts[high])
        starts, middle = self.starts[low : high + 1] - first, self.middle[low:high] - first
        return Bundles(self.order[members], self.outward[members], starts, middle, self.chord[low:high])


def bundle(outward: Floats) -> Bundles:
    """Bundle directions, in any order and number, shape (n, 3), unit vectors."""
    order = kd_order(outward, MOST_MEMBERS)
    sorted_outward = np.ascontiguousarray(outward[order], dtype=np.float64)
    starts = _cut_into_bundles(sorted_outward, np.empty(len(outward) + 1, np.int64))
    middle, chord = np.empty(len(starts) - 1, np.int64), np.empty(len(starts) - 1)
    _bundle_axes(sorted_outward, starts, middle, chord)
    return Bundles(order, sorted_outward, starts, middle, chord)


@nb.njit(cache=True)
def _cut_into_bundles(outward, starts):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the bundles' starts: runs of MOST_MEMBERS directions, ended early where the next is too far from the first.

    ``outward`` is in k-d order, so neighbours on the sphere follow each other.
    """
    count, first = 0, 0
    starts[0] = 0
    for i in range(1, len(outward)):
        if i % MOST_MEMBERS == 0 or _square_between(outward, i, first) > WIDEST_CHORD * WIDEST_CHORD:
            count += 1
            first = i
            starts[count] = i
    count += 1 if len(outward) else 0
    starts[count] = len(outward)
    return starts[: count + 1].copy()


@nb.njit(cache=True)
def _bundle_axes(outward, starts, middle, chord):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the member nearest to the mean of each bundle, and the widest chord from it."""
    for bundle in range(len(middle)):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(starts[bundle], starts[bundle + 1]):
            x, y, z = x + outward[i, 0], y + outward[i, 1], z + outward[i, 2]
        middle[bundle], most = starts[bundle], -np.inf
        for i in range(starts[bundle], starts[bundle + 1]):
            along = outward[i, 0] * x + outward[i, 1] * y + outward[i, 2] * z
            if along > most:
                middle[bundle], most = i, along
        widest = 0.0
        for i in range(starts[bundle], starts[bundle + 1]):
            widest = max(widest, _square_between(outward, i, middle[bundle]))
        chord[bundle] = np.sqrt(widest) * (1 + CHORD_SLACK) + CHORD_SLACK


@nb.njit(cache=True)
def _square_between(outward, i, k):  # type: ignore[no-untyped-def]  # numba infers
    x, y, z = outward[i, 0] - outward[k, 0], outward[i, 1] - outward[k, 1], outward[i, 2] - outward[k, 2]
    return x * x + y * y + z * z


COORDINATE_SLACK = 1e-6
"""Fraction of a coordinate by which float32 arithmetic of a few terms may err: 8 times its rounding."""
REACH_ROUNDING = 1e-5
"""Fraction by which the distance of a sphere from the target may err: of two radii, a root and a difference."""


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """One surface in coordinates about one target."""

    nodes: NDArray[np.float32]
    """Shape (groups, 10, 16), of the tree, as `bounds.disc_bounds` reads them."""
    slack: float  # rounding of a node's coordinate, mm
    distance: float  # of the target from the surface, mm: no axis is farther, for it starts there
    nearest: int  # row of the triangle nearest to the target


def placed_surface(blocks: Blocks, target: Floats) -> PlacedSurface:
    """Place a packed surface about a target (3,), mm."""
    nodes = np.empty((10, len(blocks.center)), np.float32)
    nodes[:3] = (blocks.center - target).T
    nodes[3:8] = blocks.disc  # normal, rho, h
    nodes[8] = np.hypot(nodes[6], nodes[7]) * ROUNDED_UP  # R, of the sphere about the disc
    from_target = np.sqrt(nodes[0] ** 2 + nodes[1] ** 2 + nodes[2] ** 2)
    nodes[9] = (from_target + nodes[8]) * ROUNDED_UP  # |c| + R: no point of the disc is farther from the target
    slack = COORDINATE_SLACK * float(nodes[9][: len(blocks.local)].max())
    grouped = np.ascontiguousarray(nodes.reshape(10, -1, LANES).transpose(1, 0, 2))  # one group is contiguous
    distance, nearest = nearest_triangle(blocks.triangles, grouped, blocks.base, target, slack)
    return PlacedSurface(grouped, slack, distance, nearest)


@nb.njit(cache=True, error_model="numpy")
def nearest_triangle(triangles, nodes, base, target, slack):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of the target from a surface, mm, and the row of the nearest triangle: branch and bound over its tree.

    Args:
        triangles: `Blocks.triangles`, and ``base`` its levels.
        nodes: `PlacedSurface.nodes`.
        target: Shape (3,), mm.
        slack: Rounding of a node's coordinate, mm.
    """
    nearest, distance, waiting = 0, _from_target(triangles, np.int64(0), target), 1
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = base[-1], len(base) - 1
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        for k in range(LANES):
            reach = nodes[first, 9, k] - 2 * nodes[first, 8, k]  # (|c| + R) - 2 R: distance of the sphere
            if reach - slack - REACH_ROUNDING * abs(reach) >= distance:
                continue
            child = (first - base[level]) * LANES + k
            if level > 0:
                stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                waiting += 1
                continue
            for row in range(child * LANES, (child + 1) * LANES):
                row_distance = _from_target(triangles, row, target)
                nearest, distance = row if row_distance < distance else nearest, min(row_distance, distance)
    return distance, nearest


@nb.njit(cache=True, error_model="numpy")
def _from_target(triangles, row, target):  # type: ignore[no-untyped-def]  # numba infers
    t, (x, y, z) = triangles[row], (target[0], target[1], target[2])
    a, b, c = (t[0] - x, t[1] - y, t[2] - z), (t[3] - x, t[4] - y, t[5] - z), (t[6] - x, t[7] - y, t[8] - z)
    return np.sqrt(axis_triangle((0.0, 0.0, 1.0), 0.0, a, b, c)[0])


@dataclass(frozen=True, eq=False)
class NearFaces:
    """The faces of a structure near one needle axis, which a small displacement could touch; CT frame, mm."""

    triangles: Floats  # shape (m, 9), corners, in blocks of 16, those that may be nearest first
    faces: Floats  # shape (m, 4), a sphere around each: centre, radius
    blocks: Floats  # shape (m / 16, 4), around each 16

    def __len__(self) -> int:
        return len(self.triangles)

    def distance(self, origins_ct: Floats, outward_ct: Floats, length: float) -> Floats:
        """Distances (n,), mm, of axes from ``origins_ct`` (n, 3) along ``outward_ct`` (n, 3) to these faces."""
        distance = np.empty(len(origins_ct))
        origins, outward = (np.ascontiguousarray(rows, dtype=np.float64) for rows in (origins_ct, outward_ct))
        displaced_distances(self.triangles, self.faces, self.blocks, origins, outward, float(length), distance)
        return distance


def near_faces(
    blocks: Blocks, origin_ct: Floats, outward_ct: Floats, length: float, reach: tuple[float, float]
) -> NearFaces:
    """Select all faces within reach of an axis, and the others of their blocks.

    Args:
        origin_ct: Shape (3,), where the axis starts, mm.
        outward_ct: Shape (3,), unit.
        length: Of the axis, mm.
        reach: How far the axis may be displaced, at its start and at its end, mm; linear in between.
    """
    rows, bounds = blocks_near(blocks.center, blocks.disc, len(blocks.local), origin_ct, outward_ct, length, reach)
    order = rows[np.argsort(bounds, kind="stable")]
    triangles = blocks.triangles[(order[:, None] * LANES + np.arange(LANES)).ravel()]
    faces, groups = np.empty((len(triangles), 4)), np.empty((len(order), 4))
    spheres_around(triangles, faces, groups)
    return NearFaces(triangles, faces, groups)
