"""A surface packed for the fast search: blocks of 16 triangles under an implicit 16-ary tree of discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.discs import block_discs, parent_discs
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

FAR_MM = 1e15
"""Where the nodes lie that only fill a level up to whole groups: farther than any needle is long."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """One surface, packed. Made once per patient; nothing here depends on the target.

    A node is a disc: every point p of its triangles has |(p - c) . n| <= h and lies within rho of the axis through c
    along n. Level 0 holds the blocks; node j of a level has the nodes 16 j ... 16 j + 15 of the level below.

    Attributes:
        triangles: Shape (16 b, 9), corners in block order, mm; the last block is filled up with its last triangle.
        local: Shape (b, 9, 16), float32, the same corners relative to their block's centre.
        center: Shape (nodes, 3), c, all levels one after the other, mm.
        disc: Shape (5, nodes), float32, the normal n, rho and h, rounded outward.
        base: Shape (levels,), the group of 16 with which each level starts; levels fill whole groups.
    """

    triangles: Floats
    local: NDArray[np.float32]
    center: Floats
    disc: NDArray[np.float32]
    base: NDArray[np.int64]

    @property
    def nbytes(self) -> int:
        """What the arrays hold."""
        return sum(array.nbytes for array in (self.triangles, self.local, self.center, self.disc, self.base))


def block_order(mesh: TriangleMesh) -> NDArray[np.int32]:
    """The order in which a surface's triangles fill its blocks, shape (m,): what takes longest to find of them."""
    return kd_order(_middles(mesh.vertices, mesh.faces), LANES).astype(np.int32)


def pack(mesh: TriangleMesh, known: NDArray[np.int32] | None = None) -> Blocks:
    """Pack a surface.

    Args:
        mesh: The surface.
        known: Its `block_order`, where that has been found before.
    """
    order = np.array(block_order(mesh) if known is None else known, np.int64)
    blocks = -(-len(order) // LANES)
    counts = [blocks]
    while counts[-1] > LANES:
        counts.append(-(-counts[-1] // LANES))
    base = np.concatenate([[0], np.cumsum([-(-n // LANES) * LANES for n in counts])])
    center, disc = np.full((base[-1], 3), FAR_MM), np.zeros((5, base[-1]))
    triangles = np.empty((blocks * LANES, 9))
    local = np.empty((blocks, 9, LANES), np.float32)
    _fill(mesh.vertices, mesh.faces, order, triangles)
    block_discs(triangles, local, center, disc)
    for level in range(1, len(counts)):
        parent_discs(center, disc, base[level - 1], counts[level - 1], base[level])
    return Blocks(triangles, local, center, _outward(disc), base[:-1] // LANES)


def _outward(disc: Floats) -> NDArray[np.float32]:
    """To float32, radius and thickness grown by more than the rounding of anything that made them."""
    grown = disc.copy()
    grown[3:] = grown[3:] * (1 + 1e-5) + 1e-6
    return grown.astype(np.float32)


@nb.njit(cache=True, nogil=True)
def _middles(vertices, faces):  # type: ignore[no-untyped-def]  # numba infers
    """Middle of each triangle's box, shape (m, 3), float32."""
    middles = np.empty((len(faces), 3), np.float32)
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        for x in range(3):
            a, b, c = vertices[i, x], vertices[j, x], vertices[k, x]
            middles[f, x] = 0.5 * (min(a, b, c) + max(a, b, c))
    return middles


@nb.njit(cache=True, nogil=True)
def _fill(vertices, faces, order, triangles):  # type: ignore[no-untyped-def]  # numba infers
    """Copy the corners in order, the last triangle again and again to the end."""
    for row in range(len(triangles)):
        face = order[min(row, len(order) - 1)]
        for corner in range(3):
            vertex = faces[face, corner]
            for x in range(3):
                triangles[row, 3 * corner + x] = vertices[vertex, x]
