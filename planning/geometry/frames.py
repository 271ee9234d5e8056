"""Frames from axes or points: rotations whose columns are the axes."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats


def frame_xz(x: Floats, z: Floats) -> Floats:
    """Rotations with columns x, y = z × x, z, shape (..., 3, 3), of unit vectors (..., 3) at a right angle."""
    return np.stack([x, np.cross(z, x), z], axis=-1)


def frame_yz(y: Floats, z: Floats) -> Floats:
    """Rotations with columns x = y × z, y, z, shape (..., 3, 3), of unit vectors (..., 3) at a right angle."""
    return np.stack([np.cross(y, z), y, z], axis=-1)


def frame_of_axes(z: Floats, x: Floats) -> Floats:
    """The rotation whose z axis lies along one vector (3,) and whose x axis is what of another is square to it."""
    # z = z / |z|,  x = x - z (x · z), made a unit vector: Gram and Schmidt
    z = z / np.linalg.norm(z)
    x = x - z * (x @ z)
    return frame_xz(x / np.linalg.norm(x), z)


def frame_along(z: Floats, down: Floats) -> Floats:
    """The rotation with a unit vector z (3,) as its z axis and x = down × z, made a unit vector; y is nearest to down.

    A camera's frame, where z is its view and ``down`` (3,), not parallel to it, is down in its picture.
    """
    x = np.cross(down, z)
    return frame_xz(x / np.linalg.norm(x), z)


def frame_about(z: Floats) -> Floats:
    """Some rotation with a unit vector z (3,) as its z axis; x is square to the base vector farthest from z."""
    return frame_along(z, np.eye(3)[int(np.argmin(np.abs(z)))])


def frame_of_points(points: Floats) -> Floats:
    """Rotations of the frames that three points (..., 3, 3) span (Chen 2019, Eq. 1-6), columns e1, e2, e3."""
    # e1 = (p2 - p1) / |..|,  e3 = e1 × (p3 - p1) / |..|,  e2 = e3 × e1
    e1 = points[..., 1, :] - points[..., 0, :]
    e1 = e1 / np.sqrt(np.vecdot(e1, e1))[..., None]
    e3 = np.cross(e1, points[..., 2, :] - points[..., 0, :])
    return frame_xz(e1, e3 / np.sqrt(np.vecdot(e3, e3))[..., None])
