"""Detections of the stereo guidance: a ball's centre in each camera, from images of the true workcell.

``image_detector`` renders an image with the true camera and measures it with the believed one. Another `Detector` may
leave the image out: for studies of everything behind it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.stereo.ball.ball_image import BallScene, render
from puncture_twin.twin.guidance.stereo.ball.tracker import LostBall, find_ball
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.cameras.triangulation import Points, triangulate
from puncture_twin.twin.guidance.stereo.servo_case import CamerasSection
from puncture_twin.twin.guidance.stereo.servo_loop import Lost
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell

DIFFUSE = {"diffuse": 0.8, "lamp": 0.4}
"""Fraction of diffuse light; the rest is from one direction."""

WINDOW_MARGIN_PX = 24
"""An image, and the rod in it, are drawn this far beyond the region that is searched: the rest is never looked at."""


class LocatedPair(NamedTuple):
    """The true ball, C, mm."""

    center_c: Floats
    """Shape (3,)."""
    radius_mm: float
    rod_c: Floats | None
    """Shape (3,): along the rod; None for a marker, which has none."""
    head_there: bool = True
    """Whether the head is in the workcell and may hide the ball; it is not during the calibration."""


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
    search_px: float


Detector = Callable[[int, LocatedPair, Search], Detection | Lost]
"""Takes the camera's number, the true ball, and the search region."""


class Detections(NamedTuple):
    """One ball in every camera."""

    pixels: Floats
    """Shape (c, 2)."""
    covariances: Floats
    """Shape (c, 2, 2), px^2."""


def image_detector(workcell: StereoWorkcell, rng: np.random.Generator) -> Detector:
    """Pictures of the true workcell, each drawn anew with noise; what the head hides is hidden."""
    plan = workcell.case.file.cameras

    def see(number: int, ball: LocatedPair, search: Search) -> Detection | Lost:
        true = workcell.cameras[number]
        hidden = workcell.hidden_fraction(true, ball.center_c, ball.radius_mm) if ball.head_there else 0.0
        away = np.abs(true.project(ball.center_c) - search.camera.project(search.predicted_c)).max()
        radius = true.ball_radius_px(ball.center_c, ball.radius_mm)
        half = int(np.ceil(np.nan_to_num(away, nan=0.0) + search.search_px + 2 * radius)) + WINDOW_MARGIN_PX
        scene = replace(ball_scene(plan, ball, hidden, rng), rod_length_mm=half * ball.radius_mm / radius)
        image = render(true, scene, rng=rng, noise=plan.noise_grey, blur_px=plan.blur_px, half_px=half)
        found = find_ball(
            image,
            search.camera,
            search.predicted_c,
            ball.radius_mm,
            search_px=search.search_px,
            hough_only=plan.centre == "hough",
        )
        return Lost(found.reason) if isinstance(found, LostBall) else Detection(found.pixel, found.covariance)

    return see


def ball_scene(plan: CamerasSection, ball: LocatedPair, hidden: float, rng: np.random.Generator) -> BallScene:
    """The scene of a ball; an occluder that the case demands comes from any side."""
    fraction = min(max(plan.occlusion if ball.rod_c is not None else 0.0, hidden), 0.99)
    return BallScene(
        ball.center_c,
        radius_mm=ball.radius_mm,
        rod_c=(0.0, -1.0, 0.0) if ball.rod_c is None else ball.rod_c,
        rod=ball.rod_c is not None,
        diffuse=DIFFUSE[plan.light],
        hidden_fraction=fraction,
        hidden_from=float(rng.uniform(-np.pi, np.pi)),
    )


def look_at(detector: Detector, ball: LocatedPair, searches: tuple[Search, ...], frames: int = 1) -> Detections | Lost:
    """Detect one ball in every camera, several images each; all must show it.

    Pictures of one camera are averaged by their inverse covariances.
    """
    pixels, covariances = [], []
    for number, search in enumerate(searches):
        detections = []
        for _ in range(frames):
            spot = detector(number, ball, search)
            if isinstance(spot, Lost):
                return Lost(f"camera {number + 1}: {spot.reason}")
            detections.append(spot)
        weights = np.linalg.inv([spot.covariance for spot in detections])
        covariance = np.linalg.inv(weights.sum(axis=0))
        pixels.append(covariance @ np.einsum("fij,fj->i", weights, [spot.pixel for spot in detections]))
        covariances.append(covariance)
    return Detections(np.array(pixels), np.array(covariances))


def in_space(cameras: tuple[Camera, ...], detections: Detections) -> Points:
    """Position of one ball in C from its pixels."""
    return triangulate(cameras, detections.pixels[:, None], detections.covariances[:, None])
