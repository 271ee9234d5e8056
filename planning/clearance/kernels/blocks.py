"""A surface packed for the fast search: blocks of 16 triangles under an implicit 16-ary tree of discs.

Each disc bounds a block's triangles, or 16 discs of the level below.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh

FAR_MM = 1e15
"""Where the nodes lie that only fill a level up to whole groups: farther than any needle is long."""


@dataclass(frozen=True, eq=False)
class Blocks:
    """One surface, packed. Made once per patient; nothing here depends on the target.

    A node is a thick disc: for every point p of its triangles |(p - c) . n| <= h, and p is within rho of the axis
    through c along n. Level 0 holds the blocks; node j of a level holds nodes 16 j to 16 j + 15 of the level below.
    """

    triangles: Floats
    """Shape (16 b, 9), corners in block order, mm; the last block is filled up with its last triangle."""
    local: NDArray[np.float32]
    """Shape (b, 9, 16), float32, the same corners relative to their block's centre."""
    center: Floats  # shape (nodes, 3), c, all levels one after the other, mm
    disc: NDArray[np.float32]  # shape (5, nodes), float32, the normal n, rho and h, rounded outward
    base: NDArray[np.int64]
    """Shape (levels,), the group of 16 with which each level starts; levels fill whole groups."""

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays."""
        return sum(array.nbytes for array in (self.triangles, self.local, self.center, self.disc, self.base))


def pack(mesh: TriangleMesh) -> Blocks:
    """Pack a surface."""
    order = kd_order(_middles(mesh.vertices, mesh.faces), LANES)
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
    return Blocks(triangles, local, center, _rounded_outward(disc), base[:-1] // LANES)


def _rounded_outward(disc: Floats) -> NDArray[np.float32]:
    """Convert to float32, radius and thickness grown by more than the rounding of anything that made them.

    A rounded normal is rotated by up to 6e-8: what lies at the rim of a wide, flat disc rises by as much of its radius.
    """
    grown = disc.copy()
    grown[3:] = grown[3:] * (1 + 1e-5) + 1e-6 + 1e-6 * disc[3:].sum(axis=0)
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


CANCELLED_FRACTION = 1e-6
"""Length of a block's mean normal over its triangles' area, below which it is rounding: the normals cancel."""
LEAST_NORMAL_MM2 = 1e-140
"""Length of a mean normal, mm^2, below which it is not used: its square is near the least number, and inexact."""


@allocation_free(nogil=True)
def block_discs(triangles, local, center, disc):  # type: ignore[no-untyped-def]  # numba infers
    """Disc of every block, and its corners relative to the disc's centre."""
    for block in range(len(local)):
        corners = triangles[block * LANES : (block + 1) * LANES]
        n = _mean_normal(corners)
        c = _center_along(corners, n, _middle_of_box(corners))
        rho2, h = 0.0, 0.0
        for row in range(LANES):
            for corner in range(0, 9, 3):
                d = corners[row, corner] - c[0], corners[row, corner + 1] - c[1], corners[row, corner + 2] - c[2]
                up = _dot(d, n)
                across = d[0] - up * n[0], d[1] - up * n[1], d[2] - up * n[2]
                rho2, h = max(rho2, _dot(across, across)), max(h, abs(up))
                for x in range(3):
                    local[block, corner + x, row] = d[x]
        for x in range(3):
            center[block, x], disc[x, block] = c[x], n[x]
        disc[3, block], disc[4, block] = np.sqrt(rho2), h


@allocation_free(nogil=True)
def _middle_of_box(corners):  # type: ignore[no-untyped-def]  # numba infers
    return _middle_of(corners, 0), _middle_of(corners, 1), _middle_of(corners, 2)


@allocation_free(nogil=True)
def _middle_of(corners, x):  # type: ignore[no-untyped-def]  # numba infers
    """Middle of a block's corners along one axis."""
    least, most = np.inf, -np.inf
    for row in range(LANES):
        for corner in range(0, 9, 3):
            least, most = min(least, corners[row, corner + x]), max(most, corners[row, corner + x])
    return 0.5 * (least + most)


@allocation_free(nogil=True)
def _center_along(corners, n, c):  # type: ignore[no-untyped-def]  # numba infers
    """A centre moved along the normal to the middle of what it must hold."""
    least, most = np.inf, -np.inf
    for row in range(LANES):
        for corner in range(0, 9, 3):
            d = corners[row, corner] - c[0], corners[row, corner + 1] - c[1], corners[row, corner + 2] - c[2]
            up = _dot(d, n)
            least, most = min(least, up), max(most, up)
    half = 0.5 * (least + most)
    return c[0] + half * n[0], c[1] + half * n[1], c[2] + half * n[2]


@allocation_free(nogil=True)
def _mean_normal(corners):  # type: ignore[no-untyped-def]  # numba infers
    """Unit mean of the triangles' normals by area, all flipped to the side of the largest; z where there is none."""
    first, largest = (0.0, 0.0, 0.0), 0.0
    for row in range(LANES):
        normal = _normal(corners[row])
        size = np.sqrt(_dot(normal, normal))
        if size > largest:
            first, largest = normal, size
    x, y, z, area = 0.0, 0.0, 0.0, 0.0
    for row in range(LANES):
        normal = _normal(corners[row])
        area += np.sqrt(_dot(normal, normal))
        sign = -1.0 if _dot(normal, first) < 0.0 else 1.0
        x, y, z = x + sign * normal[0], y + sign * normal[1], z + sign * normal[2]
    norm = np.sqrt(x * x + y * y + z * z)
    if not norm > max(CANCELLED_FRACTION * area, LEAST_NORMAL_MM2):
        return 0.0, 0.0, 1.0
    return x / norm, y / norm, z / norm


@allocation_free(nogil=True)
def _normal(a):  # type: ignore[no-untyped-def]  # numba infers
    dx, dy, dz, ex, ey, ez = a[3] - a[0], a[4] - a[1], a[5] - a[2], a[6] - a[0], a[7] - a[1], a[8] - a[2]
    return dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex


@allocation_free(nogil=True)
def parent_discs(center, disc, child, count, parent):  # type: ignore[no-untyped-def]  # numba infers
    """Discs of one level around those of the level below, whose nodes ``child`` ... ``child + count`` they hold."""
    for group in range((count + LANES - 1) // LANES):
        low = child + group * LANES
        high = min(low + LANES, child + count)
        n = _mean_of_discs(disc, low, high)
        c, h = _center_of_discs(center, disc, low, high, n)
        rho = 0.0
        for j in range(low, high):
            rho = max(rho, _reach_across(center, disc, j, n, c))
        for x in range(3):
            center[parent + group, x], disc[x, parent + group] = c[x], n[x]
        disc[3, parent + group], disc[4, parent + group] = rho, h


@allocation_free(nogil=True)
def _mean_of_discs(disc, low, high):  # type: ignore[no-untyped-def]  # numba infers
    """Unit mean of the discs' normals by area, all flipped to the side of the first; z where there is none."""
    first = _axis(disc, low)
    x, y, z = 0.0, 0.0, 0.0
    for j in range(low, high):
        n, square = _axis(disc, j), disc[3, j] ** 2
        sign = 1.0 if _dot(n, first) >= 0.0 else -1.0
        x, y, z = x + sign * n[0] * square, y + sign * n[1] * square, z + sign * n[2] * square
    norm = np.sqrt(_dot((x, y, z), (x, y, z)))
    return (x / norm, y / norm, z / norm) if norm > LEAST_NORMAL_MM2 else (0.0, 0.0, 1.0)


@allocation_free(nogil=True)
def _center_of_discs(center, disc, low, high, n):  # type: ignore[no-untyped-def]  # numba infers
    """Mean of the discs' centres, moved along the normal to the middle of what it must hold; half of that."""
    x, y, z, many = 0.0, 0.0, 0.0, high - low
    for j in range(low, high):
        x, y, z = x + center[j, 0] / many, y + center[j, 1] / many, z + center[j, 2] / many
    least, most = np.inf, -np.inf
    for j in range(low, high):
        up, reach = _dot((center[j, 0] - x, center[j, 1] - y, center[j, 2] - z), n), _reach_along(disc, j, n)
        least, most = min(least, up - reach), max(most, up + reach)
    half = 0.5 * (least + most)
    return (x + half * n[0], y + half * n[1], z + half * n[2]), 0.5 * (most - least)


@allocation_free(nogil=True)
def _reach_along(disc, j, n):  # type: ignore[no-untyped-def]  # numba infers
    """How far a disc's points reach from its centre along n, mm: sqrt(1 - (n.m)^2) rho + |n.m| h, m its own normal."""
    q = _dot(_axis(disc, j), n)
    return disc[3, j] * np.sqrt(max(0.0, 1.0 - q * q)) + disc[4, j] * abs(q)


@allocation_free(nogil=True)
def _reach_across(center, disc, j, n, c):  # type: ignore[no-untyped-def]  # numba infers
    """How far a disc's points reach from the axis through c along n, mm: from its own, rho + sqrt(1 - (n.m)^2) h."""
    d = center[j, 0] - c[0], center[j, 1] - c[1], center[j, 2] - c[2]
    up, q = _dot(d, n), _dot(_axis(disc, j), n)
    aside = d[0] - up * n[0], d[1] - up * n[1], d[2] - up * n[2]
    return np.sqrt(_dot(aside, aside)) + (disc[3, j] + disc[4, j] * np.sqrt(max(0.0, 1.0 - q * q)))


@allocation_free(nogil=True)
def _axis(disc, j):  # type: ignore[no-untyped-def]  # numba infers
    return disc[0, j], disc[1, j], disc[2, j]


@allocation_free(nogil=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]
