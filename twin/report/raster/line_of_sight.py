"""What hides a few points from an eye, among many triangles, without a tree."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

ROUNDING = 1e-6
"""mm; least half thickness of the slab."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def blocked(vertices, faces, eye, points, slack):
    """Whether a triangle lies between the eye and each point.

    The sight lines lie in a thin slab about the plane through the eye and two of the points: hardly any
    triangle meets it when the points stand in a line, as along a needle. Those that do are tested one by one.

    Args:
        vertices: Shape (n, 3), mm.
        faces: Shape (m, 3).
        eye: Shape (3,).
        points: Shape (k, 3).
        slack: mm; a triangle this close before a point does not hide it.

    Returns:
        Shape (k,), bool.
    """
    out = np.zeros(len(points), dtype=np.bool_)
    across, longest = np.zeros(3), 0.0
    for k in range(len(points)):
        normal = _cross(points[0] - eye, points[k] - eye)
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        if length > longest:
            longest = length
            across[0], across[1], across[2] = normal[0] / length, normal[1] / length, normal[2] / length
    if longest == 0.0:  # one sight line: any plane through it
        direction = points[0] - eye
        normal = _cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
        length = np.sqrt(normal[0] ** 2 + normal[1] ** 2 + normal[2] ** 2)
        across[0], across[1], across[2] = normal[0] / length, normal[1] / length, normal[2] / length
    half = ROUNDING
    for k in range(len(points)):
        half = max(half, abs(((points[k] - eye) * across).sum()))
    beside = np.empty(len(vertices))
    for i in range(len(vertices)):
        beside[i] = (
            (vertices[i, 0] - eye[0]) * across[0]
            + (vertices[i, 1] - eye[1]) * across[1]
            + (vertices[i, 2] - eye[2]) * across[2]
        )
    for f in range(len(faces)):
        p, q, r = beside[faces[f, 0]], beside[faces[f, 1]], beside[faces[f, 2]]
        if min(p, q, r) > half or max(p, q, r) < -half:
            continue
        a, b, c = vertices[faces[f, 0]] - eye, vertices[faces[f, 1]] - eye, vertices[faces[f, 2]] - eye
        for k in range(len(points)):
            if not out[k]:
                out[k] = _between(a, b, c, points[k] - eye, slack)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _between(a, b, c, direction, slack):
    """Whether the triangle a, b, c is met on a way from the origin, more than a slack before its end."""
    p, q, r = _cross(b, c), _cross(c, a), _cross(a, b)
    volume = a[0] * p[0] + a[1] * p[1] + a[2] * p[2]
    wa = direction[0] * p[0] + direction[1] * p[1] + direction[2] * p[2]
    wb = direction[0] * q[0] + direction[1] * q[1] + direction[2] * q[2]
    wc = direction[0] * r[0] + direction[1] * r[1] + direction[2] * r[2]
    if volume < 0.0:
        volume, wa, wb, wc = -volume, -wa, -wb, -wc
    if volume == 0.0 or min(wa, wb, wc) < 0.0:
        return False
    far = np.sqrt(direction[0] ** 2 + direction[1] ** 2 + direction[2] ** 2)
    return volume / (wa + wb + wc) * far < far - slack


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _cross(a, b):
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
