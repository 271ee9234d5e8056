# mypy: disable-error-code="no-untyped-def"
"""A pinhole camera for the ray caster and for writing labels at projected points.

What hides a few points from an eye, among many triangles, without a tree.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import box_of
from puncture_twin.planning.geometry.rigid import frame_along


@dataclass(frozen=True, eq=False)
class ViewCamera:
    """A virtual camera in the CT frame.

    Attributes:
        eye: Shape (3,), mm.
        look_at: Shape (3,), mm.
        up: Shape (3,), any vector not along the view.
        fov: Vertical opening angle, rad.
    """

    eye: Floats
    look_at: Floats
    up: Floats
    fov: float
    width: int
    height: int

    @cached_property
    def axes(self) -> Floats:
        """Rows: right, up, forward; unit vectors, shape (3, 3)."""
        forward = np.asarray(self.look_at, dtype=float) - self.eye
        forward = forward / np.linalg.norm(forward)
        right, down, _ = frame_along(forward, -np.asarray(self.up)).T
        return np.stack([right, -down, forward])

    @property
    def scale(self) -> float:
        """Pixels per unit of the tangent: px = width / 2 + scale x / z."""
        return float(self.height / 2 / np.tan(self.fov / 2))

    def finer(self, factor: int) -> ViewCamera:
        """This view with more pixels."""
        return replace(self, width=self.width * factor, height=self.height * factor)

    def project(self, points_ct: Floats) -> Floats:
        """Pixel coordinates (column, row; (0, 0) is the top left corner) and depth along the view, shape (n, 3).

        A point behind the eye has a depth below zero and means nothing.
        """
        x, y, z = self.axes @ (np.asarray(points_ct, dtype=float).reshape(-1, 3) - self.eye).T
        with np.errstate(divide="ignore", invalid="ignore"):
            column, row = self.width / 2 + self.scale * x / z, self.height / 2 - self.scale * y / z
        return np.stack([column, row, z], axis=1)


SPARE = 1.05
"""How much wider than what must be seen a picture is."""


def camera_around(points_ct: Floats, toward: Floats, up: Floats, *, fov: float, width: int, height: int) -> ViewCamera:
    """A camera that looks along ``toward`` and has every point in view.

    Args:
        points_ct: Shape (n, 3), what must be seen.
        toward: Shape (3,), the direction of view.
        up: Shape (3,).
        fov: Vertical opening, rad.
    """
    points = np.asarray(points_ct, dtype=float)
    toward = np.asarray(toward, dtype=float) / np.linalg.norm(toward)
    centre = box_of(points).sum(axis=0) / 2
    axes = ViewCamera(centre - toward, centre, up, fov, width, height).axes
    for _ in range(3):  # centring shifts the perspective a little; three rounds leave less than a pixel
        local = (points - centre) @ axes.T
        slope = np.tan(fov / 2) / SPARE * np.array([width / height, 1.0])
        distance = float(np.max(np.abs(local[:, :2]) / slope - local[:, 2:]))
        seen = local[:, :2] / (local[:, 2:] + distance)
        middle = box_of(seen).sum(axis=0) / 2 * distance
        centre = centre + middle @ axes[:2]
    return ViewCamera(centre - distance * toward, centre, np.asarray(up, dtype=float), fov, width, height)


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
