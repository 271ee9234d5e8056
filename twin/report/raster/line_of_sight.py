"""What hides a few points from an eye, among many triangles, without a tree."""

# numba infers the types
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb

ROUNDING = 1e-6
"""mm; least half thickness of the slab."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def blocked(vertices, faces, starts, boxes, eye, points, slack):
    """Whether a triangle lies between the eye and each point.

    The sight lines lie in a thin slab about the plane through the eye and two of the points: hardly any
    triangle meets it when the points stand in a line, as along a needle. Those that do are tested one by one.
    Nor is a body looked at whose box lies beside the slab, or beside the box about eye and points.

    Args:
        vertices: Shape (n, 3), mm.
        faces: Shape (m, 3).
        starts: Shape (b + 1, 2), where each body's vertices and faces begin, and where the last one's end.
        boxes: Shape (b, 2, 3), lowest and highest corner of the box about each body, mm.
        eye: Shape (3,).
        points: Shape (k, 3).
        slack: mm; a triangle this close before a point does not hide it.

    Returns:
        Shape (k,), bool.
    """
    out = np.zeros(len(points), dtype=np.bool_)
    across = _across(eye, points)
    half = ROUNDING
    for k in range(len(points)):
        half = max(half, abs(((points[k] - eye) * across).sum()))
    beside = np.empty(len(vertices))
    for body in range(len(boxes)):
        if not _meets(boxes[body], eye, points, across, half):
            continue
        for i in range(starts[body, 0], starts[body + 1, 0]):
            beside[i] = _above(vertices, i, eye, across)
        for f in range(starts[body, 1], starts[body + 1, 1]):
            p, q, r = beside[faces[f, 0]], beside[faces[f, 1]], beside[faces[f, 2]]
            if min(p, q, r) > half or max(p, q, r) < -half:
                continue
            a, b, c = (
                _from(vertices, faces[f, 0], eye),
                _from(vertices, faces[f, 1], eye),
                _from(vertices, faces[f, 2], eye),
            )
            for k in range(len(points)):
                if not out[k]:
                    out[k] = _between(a, b, c, _from(points, k, eye), slack)
    return out


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _across(eye, points):
    """The unit normal of the plane through the eye and the two points that are farthest apart seen from it."""
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
    return across


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _meets(box, eye, points, across, half):
    """Whether a box may hold what lies between the eye and one of the points."""
    above, reach = 0.0, half + ROUNDING
    for i in range(3):
        above += ((box[0, i] + box[1, i]) / 2 - eye[i]) * across[i]
        reach += (box[1, i] - box[0, i]) / 2 * abs(across[i])
        low, high = eye[i], eye[i]
        for k in range(len(points)):
            low, high = min(low, points[k, i]), max(high, points[k, i])
        if box[0, i] > high + ROUNDING or box[1, i] < low - ROUNDING:
            return False
    return abs(above) <= reach


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _from(points, i, eye):
    """From the eye to one of the points."""
    return points[i, 0] - eye[0], points[i, 1] - eye[1], points[i, 2] - eye[2]


@nb.njit(cache=True, nogil=True, error_model="numpy", forceinline=True)
def _above(vertices, i, eye, across):
    """How far a vertex lies on one side of the plane through the eye, mm."""
    x, y, z = _from(vertices, i, eye)
    return x * across[0] + y * across[1] + z * across[2]


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
