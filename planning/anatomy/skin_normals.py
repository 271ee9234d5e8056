"""Normals of a skin that was made from voxels, over a scale at which its stairs do not show.

The normal at a point p is that of the skin's area about it, of the triangles i that look its way:

    n(p) ~ sum_i a_i exp(-|c_i - p|^2 / 2 s^2),      g_i . g(p) > cosine

a_i the area vector of a triangle, c_i its centre. This is a bilateral filter of normals (Zheng et al., IEEE Trans. Vis.
Comput. Graph. 17, 2011) with a threshold: an arm across a gap of air, the other side of a fold, and the next side of a
box look elsewhere. The way g that the skin looks is first taken by the same rule over a small scale, with the stairs'
own normals as ways; then over the whole one.
"""

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh, unit_vectors

NEAR_MM, NORMAL_MM = 4.0, 8.0
"""Standard deviations of the two Gaussians: several voxels of 2 mm, and less than what a body bends by."""
NEAR_COSINE, NORMAL_COSINE = 0.0, 0.5
REACH = 2.5
"""Standard deviations beyond which a triangle does not count."""
MERGED = 0.5
"""Edge, standard deviations, of the cells in which triangles that look along one axis are merged: each counts at the
middle of them, so that what is lost is of fourth order."""


def broad_normals(mesh: TriangleMesh, counted: NDArray[np.bool_]) -> Floats:
    """Unit normals at the vertices of a mesh wound outward, LPS mm; shape (n, 3).

    Only triangles that are ``counted``, shape (m,), are skin: not those where the field of view ends. A vertex about
    which none is keeps the normal of its own triangles.
    """
    corners, faces = mesh.triangles, mesh.faces
    areas, centres = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2, corners.mean(axis=1)
    at_vertices = [np.bincount(faces.ravel(), np.repeat(part, 3), len(mesh.vertices)) for part in areas.T]
    ways, looks = unit_vectors(np.stack(at_vertices, axis=1)), areas
    for scale, cosine in ((NEAR_MM, NEAR_COSINE), (NORMAL_MM, NORMAL_COSINE)):
        parts = merged(centres[counted], areas[counted], unit_vectors(looks[counted]), MERGED * scale)
        ways = averaged(mesh.vertices, ways, parts, scale, cosine)
        looks = ways[faces].sum(axis=1)
    return ways


def merged(centres: Floats, areas: Floats, ways: Floats, edge: float) -> tuple[Floats, Floats, Floats]:
    """Centres, area vectors and ways (m, 3) of triangles, as one where they lie in a cell and look along one axis."""
    if not len(centres):
        return centres, areas, ways
    axis = np.abs(ways).argmax(axis=1)
    side = 2 * axis + (np.take_along_axis(ways, axis[:, None], axis=1)[:, 0] > 0.0)
    cell = np.floor((centres - centres.min(axis=0)) / edge).astype(np.int64)
    _, group = np.unique(np.ravel_multi_index((*cell.T, side), (*(cell.max(axis=0) + 1), 6)), return_inverse=True)
    weights = np.linalg.norm(areas, axis=1)

    def summed(vectors: Floats) -> Floats:
        return np.stack([np.bincount(group, part) for part in vectors.T], axis=1)

    whole = np.bincount(group, weights)[:, None]
    means = np.divide(summed(weights[:, None] * centres), whole, out=summed(centres), where=whole > 0.0)
    return means, summed(areas), unit_vectors(summed(weights[:, None] * ways))


def averaged(points: Floats, ways: Floats, parts: tuple[Floats, Floats, Floats], scale: float, cosine: float) -> Floats:
    """Normal of the parts (centres, area vectors, ways) about each point (n, 3) that look its way; or that way."""
    if not len(parts[0]):
        return ways
    reach, low = REACH * scale, np.minimum(points.min(axis=0), parts[0].min(axis=0)) - REACH * scale
    cells = np.floor((parts[0] - low) / reach).astype(np.int64)
    shape = np.floor((np.maximum(points.max(axis=0), parts[0].max(axis=0)) - low) / reach).astype(np.int64) + 2
    key = np.ravel_multi_index(tuple(cells.T), tuple(shape))
    order = np.argsort(key, kind="stable")
    starts = np.searchsorted(key[order], np.arange(shape.prod() + 1))
    totals = np.array(ways)
    where, areas, looks = (part[order] for part in parts)
    _average(np.array(points), where, areas, looks, low, reach, shape, starts, scale, cosine, totals)
    return unit_vectors(totals)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def _average(points, centres, areas, looks, low, reach, shape, starts, scale, cosine, ways):  # type: ignore[no-untyped-def]
    """Replace each way (n, 3) by the sum for its point; parts are sorted by cells of a reach, which begin at starts."""
    for at in range(len(points)):
        x, y, z = points[at, 0], points[at, 1], points[at, 2]
        u, v, w = ways[at, 0], ways[at, 1], ways[at, 2]
        i = np.int64((x - low[0]) / reach)
        j = np.int64((y - low[1]) / reach)
        k = np.int64((z - low[2]) / reach)
        sx, sy, sz = 0.0, 0.0, 0.0
        for a in range(i - 1, i + 2):
            for b in range(j - 1, j + 2):
                row = (a * shape[1] + b) * shape[2] + k
                for part in range(starts[row - 1], starts[row + 2]):  # three cells in a row
                    dx, dy, dz = centres[part, 0] - x, centres[part, 1] - y, centres[part, 2] - z
                    square = dx * dx + dy * dy + dz * dz
                    facing = looks[part, 0] * u + looks[part, 1] * v + looks[part, 2] * w
                    if square < reach * reach and facing > cosine:
                        weight = np.exp(-square / (2.0 * scale * scale))
                        sx += weight * areas[part, 0]
                        sy += weight * areas[part, 1]
                        sz += weight * areas[part, 2]
        if sx != 0.0 or sy != 0.0 or sz != 0.0:
            ways[at, 0], ways[at, 1], ways[at, 2] = sx, sy, sz
