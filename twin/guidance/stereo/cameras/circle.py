"""The outline of a ball as a circle: exactly one on the sphere of viewing directions, whatever the lens.

A ball fills a cone of rays around the direction of its centre. So the circle is fitted there and not in the picture:
its centre is the projection of the ball's centre itself, while the outline's ellipse has its centre elsewhere. Points
near a direction d0 are given by polar coordinates (angle from d0, direction around it) or, for circles, by the
stereographic plane touching at d0, which takes circles to circles (Snyder 1987, Map Projections, chapter 21).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats

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
    score = np.sum(1 - np.clip(misses / tolerance_px, 0, 1) ** 2, axis=1)
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
        root_weight = 1 - ratio**2
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
