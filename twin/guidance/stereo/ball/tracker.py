"""The ball found in an image near where the robot's kinematics predict it, and its centre measured.

Hough's transform finds circles; edges on spokes measure them; three edges propose a circle, the others vote, and a
robust fit refines it. What is measured is the projection of the ball's **centre**, as the circle is fitted on the
sphere of viewing directions. A ball that is absent, mostly hidden or too faint is a ``LostBall``, not a number.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.devices import GreyImage
from puncture_twin.twin.guidance.stereo.ball.ball_edges import (
    Circle,
    Edges,
    Grey,
    Spokes,
    cone,
    consensus,
    find_edges,
    grey_part,
    refit,
    visible_fraction,
)
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, tangent_axes

Reason = Literal["not_in_view", "no_circle", "few_inliers", "wrong_radius", "low_contrast"]

MARGIN_PX = 8.0
"""Beyond search region and ball: what edges and their smoothing need."""
HOUGH_SIGMA_PX = 0.4
"""Deviation of a centre by Hough alone, per axis (measured: benchmarks/detectors.py)."""
CLOSER = 2
"""Times that the edges are read again around the measured circle: the second moves it by less than 0.001 px."""
KEPT_AWAY = 2
"""Spokes between a used edge and one off the circle: 10 degrees, 1.7 px at a radius of 10 px."""


SPOKES = 72
"""Edges wanted, evenly around the outline."""
FIRST_REACH_PX, LAST_REACH_PX = 4.0, 2.5
"""How far from Hough's circle, and from the measured one, an edge may lie."""
INLIER_PX = 0.35
"""An edge this near votes for a circle."""
MIN_INLIERS, MIN_VISIBLE = 0.5, 0.5
"""Fraction of all spokes that must agree, and of the disc that must look like the ball."""
RADIUS_FRACTION = 0.05
"""How far the radius may be from the predicted one."""
MIN_CONTRAST, NOISE_FACTOR = 12.0, 5.0
"""Least contrast of an edge: grey levels, and parts of the image's own noise; the larger counts."""
MODEL_PX = 0.014
"""Standard deviation, per axis, of what light, blur and rod do to the centre and the edges do not show."""


class DetectedBall(NamedTuple):
    """A detected ball."""

    pixel: Floats
    """Shape (2,): the projection of the ball's centre, px."""
    covariance: Floats
    """Shape (2, 2), px^2."""
    inliers: int
    """Of `SPOKES` edges, those on the circle; 0 for Hough alone."""


class LostBall(NamedTuple):
    """A failed search for the ball, with its reason."""

    reason: Reason
    inliers: int = 0
    """Edges on the best circle."""


def find_ball(
    image: GreyImage | NDArray[np.uint8],
    camera: Camera,
    predicted_c: Floats,
    radius_mm: float,
    *,
    search_px: float,
    hough_only: bool = False,
) -> DetectedBall | LostBall:
    """Find and measure the ball.

    Args:
        image: A whole image, shape (height, width), or a part of one with its offset.
        camera: As calibrated.
        predicted_c: Shape (3,), mm: the ball's centre by the robot's kinematics. Its depth predicts the radius.
        radius_mm: The ball's.
        search_px: How far from the prediction the centre may be.
        hough_only: The paper's method: the centre of the best circle that Hough finds, neither measured nor gated.
    """
    whole = image if isinstance(image, GreyImage) else GreyImage(image)
    predicted = camera.project(predicted_c)
    if not camera.sees(predicted):
        return LostBall("not_in_view")
    radius = camera.ball_radius_px(predicted_c, radius_mm)
    part = _cut(whole, predicted, search_px + 2 * radius + MARGIN_PX)
    if min(part.grey.shape) < 2 * radius:
        return LostBall("not_in_view")
    grey = grey_part(part.grey, np.array(part.offset, dtype=np.float64))
    if _contrast(part.grey) < _threshold(grey):
        return LostBall("low_contrast")
    found = find_circles(part.grey, radius)
    centers = found.centers + part.offset
    near = np.linalg.norm(centers - predicted, axis=1) <= search_px
    if not near.any():
        return LostBall("no_circle")
    if hough_only:
        best = int(np.flatnonzero(near)[0])
        return DetectedBall(centers[best], HOUGH_SIGMA_PX**2 * np.eye(2), 0)
    return _best(grey, camera, FoundCircle(centers[near], found.radii[near]), radius)


def _cut(whole: GreyImage, center: Floats, half: float) -> GreyImage:
    """The part of an image around a pixel, as far as there is one."""
    size = np.array(whole.grey.shape[::-1])
    low = np.clip(np.floor(center - half).astype(int) - whole.offset, 0, size)
    high = np.clip(np.ceil(center + half).astype(int) + 1 - whole.offset, 0, size)
    part = np.ascontiguousarray(whole.grey[low[1] : high[1], low[0] : high[0]])
    return GreyImage(part, (int(low[0]) + whole.offset[0], int(low[1]) + whole.offset[1]))


def _contrast(grey: NDArray[np.uint8]) -> float:
    return float(np.percentile(grey, 99.5) - np.percentile(grey, 0.5))


def _threshold(grey: Grey) -> float:
    return max(MIN_CONTRAST, NOISE_FACTOR * grey.noise)


def _best(grey: Grey, camera: Camera, found: FoundCircle, radius: float) -> DetectedBall | LostBall:
    """The first circle that passes the test, or the reason of the one with most inliers."""
    lost = []
    for center in found.centers:
        ball = _measure(grey, camera, center, radius)
        if isinstance(ball, DetectedBall):
            return ball
        lost.append(ball)
    return max(lost, key=lambda one: one.inliers)


def _measure(grey: Grey, camera: Camera, center: Floats, radius: float) -> DetectedBall | LostBall:
    """Measure one circle: edges about Hough's place, the vote, then edges about the measured place until they agree."""
    direction = camera.rays(center)
    spokes = Spokes(direction, radius / camera.local_scale(direction), SPOKES, FIRST_REACH_PX)
    fitted = _fit(grey, camera, spokes, radius)
    for _ in range(CLOSER):
        if isinstance(fitted, LostBall):
            return fitted
        fitted = _fit(grey, camera, fitted.spokes._replace(reach_px=LAST_REACH_PX), radius)
    if isinstance(fitted, LostBall):
        return fitted
    if visible_fraction(grey, camera, fitted.spokes, fitted.on_circle, fitted.contrast) < MIN_VISIBLE:
        return LostBall("few_inliers", fitted.inliers)
    direction = fitted.spokes.direction
    size = fitted.spokes.half_angle * camera.local_scale(direction)
    slope = camera.angle_slope(direction)
    noise = fitted.covariance[:2, :2] / _independent(SPOKES, size)
    covariance = slope @ noise @ slope.T + MODEL_PX**2 * np.eye(2)
    return DetectedBall(camera.project(camera.center_c + direction), covariance, fitted.inliers)


class _Fitted(NamedTuple):
    """A circle through the edges on spokes."""

    spokes: Spokes
    """Around what was measured."""
    covariance: Floats
    """Shape (3, 3), rad^2."""
    on_circle: NDArray[np.bool_]
    """Shape (n,): whose edge lies on the circle."""
    contrast: float

    @property
    def inliers(self) -> int:
        return int(self.on_circle.sum())


def _fit(grey: Grey, camera: Camera, spokes: Spokes, radius: float) -> _Fitted | LostBall:
    edges = find_edges(grey, camera, spokes)
    valid, faint = _believable(edges, _threshold(grey))
    if faint:
        return LostBall("low_contrast", int(valid.sum()))
    circle = consensus(edges.points, valid, edges.scales, INLIER_PX)
    if circle is None:
        return LostBall("few_inliers")
    on_circle = _agree(edges, valid, circle, INLIER_PX)
    if on_circle.sum() < MIN_INLIERS * SPOKES:
        return LostBall("few_inliers", int(on_circle.sum()))
    used = _away_from_others(on_circle)
    fit = refit(edges.points[used], edges.scales[used], circle, INLIER_PX)
    on_circle = _agree(edges, valid, fit.circle, INLIER_PX)
    if on_circle.sum() < MIN_INLIERS * SPOKES:
        return LostBall("few_inliers", int(on_circle.sum()))
    axis, half_angle = cone(fit.circle, spokes.direction, tangent_axes(spokes.direction))
    if abs(half_angle * camera.local_scale(axis) - radius) > RADIUS_FRACTION * radius:
        return LostBall("wrong_radius", int(on_circle.sum()))
    measured = spokes._replace(direction=axis, half_angle=half_angle)
    return _Fitted(measured, fit.covariance, on_circle, float(np.median(edges.contrast[on_circle])))


def _away_from_others(on_circle: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Spokes whose neighbours agree too: next to the rod or an occluder the edge is bent by it.

    Where that would leave fewer than half of them, all stay.
    """
    used = on_circle.copy()
    for shift in range(-KEPT_AWAY, KEPT_AWAY + 1):
        used &= np.roll(on_circle, shift)
    return used if used.sum() >= on_circle.sum() / 2 else on_circle


def _believable(edges: Edges, threshold: float) -> tuple[NDArray[np.bool_], bool]:
    """Edges that are steep enough and of the usual sign, and whether most are too faint."""
    steep = edges.inside & (np.abs(edges.contrast) >= threshold)
    majority = np.sign(np.sum(np.sign(edges.contrast[steep]))) or 1.0
    return steep & (edges.contrast * majority > 0), bool(np.mean(np.abs(edges.contrast) < threshold) > 0.5)


def _agree(edges: Edges, valid: NDArray[np.bool_], circle: Circle, tolerance_px: float) -> NDArray[np.bool_]:
    distance = np.linalg.norm(edges.points - circle.center, axis=1)
    return np.asarray(valid & (np.abs(distance - circle.radius) * edges.scales <= tolerance_px))


def _independent(spokes: int, radius_px: float) -> float:
    """Fraction of the edges that count: those closer than 1.5 px read the same pixels."""
    return min(1.0, 2 * np.pi * radius_px / (1.5 * spokes))


RADIUS_RANGE = (0.7, 1.4)
"""Radii that are looked for, in parts of the predicted one: wider than the gate, so that the gate can say no."""
VOTES = 8
"""Edge pixels that must agree on a centre: few, since every circle is measured afterwards."""
EDGE_FRACTION = 0.5
"""Canny's upper threshold in parts of the strongest slope in the image."""
SOBEL_GAIN = 4.0
"""Height of Sobel's answer to a step of one grey level."""
MOST = 8
"""Circles that are handed on."""


class FoundCircle(NamedTuple):
    """Circles, best first."""

    centers: Floats
    """Shape (n, 2), px, in the image given."""
    radii: Floats
    """Shape (n,), px."""


def find_circles(grey: NDArray[np.uint8], radius_px: float) -> FoundCircle:
    """Circles of about a radius, by the gradient method of OpenCV (Yuen et al. 1990).

    Args:
        grey: Shape (h, w).
        radius_px: As predicted.
    """
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0)
    contrast = float(np.percentile(smooth, 99.5) - np.percentile(smooth, 0.5))
    threshold = max(EDGE_FRACTION * SOBEL_GAIN * contrast / 2, 4.0)
    circles = cv2.HoughCircles(
        smooth,
        cv2.HOUGH_GRADIENT,
        dp=1.0,
        minDist=max(radius_px / 3, 1.0),
        param1=threshold,
        param2=VOTES,
        minRadius=int(np.floor(RADIUS_RANGE[0] * radius_px)),
        maxRadius=int(np.ceil(RADIUS_RANGE[1] * radius_px)),
    )
    if circles is None:
        return FoundCircle(np.zeros((0, 2)), np.zeros(0))
    rows = np.asarray(circles, dtype=np.float64).reshape(-1, np.shape(circles)[-1])[:MOST]
    return FoundCircle(rows[:, :2], rows[:, 2])
