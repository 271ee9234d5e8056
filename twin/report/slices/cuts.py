"""Where a plane cuts surfaces, the needle, and the ellipsoid of the tip."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.report.slices.planes import Plane


def outline(mesh: TriangleMesh, plane: Plane) -> Floats:
    """The cut of a surface, shape (n, 2, 2): segments in the plane, mm to the right and up of the target.

    Nothing of a surface whose box does not reach what the plane shows.
    """
    if not _is_seen(mesh, plane):
        return np.zeros((0, 2, 2))
    return plane.place(_cut(mesh.vertices, mesh.faces, tuple(plane.normal), plane.at_ct @ plane.normal))


@nb.njit(cache=True, error_model="numpy")
def _cut(vertices, faces, normal, offset):
    """Where a plane cuts a mesh's triangles, shape (n, 2, 3), mm, in the order of the triangles.

    Args:
        vertices: Shape (v, 3), mm, read-only.
        faces: Shape (m, 3), read-only.
        normal: The plane's, three numbers.
        offset: Of its points along the normal, mm.
    """
    height = np.empty(len(vertices))
    for v in range(len(vertices)):
        x, y, z = vertices[v, 0] * normal[0], vertices[v, 1] * normal[1], vertices[v, 2] * normal[2]
        height[v] = x + y + z - offset
    first = np.empty(len(faces), dtype=np.int8)  # the corner that is alone on its side
    count = 0
    for f in range(len(faces)):
        # a corner in the plane counts as below it: every triangle is cut in no edge or in two
        a, b, c = height[faces[f, 0]] > 0, height[faces[f, 1]] > 0, height[faces[f, 2]] > 0
        first[f] = (-1 if b == c else 2) if a == b else (1 if a == c else 0)
        count += first[f] >= 0
    ends = np.empty((count, 2, 3))
    count = 0
    for f in range(len(faces)):
        if first[f] >= 0:
            tip = faces[f, first[f]]
            for k in range(2):
                other = faces[f, (first[f] + 1 + k) % 3]
                along = height[tip] / (height[tip] - height[other])
                for axis in range(3):
                    ends[count, k, axis] = vertices[tip, axis] * (1 - along) + vertices[other, axis] * along
            count += 1
    return ends


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
