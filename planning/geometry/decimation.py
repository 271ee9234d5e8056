"""Fewer triangles within a stated bound, or the mesh as it was."""

from __future__ import annotations

from typing import NamedTuple

import fast_simplification
import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.triangle_distance import squared_distance

REDUCTIONS = (0.9, 0.75, 0.5)
"""Shares of the triangles to take away, tried from the greatest."""
MIN_TRIANGLES = 200
"""Not worth the trouble below."""
CANDIDATES = (4, 16, 64)
"""Samples of the other surface whose triangles are looked at, more only for points that still seem too far. Never
all triangles, so a distance may come out too great, not too small."""
MAX_DIVISIONS = 64
"""Of a triangle's edge: 2145 samples on the largest triangles."""
CHUNK = 20_000
"""Samples at a time: 60 MB of triangles."""


def decimated(mesh: TriangleMesh, max_deviation_mm: float) -> TriangleMesh:
    """The mesh with fewer triangles (quadric edge collapse, Garland and Heckbert 1997), measured afterwards.

    The two-sided deviation is measured at the vertices of both meshes and at samples on their triangles that
    stand no further apart than the vertices of the original (its median longest edge). If it breaks the bound,
    or the result is not closed although the mesh was, a smaller reduction is tried, and in the end the mesh
    itself is returned.

    Args:
        mesh: Any mesh.
        max_deviation_mm: The bound, mm.
    """
    if len(mesh.faces) < MIN_TRIANGLES:
        return mesh
    spacing_mm = float(np.median(_longest_edges(mesh)))
    centre = mesh.bounds.mean(axis=0)  # the simplifier may work in float32: keep the coordinates small
    for reduction in REDUCTIONS:
        vertices, faces = fast_simplification.simplify(
            np.ascontiguousarray(mesh.vertices - centre), mesh.faces.copy(), target_reduction=reduction
        )
        smaller = TriangleMesh(vertices.astype(np.float64) + centre, faces)
        if not _usable(smaller, mesh):
            continue
        if deviation_mm(smaller, mesh, spacing_mm=spacing_mm, enough_mm=max_deviation_mm) <= max_deviation_mm:
            return smaller
    return mesh


def deviation_mm(a: TriangleMesh, b: TriangleMesh, *, spacing_mm: float, enough_mm: float) -> float:
    """Largest sampled distance from one surface to the other, both ways (mm); never below that of its samples.

    Args:
        a: One mesh.
        b: The other.
        spacing_mm: Greatest distance between neighbouring samples within a triangle.
        enough_mm: Distances below this need not be exact: they may come out too great, but not above it.
    """
    return max(_one_sided_mm(a, b, spacing_mm, enough_mm), _one_sided_mm(b, a, spacing_mm, enough_mm))


def _usable(smaller: TriangleMesh, mesh: TriangleMesh) -> bool:
    sound = len(smaller.faces) > 0 and bool(np.isfinite(smaller.vertices).all())
    return sound and (smaller.closed or not mesh.closed) and _volume(smaller) * _volume(mesh) > 0


def _volume(mesh: TriangleMesh) -> float:
    a, b, c = mesh.triangles.swapaxes(0, 1)
    return float(np.einsum("ij,ij->", a, np.cross(b, c))) / 6.0


def _one_sided_mm(source: TriangleMesh, goal: TriangleMesh, spacing_mm: float, enough_mm: float) -> float:
    points = np.concatenate([source.vertices, _samples(source, spacing_mm).points])
    near = _samples(goal, spacing_mm)
    tree = scipy.spatial.cKDTree(near.points)
    distances = np.full(len(points), np.inf)
    for count in CANDIDATES:
        far = np.flatnonzero(distances > enough_mm)
        for start in range(0, len(far), CHUNK):
            part = far[start : start + CHUNK]
            _, nearest = tree.query(points[part], k=min(count, len(near.points)))
            candidates = near.triangle[np.reshape(nearest, (len(part), -1))]
            squares = squared_distance(points[part][:, None, :], goal.triangles[candidates])
            distances[part] = np.sqrt(squares.min(axis=1))
    return float(distances.max())


class _Samples(NamedTuple):
    """Points (n, 3) on a surface and the triangle (n,) that each lies on."""

    points: NDArray[np.float64]
    triangle: NDArray[np.int64]


def _samples(mesh: TriangleMesh, spacing_mm: float) -> _Samples:
    """Each triangle's centre, and a barycentric grid on those with edges longer than the spacing."""
    triangles = mesh.triangles
    divisions = np.clip(np.ceil(_longest_edges(mesh) / spacing_mm - 0.01), 1, MAX_DIVISIONS).astype(int)
    points, owners = [triangles.mean(axis=1)], [np.arange(len(triangles))]
    for count in np.unique(divisions[divisions > 1]):
        grid = np.array([(i, j, count - i - j) for i in range(count + 1) for j in range(count + 1 - i)]) / count
        chosen = np.flatnonzero(divisions == count)
        points.append(np.einsum("gc,tcx->tgx", grid, triangles[chosen]).reshape(-1, 3))
        owners.append(np.repeat(chosen, len(grid)))
    return _Samples(np.concatenate(points), np.concatenate(owners))


def _longest_edges(mesh: TriangleMesh) -> NDArray[np.float64]:
    corners = mesh.triangles
    return np.asarray(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1))
