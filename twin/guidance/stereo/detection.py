"""Detections of the stereo guidance: a ball's centre in each camera.

``image_detector`` takes an image and measures it with the believed camera. Another `Detector` may leave the image out:
for studies of everything behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.devices import Cameras
from puncture_twin.twin.guidance.stereo.ball.tracker import LostBall, find_ball
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.cameras.triangulation import Points, triangulate
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_loop import Lost


class Detection(NamedTuple):
    """A ball's centre in one image."""

    pixel: Floats
    """Shape (2,)."""
    covariance: Floats
    """Shape (2, 2), px^2."""


class Search(NamedTuple):
    """Search region of a ball."""

    camera: Camera
    """As it is believed."""
    predicted_c: Floats
    """Shape (3,), mm."""
    radius_mm: float
    """Of the ball."""
    search_px: float


Detector = Callable[[int, Search], Detection | Lost]
"""Takes the camera's number and the search region."""


class Detections(NamedTuple):
    """One ball in every camera."""

    pixels: Floats
    """Shape (c, 2)."""
    covariances: Floats
    """Shape (c, 2, 2), px^2."""


def image_detector(cameras: Cameras, *, hough_only: bool = False) -> Detector:
    """A new image, and the ball measured in it with the believed camera.

    Args:
        cameras: The devices.
        hough_only: The paper's method; see `find_ball`.
    """

    def see(number: int, search: Search) -> Detection | Lost:
        camera, predicted, radius_mm, reach_px = search
        image = cameras.measured_image(number, camera.project(predicted), reach_px)
        found = find_ball(image, camera, predicted, radius_mm, search_px=reach_px, hough_only=hough_only)
        return Lost(found.reason) if isinstance(found, LostBall) else Detection(found.pixel, found.covariance)

    return see


def look_at(detector: Detector, searches: tuple[Search, ...], frames: int = 1) -> Detections | Lost:
    """Detect one ball in every camera, several images each; all must show it.

    Pictures of one camera are averaged by their inverse covariances.
    """
    pixels, covariances = [], []
    for number, search in enumerate(searches):
        detections = []
        for _ in range(frames):
            spot = detector(number, search)
            if isinstance(spot, Lost):
                return Lost(f"camera {number + 1}: {spot.reason}")
            detections.append(spot)
        weights = np.linalg.inv([spot.covariance for spot in detections])
        covariance = np.linalg.inv(weights.sum(axis=0))
        pixels.append(covariance @ np.einsum("fij,fj->i", weights, [spot.pixel for spot in detections]))
        covariances.append(covariance)
    return Detections(np.array(pixels), np.array(covariances))


def searches_of(case: ServoCase, cameras: tuple[Camera, ...], predicted_c: Floats) -> tuple[Search, ...]:
    """Where the tool's ball is looked for in each camera, predicted at (3,), mm."""
    radius_mm, reach_px = case.file.tool.ball_diameter_mm / 2, case.file.servo.search_px
    return tuple(Search(camera, predicted_c, radius_mm, reach_px) for camera in cameras)


def in_space(cameras: tuple[Camera, ...], detections: Detections) -> Points:
    """Position of one ball in C from its pixels."""
    return triangulate(cameras, detections.pixels[:, None], detections.covariances[:, None])
