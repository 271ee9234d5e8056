"""Where a plane cuts surfaces, and where it cuts the ellipsoid of the tip."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.slices.planes import Plane


def outline(mesh: TriangleMesh, plane: Plane) -> Floats:
    """The cut of a surface, shape (n, 2, 2): segments in the plane, mm to the right and up of the target."""
    height = (mesh.vertices - plane.at_ct) @ plane.normal
    above = height > 0  # a corner in the plane counts as below it: every triangle is cut in no edge or in two
    if above.all() or not above.any():
        return np.zeros((0, 2, 2))
    sides = above[mesh.faces]
    cut = np.flatnonzero((sides[:, 0] != sides[:, 1]) | (sides[:, 0] != sides[:, 2]))
    sides, faces = sides[cut], mesh.faces[cut]
    alone = np.where(sides[:, 0] == sides[:, 1], 2, np.where(sides[:, 0] == sides[:, 2], 1, 0))
    row = np.arange(len(faces))
    tip, others = faces[row, alone], np.stack([faces[row, (alone + 1) % 3], faces[row, (alone + 2) % 3]], axis=1)
    along = (height[tip] / (height[tip] - height[others].T)).T[:, :, None]
    ends = mesh.vertices[tip][:, None] * (1 - along) + mesh.vertices[others] * along
    return plane.place(ends)


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
