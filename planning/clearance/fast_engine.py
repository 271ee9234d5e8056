"""The fast engine: exact distances of all needle axes at once, from surfaces packed once and placed about a target.

Directions are measured in bundles: neighbours on the sphere go through the tree together. The order of a surface's
triangles in its blocks is cached (it takes half of the packing's time). `near_faces` gives the faces that a slightly
displaced needle can touch.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, NO_MEMORY, Cache, Memory
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.fcl_engine import capsule_touches_any
from puncture_twin.planning.clearance.kernels.blocks import Blocks, block_order, pack
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import (
    blocks_near,
    displaced_distances,
    nearest_triangle,
    spheres_around,
)
from puncture_twin.planning.clearance.kernels.side_by_side import Found, scratch_for
from puncture_twin.planning.clearance.kernels.tile_search import COUNTED, search_tiles
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

FCL_BEYOND_MM = 1.0
"""Farther from a capsule FCL sees nothing: its tolerance is 1e-6 mm, and the bounds' rounding 1e-5 mm."""

MOST_THREADS = 16
"""Threads at most: more were never tried."""

PIECE_TRIANGLES = 20_000
"""A structure is searched in two pieces and one more for every so many triangles, each with its share of the
directions, so that no thread waits long for another at the end: a small one close to the target takes as long as a
large one. Pieces do not depend on threads: which of equally near triangles is named may."""

WORTH_THREADS = 20_000
"""Answers, or triangles to pack: a few milliseconds of work. Below, starting threads takes as long."""

LONGEST_MM = 1e9
"""A needle that could reach the nodes that only fill a level up would be measured from them."""


class FastEngine:
    """Exact distances by bundles of directions over trees of discs; FCL where a verdict hangs on rounding.

    Answers what `FclEngine` answers, to rounding of float64. Prepared once for a patient's surfaces, measured from any
    target.

    Args:
        meshes: The k surfaces, in the CT frame, mm.
        progress: Called with (structures done in all directions, structures).
        cache: Where what is found of the surfaces is kept; its memory keeps them packed.
        threads: At most so many pieces of the work are done side by side, and one a core; each is done by itself, so
            the answer is the same to the bit.

    Attributes:
        counts: Shape (7,), what all searches so far went through, see `tile_search.COUNTED`.
    """

    def __init__(
        self,
        meshes: Sequence[TriangleMesh],
        progress: Count | None = None,
        cache: Cache = NO_CACHE,
        threads: int = MOST_THREADS,
    ) -> None:
        memory = cache.memory
        self._blocks = _packed(meshes, threads, cache) if memory is NO_MEMORY else _remembered(meshes, memory)
        self._seen: tuple[Floats, tuple[PlacedSurface, ...]] | None = None
        self._threads = threads
        self._progress = progress
        self.counts = np.zeros(len(COUNTED), np.int64)

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """Triangles of each structure, in blocks; see `ClearanceEngine`."""
        return tuple(blocks.triangles for blocks in self._blocks)

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """Packed blocks of each structure; see `ClearanceEngine`."""
        return self._blocks

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """Exact distances of n axes from all k structures; see `ClearanceEngine`."""
        target = np.ascontiguousarray(target_ct, dtype=np.float64)
        outward = np.ascontiguousarray(outward_ct, dtype=np.float64).reshape(-1, 3)
        shape = (len(self._blocks), len(outward))
        lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), shape[::-1]).T
        _refuse_unsound(target, outward, lengths)
        answer = AxisDistances(np.empty(shape), np.empty(shape), np.empty(shape, np.int32))
        pieces = self._pieces(target, outward, lengths, answer)
        counts = np.zeros((len(pieces), len(COUNTED)), np.int64)
        threads = self._threads if np.prod(shape) >= WORTH_THREADS else 1
        for done in on_threads(lambda k: measure_structure(target, *pieces[k], counts[k]), len(pieces), threads):
            if shown and self._progress is not None:
                self._progress(done * len(self._blocks) // len(pieces), len(self._blocks))
        self.counts += counts.sum(axis=0)
        return AxisDistances(answer.distance.T, answer.depth.T, answer.nearest.T)

    def _pieces(
        self, target: Floats, outward: Floats, lengths: Floats, answer: AxisDistances
    ) -> list[tuple[Tiles, Blocks, PlacedSurface, Floats, AxisDistances]]:
        """Arguments of each `measure_structure`: the largest structures first, in runs of directions.

        Here rows of ``answer`` are structures.
        """
        seen, tiles, pieces = self._seen_from(target), bundle(outward), []
        for row in sorted(range(len(self._blocks)), key=lambda row: -len(self._blocks[row].triangles)):
            blocks = self._blocks[row]
            own = AxisDistances(answer.distance[row], answer.depth[row], answer.nearest[row])
            for part in tiles.parts(2 + len(blocks.triangles) // PIECE_TRIANGLES):
                pieces.append((part, blocks, seen[row], lengths[row], own))
        return pieces

    def _seen_from(self, target: Floats) -> tuple[PlacedSurface, ...]:
        """The surfaces as seen from a target; those of the last target are cached."""
        if self._seen is None or not np.array_equal(self._seen[0], target):
            self._seen = (target.copy(), tuple(placed_surface(blocks, target) for blocks in self._blocks))
        return self._seen[1]

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL collision of a capsule with one structure; see `ClearanceEngine`.

        FCL is queried for the triangles near the axis alone, with the same result as for all of them: a surface touches
        a capsule where one of its triangles does, FCL tests each triangle by itself, and one that is farther from the
        axis than the radius by more than FCL's tolerance it calls free. `near_faces` leaves out no block whose distance
        from the axis is, by its lower bound, within the radius and `FCL_BEYOND_MM`.
        """
        reach = radius + FCL_BEYOND_MM
        near = near_faces(self.blocks[structure], target_ct, outward_ct, length, (reach, reach))
        return len(near) > 0 and capsule_touches_any(near.triangles, target_ct, outward_ct, length, radius)

    def of(self, columns: Ints) -> FastEngine:
        """The same engine for some of its structures; see `ClearanceEngine`."""
        part = copy(self)
        part._blocks = tuple(self._blocks[column] for column in columns)
        part._seen, part._progress = None, None
        return part


def _refuse_unsound(target: Floats, outward: Floats, lengths: Floats) -> None:
    sound = np.isfinite(target).all() and np.isfinite(outward).all()
    if not (sound and np.all((lengths >= 0.0) & (lengths <= LONGEST_MM))):
        refuse("a needle axis is not finite", "clearance", "finite mm, unit directions", "not_finite")


def _packed(meshes: Sequence[TriangleMesh], threads: int, cache: Cache) -> tuple[Blocks, ...]:
    """Surfaces as blocks of triangles, packed side by side, the largest first; they are the same for every target."""
    found: dict[int, Blocks] = {}
    order = sorted(range(len(meshes)), key=lambda row: -len(meshes[row].faces))
    threads = threads if sum(len(mesh.faces) for mesh in meshes) >= WORTH_THREADS else 1
    known = block_orders(meshes, cache, threads) if cache.folder is not None and len(meshes) else None

    def work(k: int) -> None:
        row = order[k]
        found[row] = pack(meshes[row], None if known is None else known[row])

    for _ in on_threads(work, len(meshes), threads):
        pass
    return tuple(found[row] for row in range(len(meshes)))


def _remembered(meshes: Sequence[TriangleMesh], memory: Memory) -> tuple[Blocks, ...]:
    """The surfaces packed, those that an earlier case packed taken from memory."""
    return tuple(
        memory.get((__name__, mesh.digest), partial(pack, mesh), lambda blocks: blocks.nbytes) for mesh in meshes
    )


def measure_structure(
    target: Floats,
    tiles: Tiles,
    blocks: Blocks,
    placed: PlacedSurface,
    lengths: Floats,
    answer: AxisDistances,
    counts: NDArray[np.int64],
) -> None:
    """Fill one structure's distances from the axes of some directions.

    Args:
        target: Shape (3,), mm: where every axis starts.
        tiles: All or some of the n directions.
        blocks: The structure.
        placed: Itself as seen from the target.
        lengths: Shape (n,), of the axes in the caller's order, mm.
        answer: Arrays of shape (n,) in the caller's order; rows of ``tiles`` are filled.
        counts: Shape (7,), added to: see `tile_search.COUNTED`.
    """
    distance, depth, nearest = answer.distance, answer.depth, answer.nearest
    if placed.distance == 0.0:
        distance[tiles.order], depth[tiles.order], nearest[tiles.order] = 0.0, 0.0, placed.nearest
        return
    n = len(tiles.order)
    found = Found(np.empty(n), np.empty(n), np.empty(n, np.int64), counts)
    surface = (blocks.triangles, blocks.local, blocks.base)
    bundles = (tiles.outward, tiles.starts, tiles.middle, tiles.chord)
    search_tiles(
        surface, placed.nodes, placed.slack, target, lengths[tiles.order], placed.distance, placed.nearest,
        bundles, scratch_for(len(placed.nodes)), found, LANES,
    )  # fmt: skip
    distance[tiles.order], depth[tiles.order], nearest[tiles.order] = np.sqrt(found.square), found.depth, found.triangle


TILE = 12
"""Directions of a bundle at most."""

WIDEST = 0.12
"""Chord from a bundle's axis to its members above which it is divided: about 7 degrees."""

LEAST_BUNDLES = 256
"""A run of fewer bundles is not worth a piece of work of its own."""

CHORD_SLACK = 1e-6
"""More than float32 takes from a chord or a unit vector."""


@dataclass(frozen=True, eq=False)
class Tiles:
    """Bundles of directions, ordered so that neighbours follow each other.

    Attributes:
        order: Shape (n,), row of each direction in the caller's order.
        outward: Shape (n, 3), unit vectors in the new order.
        starts: Shape (t + 1,), where each bundle starts.
        middle: Shape (t,), row in ``outward`` of the member amid each bundle: its axis.
        chord: Shape (t,), largest |u - axis| of its members, rounded up.
    """

    order: NDArray[np.int64]
    outward: Floats
    starts: NDArray[np.int64]
    middle: NDArray[np.int64]
    chord: Floats

    def parts(self, most: int) -> list[Tiles]:
        """The bundles in at most so many runs of about as many each, none below ``LEAST_BUNDLES``."""
        count = max(1, min(most, len(self.middle) // LEAST_BUNDLES))
        edges = np.linspace(0, len(self.middle), count + 1).astype(int)
        return [self._run(low, high) for low, high in itertools.pairwise(edges)]

    def _run(self, low: int, high: int) -> Tiles:
        """Bundles ``low`` to ``high``."""
        first = self.starts[low]
        members = slice(first, self.starts[high])
        starts, middle = self.starts[low : high + 1] - first, self.middle[low:high] - first
        return Tiles(self.order[members], self.outward[members], starts, middle, self.chord[low:high])


def bundle(outward: Floats) -> Tiles:
    """Bundle directions, in any order and number, shape (n, 3), unit vectors."""
    order = kd_order(outward, TILE)
    sorted_outward = np.ascontiguousarray(outward[order], dtype=np.float64)
    starts = _cut(sorted_outward, np.empty(len(outward) + 1, np.int64))
    middle, chord = np.empty(len(starts) - 1, np.int64), np.empty(len(starts) - 1)
    _axes(sorted_outward, starts, middle, chord)
    return Tiles(order, sorted_outward, starts, middle, chord)


@nb.njit(cache=True)
def _cut(outward, starts):  # type: ignore[no-untyped-def]  # numba infers
    """Runs of TILE directions, ended early where the next one is too far from the run's first."""
    count, first = 0, 0
    starts[0] = 0
    for i in range(1, len(outward)):
        if i % TILE == 0 or _square_between(outward, i, first) > WIDEST * WIDEST:
            count += 1
            first = i
            starts[count] = i
    count += 1 if len(outward) else 0
    starts[count] = len(outward)
    return starts[: count + 1].copy()


@nb.njit(cache=True)
def _axes(outward, starts, middle, chord):  # type: ignore[no-untyped-def]  # numba infers
    """The member nearest to the mean of each bundle, and the widest chord from it."""
    for tile in range(len(middle)):
        x, y, z = 0.0, 0.0, 0.0
        for i in range(starts[tile], starts[tile + 1]):
            x, y, z = x + outward[i, 0], y + outward[i, 1], z + outward[i, 2]
        middle[tile], most = starts[tile], -np.inf
        for i in range(starts[tile], starts[tile + 1]):
            along = outward[i, 0] * x + outward[i, 1] * y + outward[i, 2] * z
            if along > most:
                middle[tile], most = i, along
        widest = 0.0
        for i in range(starts[tile], starts[tile + 1]):
            widest = max(widest, _square_between(outward, i, middle[tile]))
        chord[tile] = np.sqrt(widest) * (1 + CHORD_SLACK) + CHORD_SLACK


@nb.njit(cache=True)
def _square_between(outward, i, k):  # type: ignore[no-untyped-def]  # numba infers
    """Square of the chord between two directions."""
    x, y, z = outward[i, 0] - outward[k, 0], outward[i, 1] - outward[k, 1], outward[i, 2] - outward[k, 2]
    return x * x + y * y + z * z


Order = NDArray[np.int32]


def block_orders(meshes: Sequence[TriangleMesh], cache: Cache, threads: int) -> tuple[Order, ...]:
    """`block_order` of each surface, from the cache where all of them are there.

    The blocks themselves are not kept: they are thirty times as large, and filled sooner than read.

    Args:
        meshes: The surfaces.
        cache: Where the orders are kept, one entry for all.
        threads: How many are found side by side.
    """
    made_from = {"what": "block orders", "meshes": [mesh.digest for mesh in meshes]}
    make = partial(_found, meshes, threads)
    return cache.value(made_from, make, partial(_of_each, [len(mesh.faces) for mesh in meshes]), by=__name__)


def _found(meshes: Sequence[TriangleMesh], threads: int) -> Arrays:
    orders: dict[int, Order] = {}

    def work(k: int) -> None:
        orders[k] = block_order(meshes[k])

    for _ in on_threads(work, len(meshes), threads):
        pass
    return {"orders": np.concatenate([np.empty(0, np.int32), *(orders[k] for k in range(len(meshes)))])}


def _of_each(counts: Sequence[int], stored: Arrays) -> tuple[Order, ...]:
    """The block order of each surface.

    Raises:
        KeyError, TypeError, ValueError: One leaves out a triangle, which the search would never see then.
    """
    orders = stored["orders"]
    if orders.dtype != np.int32 or orders.shape != (sum(counts),):
        raise TypeError("orders of other surfaces")
    each = np.split(orders, np.cumsum(counts)[:-1])
    for order, count in zip(each, counts, strict=True):
        found = np.zeros(count, np.bool_)
        if count and (order.min() < 0 or order.max() >= count):
            raise ValueError("no triangle of the surface")
        found[order] = True
        if not found.all():
            raise ValueError("a triangle is left out")
    return tuple(each)


COORDINATE_SLACK = 1e-6
"""Fraction of a coordinate by which float32 arithmetic of a few terms may err: 8 times its rounding."""


@dataclass(frozen=True, eq=False)
class PlacedSurface:
    """One surface as seen from one target: the nodes of `bounds.disc_bounds`, and the target's own distance."""

    nodes: NDArray[np.float32]
    slack: float
    distance: float
    nearest: int


def placed_surface(blocks: Blocks, target: Floats) -> PlacedSurface:
    """A surface as seen from a target."""
    nodes = np.empty((10, len(blocks.center)), np.float32)
    nodes[:3] = (blocks.center - target).T
    nodes[3:8] = blocks.disc
    nodes[8] = np.hypot(nodes[6], nodes[7]) * np.float32(1 + 1e-6)
    away = np.sqrt(nodes[0] ** 2 + nodes[1] ** 2 + nodes[2] ** 2)
    nodes[9] = (away + nodes[8]) * np.float32(1 + 1e-6)
    slack = COORDINATE_SLACK * float(nodes[9][: len(blocks.local)].max())
    grouped = np.ascontiguousarray(nodes.reshape(10, -1, LANES).transpose(1, 0, 2))
    distance, nearest = nearest_triangle(blocks.triangles, grouped, blocks.base, target, slack)
    return PlacedSurface(grouped, slack, distance, nearest)


@dataclass(frozen=True, eq=False)
class NearFaces:
    """The faces of a structure near one needle axis, which a small displacement could touch; CT frame, mm.

    Attributes:
        triangles: Shape (m, 9), corners, in blocks of 16, those that may be nearest first.
        faces: Shape (m, 4), a sphere around each: centre, radius.
        blocks: Shape (m / 16, 4), around each 16.
    """

    triangles: Floats
    faces: Floats
    blocks: Floats

    def __len__(self) -> int:
        return len(self.triangles)

    def distance(self, origins_ct: Floats, outward_ct: Floats, length: float) -> Floats:
        """Distances (n,), mm, of axes from ``origins_ct`` (n, 3) along ``outward_ct`` (n, 3) to these faces."""
        found = np.empty(len(origins_ct))
        origins, outward = (np.ascontiguousarray(rows, dtype=np.float64) for rows in (origins_ct, outward_ct))
        displaced_distances(self.triangles, self.faces, self.blocks, origins, outward, float(length), found)
        return found


def near_faces(
    blocks: Blocks, origin_ct: Floats, outward_ct: Floats, length: float, reach: tuple[float, float]
) -> NearFaces:
    """All faces within reach of an axis, and some beyond.

    Args:
        blocks: The packed surface.
        origin_ct: Shape (3,), where the axis starts.
        outward_ct: Shape (3,), unit.
        length: Of the axis, mm.
        reach: At its start and at its end, mm; linear in between.
    """
    rows, bounds = blocks_near(blocks.center, blocks.disc, len(blocks.local), origin_ct, outward_ct, length, reach)
    order = rows[np.argsort(bounds, kind="stable")]
    triangles = blocks.triangles[(order[:, None] * LANES + np.arange(LANES)).ravel()]
    faces, groups = np.empty((len(triangles), 4)), np.empty((len(order), 4))
    spheres_around(triangles, faces, groups)
    return NearFaces(triangles, faces, groups)
