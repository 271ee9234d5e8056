"""Where a plane cuts surfaces, and where it cuts the ellipsoid of the tip."""

from __future__ import annotations

import numpy as np
import trimesh

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.slices.planes import Plane


def outline(mesh: TriangleMesh, plane: Plane) -> Floats:
    """The cut of a surface, shape (n, 2, 2): segments in the plane, mm to the right and up of the target."""
    height = (mesh.vertices - plane.at_ct) @ plane.normal
    if height.min() > 0 or height.max() < 0:
        return np.zeros((0, 2, 2))
    surface = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
    segments = trimesh.intersections.mesh_plane(surface, plane.normal, plane.at_ct, cached_dots=height)
    return plane.place(np.asarray(segments).reshape(-1, 2, 3))


def ellipse(region_ct: Floats, plane: Plane, points: int = 121) -> Floats:
    """The cut of the ellipsoid x' inv(region) x = 1 about the target, a closed line of shape (points, 2), mm.

    Of a region without thickness across the plane's axes the line is flat, as it is.
    """
    basis = np.stack([plane.right, plane.up])
    inverse = basis @ np.linalg.pinv(region_ct, hermitian=True) @ basis.T
    values, vectors = np.linalg.eigh(inverse)
    turns = np.linspace(0.0, 2 * np.pi, points)
    half = 1.0 / np.sqrt(np.maximum(values, np.finfo(float).tiny))
    return np.asarray((vectors @ (half[:, None] * np.stack([np.cos(turns), np.sin(turns)]))).T)
