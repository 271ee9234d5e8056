"""Implicit shapes: functions that are negative inside a body, positive outside, and grow about 1 per mm."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from puncture_twin.planning.base.arrays import Floats

Field = Callable[[Floats], Floats]
"""Takes points (n, 3), mm, and returns (n,) values, mm: < 0 inside, 0 on the surface, > 0 outside."""
_EVALUATE_WITHIN_MM = 12.0
"""Farther outside than this a body's neighbours cannot touch its surface, so they are not evaluated."""
_NEAR_CENTRE = 1e-9
"""Keeps the distance estimate of an ellipsoid finite at its very centre."""


def smooth_max(a: Floats, b: Floats, blend_mm: float) -> Floats:
    """Maximum of two fields with the crease rounded over ``blend_mm``; never below the true maximum."""
    overlap = np.maximum(blend_mm - np.abs(a - b), 0.0) / blend_mm
    return np.asarray(np.maximum(a, b) + overlap**2 * blend_mm / 4.0)


def smooth_min(a: Floats, b: Floats, blend_mm: float) -> Floats:
    """Minimum of two fields with the crease filled over ``blend_mm``; never above the true minimum."""
    return -smooth_max(-a, -b, blend_mm)


def union(fields: Sequence[Field], blend_mm: float) -> Field:
    """The bodies together, their joins filled over ``blend_mm``."""

    def field(points: Floats) -> Floats:
        value = fields[0](points)
        for other in fields[1:]:
            value = smooth_min(value, other(points), blend_mm)
        return value

    return field


def offset(body: Field, distance_mm: float) -> Field:
    """The body grown outward by ``distance_mm`` (shrunk when negative)."""
    return lambda points: body(points) - distance_mm


def within(body: Field, limits: Sequence[Field], blend_mm: float) -> Field:
    """The part of a body that lies inside every limit, edges rounded over ``blend_mm``."""

    def field(points: Floats) -> Floats:
        value = body(points)
        near = value < _EVALUATE_WITHIN_MM
        inner, kept = points[near], value[near]
        for limit in limits:
            kept = smooth_max(kept, limit(inner), blend_mm)
        value[near] = kept
        return value

    return field


def carve(body: Field, neighbours: Sequence[Field], gap_mm: float, blend_mm: float) -> Field:
    """The body with room left for its neighbours.

    Inside the result every neighbour's field is above ``gap_mm`` (> 0), so the bodies are disjoint by construction.
    """
    return within(body, [_outside(neighbour, gap_mm) for neighbour in neighbours], blend_mm)


def _outside(body: Field, gap_mm: float) -> Field:
    return lambda points: gap_mm - body(points)


def ellipsoid(centre: ArrayLike, radii: ArrayLike, turn: Rotation | None = None) -> Field:
    """An ellipsoid; its field is the first-order distance estimate k (k - 1) / |grad k**2| * 2.

    Args:
        turn: Rotation from the ellipsoid's axes to the frame of the points; none when absent.
    """
    middle, half = np.asarray(centre, dtype=float), np.asarray(radii, dtype=float)
    to_axes = np.eye(3) if turn is None else turn.as_matrix()

    def field(points: Floats) -> Floats:
        local = (points - middle) @ to_axes / half
        k = np.linalg.norm(local, axis=1)
        slope = np.linalg.norm(local / half, axis=1)
        return np.asarray(k * (k - 1.0) / np.maximum(slope, _NEAR_CENTRE))

    return field


def capsule(start: ArrayLike, end: ArrayLike, radius_start_mm: float, radius_end_mm: float | None = None) -> Field:
    """A straight rod with round ends, tapered when the two radii differ (mm)."""
    a, b = np.asarray(start, dtype=float), np.asarray(end, dtype=float)
    axis = b - a
    thin = radius_start_mm if radius_end_mm is None else radius_end_mm

    def field(points: Floats) -> Floats:
        along = np.clip((points - a) @ axis / (axis @ axis), 0.0, 1.0)
        distance = np.linalg.norm(points - a - along[:, None] * axis, axis=1)
        return np.asarray(distance - radius_start_mm - along * (thin - radius_start_mm))

    return field


def below(axis: int, limit_mm: float) -> Field:
    """The half space where the coordinate ``axis`` is below ``limit_mm``."""
    return lambda points: points[:, axis] - limit_mm


def above(axis: int, limit_mm: float) -> Field:
    """The half space where the coordinate ``axis`` is above ``limit_mm``."""
    return lambda points: limit_mm - points[:, axis]


def mirrored(body: Field) -> Field:
    """The body reflected in the plane x = 0."""
    return lambda points: body(points * np.array([-1.0, 1.0, 1.0]))
