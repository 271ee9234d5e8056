"""Pictures of the room, drawn without a screen or a graphics card."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.world.engine import pybullet
from twin.world.units import to_m

FIELD_OF_VIEW_DEG = 45.0
NEAR_M = 0.05
FAR_M = 10.0

LAMP_UP = 1.5
"""The lamp hangs above the camera: its direction is the camera's plus this much of up."""


@dataclass(frozen=True, eq=False)
class Camera:
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


def picture(client: int, camera: Camera) -> NDArray[np.uint8]:
    """The room as it stands, shape (height, width, 3), RGB."""
    view = pybullet.computeViewMatrix(
        to_m(camera.eye_mm).tolist(), to_m(camera.look_at_mm).tolist(), camera.up.tolist()
    )
    projection = pybullet.computeProjectionMatrixFOV(FIELD_OF_VIEW_DEG, camera.width / camera.height, NEAR_M, FAR_M)
    away = camera.eye_mm - camera.look_at_mm
    lamp = away / np.linalg.norm(away) + LAMP_UP * camera.up / np.linalg.norm(camera.up)
    image = pybullet.getCameraImage(
        camera.width,
        camera.height,
        view,
        projection,
        lightDirection=lamp.tolist(),
        shadow=1,
        renderer=pybullet.ER_TINY_RENDERER,
        physicsClientId=client,
    )
    rgba = np.asarray(image[2], dtype=np.uint8).reshape(camera.height, camera.width, 4)
    return np.ascontiguousarray(rgba[..., :3])
