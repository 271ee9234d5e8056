"""The ball on the tool, found in an image near where the robot's kinematics predict it, and its centre measured.

Hough's transform finds circles; edges on spokes measure them; three edges propose a circle, the others vote, and a
robust fit refines it. A ball that is absent, mostly hidden or too faint is a ``Lost``, not a number.

A spoke runs over the sphere of viewing directions, from inside the outline to outside, and is projected into the image
by the camera: so lens and ellipse are in the spoke, and the outline is at the same angle on each. The grey along it is
read with cubic splines. The edge is where the grey changes fastest after a Gaussian's derivative (Canny 1986), the peak
refined by a parabola.

A ball fills a cone of rays around the direction of its centre, a circle on that sphere whatever the lens. So the circle
is fitted there and not in the image: its centre is the projection of the ball's **centre** itself, while the outline's
ellipse has its centre elsewhere. Points near a direction d0 are given by polar coordinates (angle from d0, direction
around it) or, for circles, by the stereographic plane touching at d0, which takes circles to circles (Snyder 1987, Map
Projections, chapter 21).

``image_detector`` takes an image and measures it with the believed camera. Another `Detector` may leave the image out:
for studies of everything behind it.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates, spline_filter

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.twin.devices import Cameras, GreyImage
from puncture_twin.twin.guidance.stereo.camera import Camera, tangent_axes
from puncture_twin.twin.guidance.stereo.camera_calibration import Points, triangulate
from puncture_twin.twin.guidance.stereo.servo_law import Lost

STEP_PX = 0.25
"""Between two readings on a spoke: a quarter of the narrowest edge."""
SMOOTHING_PX = 0.8
"""Width of the derivative: as wide as the edge itself is the best against noise; wider sees the ball's shading."""
EDGE_WIDTH_PX = 0.8
"""Blur and pixel together; turns the steepest slope into the step's height."""
SAME_GREY = 0.4
"""In parts of the contrast: a light of fraction 0.4 shades the ball by less, what hides it differs by more."""
DISC_RINGS = 0.85 * np.sqrt((np.arange(6) + 0.5) / 6)
"""Radii at which the disc is sampled, as fractions of the outline's: all rings have the same area."""


class Grey(NamedTuple):
    """A part of an image, ready to be read between its pixels; ``offset``: column and row of the first one."""

    pixels: NDArray[np.uint8]
    spline: Floats
    offset: Floats
    noise: float


class Edges(NamedTuple):
    """One edge per spoke."""

    points: Floats  # shape (n, 2), in the stereographic plane that touches at the spokes' centre
    scales: Floats  # shape (n,), px per radian across the outline
    contrast: Floats  # shape (n,), inside minus outside
    inside: Bools  # shape (n,); not where the steepest place is at the end of the spoke or outside the image: no edge


class Spokes(NamedTuple):
    """Spokes all around a unit direction (3,), about the outline's half angle, rad, as far to both sides as a reach."""

    direction: Floats
    half_angle: float
    number: int
    reach_px: float


def find_edges(grey: Grey, camera: Camera, spokes: Spokes) -> Edges:
    """The steepest place on each spoke."""
    across = _across(spokes)
    normals = np.linalg.solve(camera.angle_slope(spokes.direction).T, across)
    scales = np.asarray(1 / np.linalg.norm(normals, axis=0))  # px per radian of a tangent circle's growth: 1 / |J^-T e|
    half = min(spokes.reach_px, 0.8 * spokes.half_angle * float(scales.min()))
    steps = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    places, read = _read(grey, camera, _rays(spokes, spokes.half_angle + steps[:, None] / scales))
    seen = np.all((places >= 0) & (places <= np.array(grey.pixels.shape[::-1]) - 1), axis=-1)
    slope = gaussian_filter1d(read, SMOOTHING_PX / STEP_PX, axis=0, order=1, mode="nearest") / STEP_PX
    every, best = np.arange(spokes.number), np.argmax(np.abs(slope), axis=0)
    middle = np.clip(best, 1, len(slope) - 2)
    before, centre, after = (np.abs(slope[middle + side, every]) for side in (-1, 0, 1))
    bend = before - 2 * centre + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)  # a parabola's peak
    edge = spokes.half_angle + ((middle + np.clip(shift, -1, 1)) * STEP_PX - half) / scales
    contrast = -slope[middle, every] * np.hypot(SMOOTHING_PX, EDGE_WIDTH_PX) * np.sqrt(2 * np.pi)
    points = 2 * np.tan(edge / 2)[:, None] * across.T  # stereographic
    return Edges(points, scales, contrast, (best == middle) & seen.all(axis=0))


def visible_fraction(grey: Grey, camera: Camera, spokes: Spokes, on_circle: Bools, contrast: float) -> float:
    """Fraction of the disc that looks like the ball: as bright as next to its edges, within a part of its contrast.

    Spokes are about the measured ball; ``on_circle`` (n,): those whose edge lies on the circle; contrast in greys.
    """
    _, read = _read(grey, camera, _rays(spokes, (spokes.half_angle * DISC_RINGS)[:, None]))
    ball = float(np.median(read[-1][on_circle]))
    return float(np.mean(np.abs(read - ball) < SAME_GREY * abs(contrast)))


def _across(spokes: Spokes) -> Floats:
    around = 2 * np.pi * np.arange(spokes.number) / spokes.number
    return np.stack([np.cos(around), np.sin(around)])


def _rays(spokes: Spokes, angles: Floats) -> Floats:
    """Viewing directions (m, n, 3) at angles (m, n) or (m, 1), rad, from the spokes' middle, along each spoke."""
    rotated = (tangent_axes(spokes.direction) @ _across(spokes)).T
    return np.asarray(np.cos(angles)[..., None] * spokes.direction + np.sin(angles)[..., None] * rotated)


def _read(grey: Grey, camera: Camera, rays: Floats) -> tuple[Floats, Floats]:
    """Places (..., 2) in the part of the image where directions show, and the grey there."""
    places = camera.project(camera.center_c + rays) - grey.offset
    at = [places[..., 1], places[..., 0]]
    return places, map_coordinates(grey.spline, at, order=3, prefilter=False, mode="nearest")


STEPS = (1 / 8, 1 / 6, 1 / 4, 1 / 3)
"""Spacing of the three points, in turns: short arcs survive occlusion, long ones fix the circle well."""
REFIT_ROUNDS = 8
"""Reweighted Gauss-Newton rounds; the step is below 1e-6 px after four."""
TUKEY = 4.685
"""Tuning constant of Tukey's biweight: 95 % efficient for normal errors (Huber 1981)."""


class Circle(NamedTuple):
    """A circle in the stereographic plane, in radians of view near its origin."""

    center: Floats  # shape (2,)
    radius: float


class Refit(NamedTuple):
    """A robust least-squares circle."""

    circle: Circle
    covariance: Floats  # shape (3, 3), rad^2, of centre and radius, for independent edges of the spread found


def consensus(points: Floats, valid: Bools, scales: Floats, tolerance_px: float) -> Circle | None:
    """The circle through three edges that most edges lie on (RANSAC, Fischler and Bolles 1981).

    Edges (n, 2) lie in the stereographic plane, in order around the ball, evenly spread; ``valid`` (n,): which are
    edges at all; scales (n,), px per radian across the outline. The triples are not drawn: every edge with its
    neighbours at four spacings, so the answer is the same every time.
    """
    count = len(points)
    first = np.arange(count)
    triples = np.concatenate([np.stack([first + k * round(s * count) for k in range(3)], 1) for s in STEPS]) % count
    triples = triples[valid[triples].all(axis=1)]
    if len(triples) == 0:
        return None
    centers, radii = _through(points[triples])
    distances = np.linalg.norm(points[None] - centers[:, None], axis=-1)
    misses = np.where(valid & np.isfinite(radii)[:, None], np.abs(distances - radii[:, None]) * scales, np.inf)
    score = np.sum(1 - np.clip(misses / tolerance_px, 0, 1) ** 2, axis=1)  # MSAC: near edges count more
    best = int(np.argmax(score))
    return Circle(centers[best], float(radii[best])) if np.isfinite(radii[best]) else None


def _through(triples: Floats) -> tuple[Floats, Floats]:
    """Circles through three points each: centers (m, 2), radii (m,); not finite for points on a line."""
    origin = triples[:, 0]
    sides = triples[:, 1:] - origin[:, None]
    squares = np.sum(sides**2, axis=-1) / 2
    determinant = sides[:, 0, 0] * sides[:, 1, 1] - sides[:, 0, 1] * sides[:, 1, 0]
    with np.errstate(divide="ignore", invalid="ignore"):
        x = (squares[:, 0] * sides[:, 1, 1] - squares[:, 1] * sides[:, 0, 1]) / determinant
        y = (squares[:, 1] * sides[:, 0, 0] - squares[:, 0] * sides[:, 1, 0]) / determinant
    offset = np.stack([x, y], axis=1)
    return origin + offset, np.linalg.norm(offset, axis=1)


def refit(points: Floats, scales: Floats, start: Circle, tolerance_px: float) -> Refit:
    """Least squares of the edges' distances with Tukey's weights, from a start near the answer (`consensus`).

    Edges (n, 2) lie in the stereographic plane; scales (n,), px per radian across the outline. The spread is not
    believed to be larger than the tolerance.
    """
    center, radius = np.array(start.center), start.radius
    spread, floor = tolerance_px, 1e-3
    for _ in range(REFIT_ROUNDS):
        outward = points - center
        distance = np.linalg.norm(outward, axis=1)
        miss = (distance - radius) * scales
        ratio = np.clip(np.abs(miss) / (TUKEY * spread), 0, 1)
        root_weight = 1 - ratio**2  # Tukey's weight is its square
        J = np.column_stack([outward / distance[:, None], np.ones(len(points))]) * scales[:, None]
        step = np.linalg.lstsq(J * root_weight[:, None], miss * root_weight, rcond=None)[0]
        center, radius = center + step[:2], radius + step[2]
        near = np.abs(miss) < 3 * tolerance_px
        spread = float(np.clip(1.4826 * np.median(np.abs(miss[near])) if near.any() else floor, floor, tolerance_px))
    weighted = J * root_weight[:, None]
    return Refit(Circle(center, float(radius)), spread**2 * np.linalg.pinv(weighted.T @ weighted))


def cone(circle: Circle, direction: Floats, axes: Floats) -> tuple[Floats, float]:
    """Axis (3,) and half angle (rad) of the cone of a circle in the plane with these axes (3, 2), at ``direction``."""
    away = float(np.linalg.norm(circle.center))
    near, far = (2 * np.arctan((away + side * circle.radius) / 2) for side in (-1, 1))
    across = circle.center / away if away > 0 else np.zeros(2)
    tilt = (near + far) / 2
    return np.cos(tilt) * direction + np.sin(tilt) * (axes @ across), float((far - near) / 2)


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


class Detection(NamedTuple):
    """A detected ball: the projection of its centre, px, and the edges of `SPOKES` on it, 0 for Hough alone."""

    pixel: Floats  # shape (2,): the projection of the ball's centre, px
    covariance: Floats  # shape (2, 2), px^2
    inliers: int = 0


def find_ball(
    image: GreyImage, camera: Camera, predicted_c: Floats, radius_mm: float, search_px: float, hough_only: bool = False
) -> Detection | Lost:
    """Find and measure the ball, no farther than ``search_px`` from where kinematics predict its centre, (3,), mm.

    Its depth predicts the radius. ``hough_only`` is the paper's method: the centre of the best circle that Hough finds,
    neither measured nor gated.
    """
    predicted = camera.project(predicted_c)
    if not camera.sees(predicted):
        return Lost("not_in_view")
    radius = camera.ball_radius_px(predicted_c, radius_mm)
    part = _cut(image, predicted, search_px + 2 * radius + MARGIN_PX)
    if min(part.grey.shape) < 2 * radius:
        return Lost("not_in_view")
    values = part.grey.astype(np.float64)
    second = values[:, :-2] - 2 * values[:, 1:-1] + values[:, 2:]  # which edges hardly touch
    noise = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6.0) if second.size else 0.0  # 1 + 4 + 1
    grey = Grey(part.grey, np.asarray(spline_filter(values, 3)), np.array(part.offset, dtype=np.float64), noise)
    if _contrast(part.grey) < _threshold(grey):
        return Lost("low_contrast")
    centers = find_circles(part.grey, radius) + part.offset
    near = np.linalg.norm(centers - predicted, axis=1) <= search_px
    if not near.any():
        return Lost("no_circle")
    if hough_only:
        return Detection(centers[near][0], HOUGH_SIGMA_PX**2 * np.eye(2))
    lost = []
    for center in centers[near]:
        ball = _measure(grey, camera, center, radius)
        if isinstance(ball, Detection):
            return ball
        lost.append(ball)
    return max(lost, key=lambda one: one.inliers)


def _cut(whole: GreyImage, center: Floats, half: float) -> GreyImage:
    size = np.array(whole.grey.shape[::-1])
    low = np.clip(np.floor(center - half).astype(int) - whole.offset, 0, size)
    high = np.clip(np.ceil(center + half).astype(int) + 1 - whole.offset, 0, size)
    part = np.ascontiguousarray(whole.grey[low[1] : high[1], low[0] : high[0]])
    return GreyImage(part, (int(low[0]) + whole.offset[0], int(low[1]) + whole.offset[1]))


def _contrast(grey: NDArray[Any]) -> float:
    return float(np.percentile(grey, 99.5) - np.percentile(grey, 0.5))


def _threshold(grey: Grey) -> float:
    return max(MIN_CONTRAST, NOISE_FACTOR * grey.noise)


def _measure(grey: Grey, camera: Camera, center: Floats, radius: float) -> Detection | Lost:
    """Measure one circle: edges about Hough's place, the vote, then edges about the measured place until they agree."""
    direction = camera.rays(center)
    spokes = Spokes(direction, radius / camera.local_scale(direction), SPOKES, FIRST_REACH_PX)
    fitted = _fit(grey, camera, spokes, radius)
    for _ in range(CLOSER):
        if not isinstance(fitted, Lost):
            fitted = _fit(grey, camera, fitted.spokes._replace(reach_px=LAST_REACH_PX), radius)
    if isinstance(fitted, Lost):
        return fitted
    inliers, spokes = int(fitted.on_circle.sum()), fitted.spokes
    if visible_fraction(grey, camera, spokes, fitted.on_circle, fitted.contrast) < MIN_VISIBLE:
        return Lost("few_inliers", inliers)
    slope, radius_px = camera.angle_slope(spokes.direction), spokes.half_angle * camera.local_scale(spokes.direction)
    independent = min(1.0, 2 * np.pi * radius_px / (1.5 * SPOKES))  # edges closer than 1.5 px read the same pixels
    covariance = slope @ (fitted.covariance[:2, :2] / independent) @ slope.T + MODEL_PX**2 * np.eye(2)
    return Detection(camera.project(camera.center_c + spokes.direction), covariance, inliers)


class _Fitted(NamedTuple):
    """A circle through the edges on spokes, which are set about it; covariance (3, 3), rad^2; spokes on it (n,)."""

    spokes: Spokes
    covariance: Floats
    on_circle: Bools  # shape (n,): whose edge lies on the circle
    contrast: float


def _fit(grey: Grey, camera: Camera, spokes: Spokes, radius: float) -> _Fitted | Lost:
    edges, least = find_edges(grey, camera, spokes), _threshold(grey)
    steep = edges.inside & (np.abs(edges.contrast) >= least)
    majority = np.sign(np.sum(np.sign(edges.contrast[steep]))) or 1.0
    valid = steep & (edges.contrast * majority > 0)  # of the usual sign
    if np.mean(np.abs(edges.contrast) < least) > 0.5:
        return Lost("low_contrast", int(valid.sum()))
    circle = consensus(edges.points, valid, edges.scales, INLIER_PX)
    if circle is None:
        return Lost("few_inliers")
    on_circle = _agree(edges, valid, circle)
    if on_circle.sum() < MIN_INLIERS * SPOKES:
        return Lost("few_inliers", int(on_circle.sum()))
    used = _away_from_others(on_circle)
    fit = refit(edges.points[used], edges.scales[used], circle, INLIER_PX)
    on_circle = _agree(edges, valid, fit.circle)
    if on_circle.sum() < MIN_INLIERS * SPOKES:
        return Lost("few_inliers", int(on_circle.sum()))
    axis, half_angle = cone(fit.circle, spokes.direction, tangent_axes(spokes.direction))
    if abs(half_angle * camera.local_scale(axis) - radius) > RADIUS_FRACTION * radius:
        return Lost("wrong_radius", int(on_circle.sum()))
    measured = spokes._replace(direction=axis, half_angle=half_angle)
    return _Fitted(measured, fit.covariance, on_circle, float(np.median(edges.contrast[on_circle])))


def _away_from_others(on_circle: Bools) -> Bools:
    """Spokes whose neighbours agree too: next to the rod or an occluder the edge is bent by it."""
    used = on_circle.copy()
    for shift in range(-KEPT_AWAY, KEPT_AWAY + 1):
        used &= np.roll(on_circle, shift)
    return used if used.sum() >= on_circle.sum() / 2 else on_circle


def _agree(edges: Edges, valid: Bools, circle: Circle) -> Bools:
    distance = np.linalg.norm(edges.points - circle.center, axis=1)
    return np.asarray(valid & (np.abs(distance - circle.radius) * edges.scales <= INLIER_PX))


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


def find_circles(grey: NDArray[np.uint8], radius_px: float) -> Floats:
    """Circles (m, 2) of about a radius in greys (h, w), by the gradient method of OpenCV (Yuen et al. 1990)."""
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0)
    circles = cv2.HoughCircles(
        smooth,
        cv2.HOUGH_GRADIENT,
        dp=1.0,
        minDist=max(radius_px / 3, 1.0),
        param1=max(EDGE_FRACTION * SOBEL_GAIN * _contrast(smooth) / 2, 4.0),
        param2=VOTES,
        minRadius=int(np.floor(RADIUS_RANGE[0] * radius_px)),
        maxRadius=int(np.ceil(RADIUS_RANGE[1] * radius_px)),
    )
    if circles is None:
        return np.zeros((0, 2))
    return np.asarray(circles, dtype=np.float64).reshape(-1, np.shape(circles)[-1])[:MOST, :2]


class Search(NamedTuple):
    """Search region of a ball: the camera as it is believed, the ball predicted at (3,), mm, and its radius."""

    camera: Camera
    predicted_c: Floats  # shape (3,), mm
    radius_mm: float
    search_px: float


Detector = Callable[[int, Search], Detection | Lost]
"""Takes the camera's number and the search region."""


class Detections(NamedTuple):
    """One ball in every camera: pixels (c, 2), covariances (c, 2, 2), px^2."""

    pixels: Floats
    covariances: Floats


def image_detector(cameras: Cameras, *, hough_only: bool = False) -> Detector:
    """A new image, and the ball measured in it with the believed camera; ``hough_only``: the paper's method."""

    def see(number: int, search: Search) -> Detection | Lost:
        camera, predicted, radius_mm, reach_px = search
        image = cameras.measured_image(number, camera.project(predicted), reach_px)
        return find_ball(image, camera, predicted, radius_mm, search_px=reach_px, hough_only=hough_only)

    return see


def look_at(
    detector: Detector, cameras: tuple[Camera, ...], point_c: Floats, radius_mm: float, search_px: float, frames: int
) -> Detections | Lost:
    """Detect one ball, predicted at (3,), mm, in every camera, several images each; all must show it."""
    pixels, covariances = [], []
    for number, camera in enumerate(cameras):
        detections, search = [], Search(camera, point_c, radius_mm, search_px)
        for _ in range(frames):
            spot = detector(number, search)
            if isinstance(spot, Lost):
                return Lost(f"camera {number + 1}: {spot.reason}")
            detections.append(spot)
        # pictures of one camera are averaged by their inverse covariances
        weights = np.linalg.inv([spot.covariance for spot in detections])
        covariance = np.linalg.inv(weights.sum(axis=0))
        pixels.append(covariance @ np.einsum("fij,fj->i", weights, [spot.pixel for spot in detections]))
        covariances.append(covariance)
    return Detections(np.array(pixels), np.array(covariances))


def in_space(cameras: tuple[Camera, ...], detections: Detections) -> Points:
    """Position of one ball in C from its pixels."""
    return triangulate(cameras, detections.pixels[:, None], detections.covariances[:, None])
