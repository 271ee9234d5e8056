"""Pictures of the workcell, drawn without a screen or a graphics card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.twin.world.client import pybullet, to_m

FIELD_OF_VIEW_DEG = 45.0
NEAR_M = 0.05
FAR_M = 10.0

LIGHT_UP = 1.5
"""The lamp hangs above the camera: its direction is the camera's plus this much of up."""


@dataclass(frozen=True, eq=False)
class SimulatedCamera:
    """Where one looks from, and the picture's size.

    Attributes:
        eye_mm: Shape (3,), world frame.
        look_at_mm: Shape (3,), the middle of the picture.
        up: Shape (3,), what is up in the picture, world frame.
        width: Pixels.
        height: Pixels.
    """

    eye_mm: NDArray[np.float64]
    look_at_mm: NDArray[np.float64]
    up: NDArray[np.float64]
    width: int = 960
    height: int = 540


def picture(client: int, camera: SimulatedCamera) -> NDArray[np.uint8]:
    """The room as it stands, shape (height, width, 3), RGB."""
    view = pybullet.computeViewMatrix(
        to_m(camera.eye_mm).tolist(), to_m(camera.look_at_mm).tolist(), camera.up.tolist()
    )
    projection = pybullet.computeProjectionMatrixFOV(FIELD_OF_VIEW_DEG, camera.width / camera.height, NEAR_M, FAR_M)
    away = camera.eye_mm - camera.look_at_mm
    light = away / np.linalg.norm(away) + LIGHT_UP * camera.up / np.linalg.norm(camera.up)
    return _drawn(client, (camera.width, camera.height), view, projection, light)


def pinhole_picture(
    client: int, size: tuple[int, int], K: NDArray[np.float64], T_camera_world: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """The room as a calibrated camera sees it, without its lens's distortion, shape (height, width, 3), RGB.

    For looking at, not for measuring: the renderer samples pixel corners and has no anti-aliasing.

    Args:
        client: Physics client id.
        size: Width and height, px.
        K: Intrinsic matrix, shape (3, 3), px; pixel centres at integers.
        T_camera_world: Shape (4, 4), mm; the camera's x right, y down, z forward.
    """
    width, height = size
    left, right = -(K[0, 2] + 0.5) / K[0, 0], (width - 0.5 - K[0, 2]) / K[0, 0]
    bottom, top = -(height - 0.5 - K[1, 2]) / K[1, 1], (K[1, 2] + 0.5) / K[1, 1]
    edges = [float(edge) * NEAR_M for edge in (left, right, bottom, top)]
    projection = pybullet.computeProjectionMatrix(*edges, NEAR_M, FAR_M)
    view = np.diag([1.0, -1.0, -1.0, 1.0]) @ T_camera_world
    view[:3, 3] = to_m(view[:3, 3])
    light = -T_camera_world[2, :3] + LIGHT_UP * -T_camera_world[1, :3]
    return _drawn(client, size, view.T.ravel().tolist(), projection, light)


def _drawn(
    client: int, size: tuple[int, int], view: list[float], projection: list[float], light: NDArray[np.float64]
) -> NDArray[np.uint8]:
    """A picture by PyBullet's software renderer; the lamp shines from a direction (3,)."""
    width, height = size
    image = pybullet.getCameraImage(
        width,
        height,
        view,
        projection,
        lightDirection=light.tolist(),
        shadow=1,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    rgba = np.asarray(image[2], dtype=np.uint8).reshape(height, width, 4)
    return np.ascontiguousarray(rgba[..., :3])
