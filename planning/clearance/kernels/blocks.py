"""A surface packed for the fast search: blocks of 16 triangles under an implicit 16-ary tree of discs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

PARALLEL = 1e-6
"""Share of its triangles' area below which a block's mean normal says nothing."""

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
    _block_discs(triangles, local, center, disc)
    for level in range(1, len(counts)):
        _parent_discs(center, disc, base[level - 1], counts[level - 1], base[level])
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


@nb.njit(cache=True, nogil=True)
def _block_discs(triangles, local, center, disc):  # type: ignore[no-untyped-def]  # numba infers
    """Disc of every block, and its corners relative to the disc's centre."""
    for block in range(len(local)):
        rows = triangles[block * LANES : (block + 1) * LANES]
        n = _mean_normal(rows)
        c = np.empty(3)
        for x in range(3):
            least, most = np.inf, -np.inf
            for row in range(LANES):
                for corner in range(3):
                    least, most = min(least, rows[row, 3 * corner + x]), max(most, rows[row, 3 * corner + x])
            c[x] = 0.5 * (least + most)
        _center_along(rows, n, c)
        rho2, h = 0.0, 0.0
        for row in range(LANES):
            for corner in range(3):
                dx, dy, dz = (
                    rows[row, 3 * corner] - c[0],
                    rows[row, 3 * corner + 1] - c[1],
                    rows[row, 3 * corner + 2] - c[2],
                )
                up = dx * n[0] + dy * n[1] + dz * n[2]
                ax, ay, az = dx - up * n[0], dy - up * n[1], dz - up * n[2]
                rho2, h = max(rho2, ax * ax + ay * ay + az * az), max(h, abs(up))
                local[block, 3 * corner, row] = dx
                local[block, 3 * corner + 1, row] = dy
                local[block, 3 * corner + 2, row] = dz
        center[block, 0], center[block, 1], center[block, 2] = c[0], c[1], c[2]
        disc[0, block], disc[1, block], disc[2, block] = n[0], n[1], n[2]
        disc[3, block], disc[4, block] = np.sqrt(rho2), h


@nb.njit(cache=True, nogil=True)
def _center_along(rows, n, c):  # type: ignore[no-untyped-def]  # numba infers
    """Move a centre along the normal to the middle of what it must hold."""
    least, most = np.inf, -np.inf
    for row in range(LANES):
        for corner in range(3):
            up = 0.0
            for x in range(3):
                up += (rows[row, 3 * corner + x] - c[x]) * n[x]
            least, most = min(least, up), max(most, up)
    for x in range(3):
        c[x] += 0.5 * (least + most) * n[x]


@nb.njit(cache=True, nogil=True)
def _mean_normal(rows):  # type: ignore[no-untyped-def]  # numba infers
    """Unit mean of the triangles' normals by area, all turned to the side of the largest; z where there is none."""
    total, first, largest, area = np.zeros(3), np.zeros(3), 0.0, 0.0
    for turn in range(2):
        for row in range(len(rows)):
            a = rows[row]
            dx, dy, dz, ex, ey, ez = a[3] - a[0], a[4] - a[1], a[5] - a[2], a[6] - a[0], a[7] - a[1], a[8] - a[2]
            nx, ny, nz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
            size = np.sqrt(nx * nx + ny * ny + nz * nz)
            if turn == 0 and size > largest:
                largest = size
                first[0], first[1], first[2] = nx, ny, nz
            elif turn == 1:
                sign = -1.0 if nx * first[0] + ny * first[1] + nz * first[2] < 0.0 else 1.0
                total[0] += sign * nx
                total[1] += sign * ny
                total[2] += sign * nz
                area += size
    norm = np.sqrt(total[0] ** 2 + total[1] ** 2 + total[2] ** 2)
    if not norm > PARALLEL * area:
        return np.array([0.0, 0.0, 1.0])
    return total / norm


@nb.njit(cache=True, nogil=True)
def _parent_discs(center, disc, child, count, parent):  # type: ignore[no-untyped-def]  # numba infers
    """Discs of one level around those of the level below, whose nodes ``child`` ... ``child + count`` they hold.

    A child's points reach sqrt(1 - (n.m)^2) rho + |n.m| h along the parent's normal n (m its own), and at most
    rho + sqrt(1 - (n.m)^2) h from its centre across n.
    """
    for group in range((count + LANES - 1) // LANES):
        low = child + group * LANES
        high = min(low + LANES, child + count)
        n, c = np.zeros(3), np.zeros(3)
        for j in range(low, high):
            sign = 1.0 if _dot(disc[:3, j], disc[:3, low]) >= 0.0 else -1.0
            n += sign * disc[:3, j] * disc[3, j] ** 2
            c += center[j] / (high - low)
        norm = np.sqrt(_dot(n, n))
        n = n / norm if norm > 0.0 else np.array([0.0, 0.0, 1.0])
        least, most = np.inf, -np.inf
        for j in range(low, high):
            up, reach = _dot(center[j] - c, n), _reach_along(disc, j, n)
            least, most = min(least, up - reach), max(most, up + reach)
        c += 0.5 * (least + most) * n
        rho = 0.0
        for j in range(low, high):
            d = center[j] - c
            d = d - _dot(d, n) * n
            q = _dot(disc[:3, j], n)
            across = disc[3, j] + disc[4, j] * np.sqrt(max(0.0, 1.0 - q * q))
            rho = max(rho, np.sqrt(_dot(d, d)) + across)
        for x in range(3):
            center[parent + group, x], disc[x, parent + group] = c[x], n[x]
        disc[3, parent + group], disc[4, parent + group] = rho, 0.5 * (most - least)


@nb.njit(cache=True, nogil=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    """Inner product of two vectors of three, however they lie in memory."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, nogil=True)
def _reach_along(disc, j, n):  # type: ignore[no-untyped-def]  # numba infers
    """How far a disc reaches from its centre along n, mm."""
    q = _dot(disc[:3, j], n)
    return disc[3, j] * np.sqrt(max(0.0, 1.0 - q * q)) + disc[4, j] * abs(q)
