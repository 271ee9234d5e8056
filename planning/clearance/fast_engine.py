"""The fast engine: exact distances of all needle axes at once, from surfaces packed once and placed about a target."""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from functools import partial

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.cache.memory import NO_MEMORY, Memory
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.clearance.block_orders import block_orders
from puncture_twin.planning.clearance.direction_tiles import Tiles, bundle
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.clearance.fcl_engine import capsule_touches_any
from puncture_twin.planning.clearance.kernels.blocks import Blocks, pack
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.scratch import Found, scratch_for
from puncture_twin.planning.clearance.kernels.tile_search import COUNTED, search_tiles
from puncture_twin.planning.clearance.near_faces import near_faces
from puncture_twin.planning.clearance.placed_surface import PlacedSurface, placed_surface
from puncture_twin.planning.geometry.mesh import TriangleMesh

FCL_BEYOND_MM = 1.0
"""Farther from a capsule FCL sees nothing: its tolerance is 1e-6 mm, and the bounds' rounding 1e-5 mm."""

MOST_THREADS = 16
"""More were never tried."""

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

    Answers what `FclEngine` answers, to rounding of float64. Prepared once for a patient's surfaces, wanted any
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
        """Of each structure, in blocks; see `ClearanceEngine`."""
        return tuple(blocks.triangles for blocks in self._blocks)

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """Of each structure; see `ClearanceEngine`."""
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
        """What `measure_structure` is given in turn: the largest structures first, in runs of directions.

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
        """The surfaces as seen from a target; those of the last target are kept."""
        if self._seen is None or not np.array_equal(self._seen[0], target):
            self._seen = (target.copy(), tuple(placed_surface(blocks, target) for blocks in self._blocks))
        return self._seen[1]

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL collision of a capsule with one structure; see `ClearanceEngine`.

        FCL is asked about the triangles near the axis alone, which is what it answers of all of them: a surface touches
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
        raise InputError("a needle axis is not finite", where="clearance", allowed="finite mm, unit directions")


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
    """The same, those that an earlier case packed taken from memory."""
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
