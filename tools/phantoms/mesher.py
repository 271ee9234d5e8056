"""From an implicit body to a smooth closed mesh: marching cubes, even triangles, vertices on the zero set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.ndimage import zoom
from scipy.sparse import csr_matrix
from skimage.measure import marching_cubes

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import Faces, TriangleMesh
from tools.phantoms.implicit import Field

_COARSE = 4
"""Grid nodes per coarse node. Far from the surface the coarse values, interpolated, are good enough."""
_BAND = 1.6
"""Width of the exactly evaluated band in coarse cell diagonals: fields may grow by up to 1.6 per mm or 1 / 1.6."""
_RELAXATIONS = 14
"""Rounds of tangential smoothing; after 14 the worst angles no longer improve."""
_STEP = 0.5
"""Fraction of the way to the neighbours' mean that a vertex moves in one round."""
_PROBE_MM = 1e-3
"""Half step of the central differences. Fields are smooth on this scale, and rounding is 1e-11 of it."""
_PROJECTIONS = 20
"""Most Newton steps at the end; three suffice where the field is smooth, creases take more."""
_ON_SURFACE_MM = 1e-5
"""A vertex this near to the zero set stays; files hold float32, whose step is 1.5e-5 mm at 200 mm."""


@dataclass(frozen=True)
class SamplingBox:
    """Where to look for a body: opposite corners, mm, and the grid's spacing, mm."""

    low: tuple[float, float, float]
    high: tuple[float, float, float]
    spacing_mm: float


def mesh_field(field: Field, box: SamplingBox) -> TriangleMesh:
    """The zero set of a field as a closed mesh, triangles outward; a body that touches the box is a ValueError."""
    surface = marched(field, box)
    return TriangleMesh(_relax(field, surface.vertices, surface.faces, box.spacing_mm), surface.faces)


def marched(field: Field, box: SamplingBox) -> TriangleMesh:
    """The zero set of a field by marching cubes alone, triangles outward; arguments and errors as for `mesh_field`."""
    values = _sample(field, box)
    rim = np.ones(values.shape, dtype=bool)
    rim[1:-1, 1:-1, 1:-1] = False
    if values[rim].min() <= 0 or values.min() >= 0:
        raise ValueError(f"the body must lie inside the box {box} and not touch it")
    vertices, faces, _, _ = marching_cubes(values, 0.0, spacing=(box.spacing_mm,) * 3)
    vertices = vertices.astype(float) + np.asarray(box.low)
    return outward(vertices, faces.astype(np.int32))


def _sample(field: Field, box: SamplingBox) -> Floats:
    """Field values on the grid, exact in a band about the surface, interpolated elsewhere."""
    low, high = np.asarray(box.low), np.asarray(box.high)
    cells = _COARSE * np.ceil((high - low) / (box.spacing_mm * _COARSE)).astype(int)
    axes = [low[i] + box.spacing_mm * np.arange(cells[i] + 1) for i in range(3)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    coarse_grid = grid[::_COARSE, ::_COARSE, ::_COARSE]
    coarse = field(coarse_grid.reshape(-1, 3)).reshape(coarse_grid.shape[:3])
    values = zoom(coarse, np.asarray(grid.shape[:3]) / coarse.shape, order=1, grid_mode=False)
    near = np.abs(values) < _BAND * _COARSE * box.spacing_mm * np.sqrt(3.0)
    values[near] = field(grid[near])
    return np.asarray(values)


def outward(vertices: Floats, faces: Faces) -> TriangleMesh:
    """The mesh with all of its triangles turned where its volume has a sign."""
    a, b, c = np.moveaxis((vertices - vertices.mean(axis=0))[faces], 1, 0)
    return TriangleMesh(vertices, faces if np.sum(a * np.cross(b, c)) > 0 else np.ascontiguousarray(faces[:, ::-1]))


def _relax(field: Field, vertices: Floats, faces: Faces, spacing_mm: float) -> Floats:
    """Slide the vertices along the surface to even spacing, then put them onto the zero set."""
    mean = _neighbour_mean(faces, len(vertices))
    for _ in range(_RELAXATIONS):
        normals = _vertex_normals(vertices, faces)
        pull = mean @ vertices - vertices
        pull -= np.sum(pull * normals, axis=1, keepdims=True) * normals
        vertices = vertices + _STEP * pull
        vertices = _along(field, vertices, normals, spacing_mm)
    return _project(field, vertices, spacing_mm)


def _along(field: Field, vertices: Floats, directions: Floats, spacing_mm: float) -> Floats:
    """One Newton step along given directions; at most a quarter of the grid spacing."""
    value = field(vertices)
    slope = (field(vertices + _PROBE_MM * directions) - value) / _PROBE_MM
    step = np.clip(-value / np.maximum(slope, 0.3), -spacing_mm / 4, spacing_mm / 4)
    return np.asarray(vertices + step[:, None] * directions)


def _project(field: Field, vertices: Floats, spacing_mm: float) -> Floats:
    """Newton steps along the gradient, each at most a quarter of the spacing, halved where it does not help."""
    vertices, values = vertices.copy(), field(vertices)
    damping = np.ones(len(vertices))
    for _ in range(_PROJECTIONS):
        open_ = np.abs(values) > _ON_SURFACE_MM
        here, value = vertices[open_], values[open_]
        gradient = field_gradient(field, here)
        step = -(value / np.maximum(np.sum(gradient**2, axis=1), 0.1))[:, None] * gradient
        length = np.maximum(np.linalg.norm(step, axis=1), 1e-12)
        trial = here + step * (damping[open_] * np.minimum(1.0, spacing_mm / 4 / length))[:, None]
        reached = field(trial)
        better = np.abs(reached) < np.abs(value)
        damping[open_] = np.where(better, 1.0, damping[open_] / 2)
        vertices[open_] = np.where(better[:, None], trial, here)
        values[open_] = np.where(better, reached, value)
    return vertices


def field_gradient(field: Field, points: Floats) -> Floats:
    """Gradient of a field by central differences, shape (n, 3)."""
    probes = _PROBE_MM * np.eye(3)
    return np.stack([(field(points + probe) - field(points - probe)) / (2 * _PROBE_MM) for probe in probes], axis=1)


def _neighbour_mean(faces: Faces, count: int) -> csr_matrix:
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    edges = np.unique(np.sort(edges, axis=1), axis=0)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    links = csr_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    degree = np.asarray(links.sum(axis=1)).ravel()
    return csr_matrix(links.multiply(1.0 / degree[:, None]))


def _vertex_normals(vertices: Floats, faces: Faces) -> Floats:
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    area = np.cross(b - a, c - a)
    corners, shares = faces.ravel(), np.repeat(area, 3, axis=0).T
    normals = np.stack([np.bincount(corners, weights=share, minlength=len(vertices)) for share in shares], axis=1)
    return np.asarray(normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12))
