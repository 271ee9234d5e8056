"""The outline of a ball in an image: edges along spokes to a small part of a pixel, and the circle through them.

A spoke runs over the sphere of viewing directions, from inside the outline to outside, and is projected into the image
by the camera: so lens and ellipse are in the spoke, and the outline is at the same angle on each. The grey along it is
read with cubic splines. The edge is where the grey changes fastest after a Gaussian's derivative (Canny 1986), the peak
refined by a parabola.

A ball fills a cone of rays around the direction of its centre, a circle on that sphere whatever the lens. So the circle
is fitted there and not in the image: its centre is the projection of the ball's centre itself, while the outline's
ellipse has its centre elsewhere. Points near a direction d0 are given by polar coordinates (angle from d0, direction
around it) or, for circles, by the stereographic plane touching at d0, which takes circles to circles (Snyder 1987, Map
Projections, chapter 21).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, map_coordinates, spline_filter

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, tangent_axes

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
    """A part of an image, ready to be read between its pixels."""

    pixels: NDArray[np.uint8]
    spline: Floats
    """Coefficients of the cubic spline."""
    offset: Floats
    """Shape (2,): column and row of the first pixel."""
    noise: float
    """Standard deviation of its noise, grey levels."""


class Edges(NamedTuple):
    """One edge per spoke; arrays of shape (n,)."""

    points: Floats
    """Shape (n, 2), in the stereographic plane that touches at the spokes' centre."""
    scales: Floats
    """px per radian across the outline."""
    contrast: Floats
    """Grey levels, inside minus outside."""
    inside: NDArray[np.bool_]
    """False where the steepest place lies at the end of the spoke or outside the image: no edge."""


class Spokes(NamedTuple):
    """Spokes all around a direction, about a half angle."""

    direction: Floats
    """Shape (3,), unit."""
    half_angle: float
    """Half angle of the outline, rad."""
    number: int
    reach_px: float
    """How far to both sides of the outline."""


def grey_part(pixels: NDArray[np.uint8], offset: Floats) -> Grey:
    """Prepare a part of an image; its noise is the median of second differences, which edges hardly touch."""
    grey = pixels.astype(np.float64)
    second = grey[:, :-2] - 2 * grey[:, 1:-1] + grey[:, 2:]
    noise = 1.4826 * float(np.median(np.abs(second))) / np.sqrt(6.0) if second.size else 0.0  # 1 + 4 + 1
    return Grey(pixels, np.asarray(spline_filter(grey, 3)), offset, noise)


def find_edges(grey: Grey, camera: Camera, spokes: Spokes) -> Edges:
    """The steepest place on each spoke."""
    around = 2 * np.pi * np.arange(spokes.number) / spokes.number
    across = np.stack([np.cos(around), np.sin(around)])
    scales = _scales(camera, spokes.direction, across)
    half = min(spokes.reach_px, 0.8 * spokes.half_angle * float(scales.min()))
    steps = np.arange(-half, half + STEP_PX / 2, STEP_PX)
    angles = spokes.half_angle + steps[None] / scales[:, None]
    rotated = (tangent_axes(spokes.direction) @ across).T
    rays = np.cos(angles)[..., None] * spokes.direction + np.sin(angles)[..., None] * rotated[:, None]
    places = camera.project(camera.center_c + rays) - grey.offset
    seen = np.all((places >= 0) & (places <= np.array(grey.pixels.shape[::-1]) - 1), axis=-1)
    read = map_coordinates(grey.spline, [places[..., 1], places[..., 0]], order=3, prefilter=False, mode="nearest")
    slope = gaussian_filter1d(read, SMOOTHING_PX / STEP_PX, axis=1, order=1, mode="nearest") / STEP_PX
    peak, height, inside = _peaks(slope)
    edge = spokes.half_angle + (peak * STEP_PX - half) / scales
    width = np.hypot(SMOOTHING_PX, EDGE_WIDTH_PX)
    points = 2 * np.tan(edge / 2)[:, None] * across.T  # stereographic
    return Edges(points, scales, -height * width * np.sqrt(2 * np.pi), inside & seen.all(axis=1))


def visible_fraction(
    grey: Grey, camera: Camera, spokes: Spokes, on_circle: NDArray[np.bool_], contrast: float
) -> float:
    """Fraction of the disc that looks like the ball: as bright as next to its edges, within a part of its contrast.

    Args:
        spokes: Around the measured ball.
        on_circle: Shape (n,): the spokes whose edge lies on the circle.
        contrast: Between ball and surroundings, grey levels.
    """
    around = 2 * np.pi * np.arange(spokes.number) / spokes.number
    rotated = (tangent_axes(spokes.direction) @ np.stack([np.cos(around), np.sin(around)])).T
    angles = spokes.half_angle * DISC_RINGS
    rays = np.cos(angles)[:, None, None] * spokes.direction + np.sin(angles)[:, None, None] * rotated
    places = camera.project(camera.center_c + rays) - grey.offset
    read = map_coordinates(grey.spline, [places[..., 1], places[..., 0]], order=3, prefilter=False, mode="nearest")
    ball = float(np.median(read[-1][on_circle]))
    return float(np.mean(np.abs(read - ball) < SAME_GREY * abs(contrast)))


def _scales(camera: Camera, direction: Floats, across: Floats) -> Floats:
    """Scale of an outline across itself, px per radian of a tangent circle's growth: 1 / |J^-T e|."""
    normals = np.linalg.solve(camera.angle_slope(direction).T, across)
    return np.asarray(1 / np.linalg.norm(normals, axis=0))


def _peaks(slope: Floats) -> tuple[Floats, Floats, NDArray[np.bool_]]:
    """Place (in steps) and height of each row's steepest slope, and whether it lies inside the row."""
    rows = np.arange(len(slope))
    best = np.argmax(np.abs(slope), axis=1)
    middle = np.clip(best, 1, slope.shape[1] - 2)
    before, here, after = (np.abs(slope[rows, middle + side]) for side in (-1, 0, 1))
    bend = before - 2 * here + after
    shift = np.where(bend < 0, 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)  # a parabola's peak
    return middle + np.clip(shift, -1, 1), slope[rows, middle], best == middle


STEPS = (1 / 8, 1 / 6, 1 / 4, 1 / 3)
"""Spacing of the three points, in turns: short arcs survive occlusion, long ones fix the circle well."""
REFIT_ROUNDS = 8
"""Reweighted Gauss-Newton rounds; the step is below 1e-6 px after four."""
TUKEY = 4.685
"""Tuning constant of Tukey's biweight: 95 % efficient for normal errors (Huber 1981)."""


class Circle(NamedTuple):
    """A circle in the stereographic plane, in radians of view near its origin."""

    center: Floats
    """Shape (2,)."""
    radius: float


class Refit(NamedTuple):
    """A robust least-squares circle."""

    circle: Circle
    covariance: Floats
    """Shape (3, 3), of center and radius, for independent edges of the spread found, rad^2."""


def consensus(points: Floats, valid: NDArray[np.bool_], scales: Floats, tolerance_px: float) -> Circle | None:
    """The circle through three edges that most edges lie on (RANSAC, Fischler and Bolles 1981).

    The triples are not drawn: every edge with its neighbours at four spacings, so the answer is the same every time.

    Args:
        points: Shape (n, 2), edges in the stereographic plane, in order around the ball, evenly spread.
        valid: Shape (n,), which of them are edges at all.
        scales: Shape (n,), px per radian across the outline.
        tolerance_px: How far off an edge may lie.
    """
    count = len(points)
    first = np.arange(count)
    triples = np.concatenate(
        [np.stack([first, first + round(s * count), first + 2 * round(s * count)], 1) for s in STEPS]
    )
    triples = triples % count
    triples = triples[valid[triples].all(axis=1)]
    if len(triples) == 0:
        return None
    centers, radii = _through(points[triples])
    distances = np.linalg.norm(points[None] - centers[:, None], axis=-1)
    misses = np.abs(distances - radii[:, None]) * scales
    misses[:, ~valid] = np.inf
    misses[~np.isfinite(radii)] = np.inf
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
    """Least squares of the edges' distances with Tukey's weights, from a start near the answer.

    Args:
        points: Shape (n, 2), edges in the stereographic plane.
        scales: Shape (n,), px per radian across the outline.
        start: From ``consensus``.
        tolerance_px: The spread is not believed to be larger than this.
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
    """Axis (3,) and half angle (rad) of the cone that a circle of the plane touching at ``direction`` belongs to.

    Args:
        circle: In the stereographic plane.
        direction: Shape (3,), unit: where the plane touches.
        axes: Shape (3, 2), the plane's axes.
    """
    away = float(np.linalg.norm(circle.center))
    near, far = (2 * np.arctan((away + side * circle.radius) / 2) for side in (-1, 1))
    across = circle.center / away if away > 0 else np.zeros(2)
    tilt = (near + far) / 2
    return np.cos(tilt) * direction + np.sin(tilt) * (axes @ across), float((far - near) / 2)
