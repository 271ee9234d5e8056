"""Where a plane cuts surfaces, the needle, and the ellipsoid of the tip."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.slices.planes import Plane


def outline(mesh: TriangleMesh, plane: Plane) -> Floats:
    """The cut of a surface, shape (n, 2, 2): segments in the plane, mm to the right and up of the target.

    Nothing of a surface whose box does not reach what the plane shows.
    """
    if not _is_seen(mesh, plane):
        return np.zeros((0, 2, 2))
    height = plane.height(mesh.vertices)
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


def _is_seen(mesh: TriangleMesh, plane: Plane) -> bool:
    """Whether a surface's box reaches the part of the plane that is shown."""
    low, high = mesh.bounds
    middle, half = (low + high) / 2, (high - low) / 2
    axes = np.stack([plane.right, plane.up, plane.normal])
    shown, reach = np.array([*plane.centre, 0.0]), np.array([plane.half_mm, plane.half_mm, 0.0])
    return bool(np.all(np.abs(axes @ (middle - plane.at_ct) - shown) <= np.abs(axes) @ half + reach))


def capsule(outward_ct: Floats, length_mm: float, radius_mm: float, plane: Plane, points: int = 181) -> Floats:
    """The cut of all that lies within a radius of a piece of the needle's axis, a closed line, shape (2 * points, 2).

    With a along the axis' shadow in the plane and b across it, the axis' nearest point to (a, b) is s = a sin(phi),
    kept within 0..length; phi is the angle between axis and normal, and b^2 = radius^2 - (a^2 - 2 a s sin(phi) + s^2).

    Args:
        outward_ct: From the target along the needle, unit, shape (3,).
        length_mm: The piece's length; it begins at the target.
        radius_mm: Greater than 0.
        plane: A plane through the target.
        points: On each of the line's two sides.

    Returns:
        In the plane, mm to the right and up of the target.
    """
    shadow = np.array([outward_ct @ plane.right, outward_ct @ plane.up])
    sine, cosine = min(1.0, float(np.linalg.norm(shadow))), abs(float(outward_ct @ plane.normal))
    along = shadow / sine if sine > 0 else np.array([1.0, 0.0])
    if radius_mm * sine <= length_mm * cosine:  # the plane leaves the piece through its side
        far = radius_mm / cosine
    else:
        far = length_mm * sine + np.sqrt(max(0.0, radius_mm**2 - (length_mm * cosine) ** 2))
    turns = np.linspace(0.0, np.pi, points)
    a = (far - radius_mm) / 2 - (far + radius_mm) / 2 * np.cos(turns)
    s = np.clip(a * sine, 0.0, length_mm)
    b = np.sqrt(np.maximum(0.0, radius_mm**2 - (a**2 - 2 * a * s * sine + s**2)))
    a, b = np.concatenate([a, a[::-1]]), np.concatenate([b, -b[::-1]])
    return np.asarray(a[:, None] * along + b[:, None] * np.array([-along[1], along[0]]))


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
