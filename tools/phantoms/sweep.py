"""Bodies swept along a smooth curve: vessels, bowel (round section) and ribs (flat section)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.spatial import cKDTree

from puncture_twin.planning.base.arrays import Floats
from tools.phantoms.implicit import Field

_SAMPLE_MM = 1.5
"""Step of the polyline along the curve; with the spans beside the nearest node the distance errs below 0.01 mm."""


class Curve(NamedTuple):
    """A polyline (n, 3), mm, along a spline, dense enough to stand for it."""

    points: Floats
    parameter: Floats


class Foot(NamedTuple):
    """Nearest places on a curve: ``place`` (n, 3), mm; ``node`` (n,), fractional index into the curve's nodes."""

    place: Floats
    node: Floats


def smooth_curve(controls: ArrayLike) -> Curve:
    """A cubic spline through the control points (m, 3), mm."""
    knots = np.asarray(controls, dtype=float)
    chord = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(knots, axis=0), axis=1))])
    count = max(int(np.ceil(chord[-1] / _SAMPLE_MM)), 2) + 1
    at = np.linspace(0.0, chord[-1], count)
    if len(knots) == 2:
        points = knots[0] + (at / chord[-1])[:, None] * (knots[1] - knots[0])
    else:
        points = CubicSpline(chord, knots)(at)
    return Curve(points, np.interp(at, chord, np.arange(len(knots))))


def nearest(curve: Curve, tree: cKDTree, points: Floats) -> Foot:
    """The foot of each point on the curve: the nearest node, then the better of the two spans beside it."""
    last = len(curve.points) - 1
    hit = tree.query(points)[1]
    best = np.full(len(points), np.inf)
    place, node = np.empty_like(points), np.empty(len(points))
    for first in (np.maximum(hit - 1, 0), np.minimum(hit, last - 1)):
        start, span = curve.points[first], curve.points[first + 1] - curve.points[first]
        along = np.clip(np.sum((points - start) * span, axis=1) / np.sum(span**2, axis=1), 0.0, 1.0)
        foot = start + along[:, None] * span
        squared = np.sum((points - foot) ** 2, axis=1)
        closer = squared < best
        best[closer], place[closer], node[closer] = squared[closer], foot[closer], (first + along)[closer]
    return Foot(place, node)


def tube(controls: ArrayLike, radii_mm: ArrayLike, folds_mm: float = 0.0, fold_length_mm: float = 30.0) -> Field:
    """A round tube through control points.

    Args:
        radii_mm: Radius at each control point, shape (m,), or one for all.
        folds_mm: Height of regular constrictions along the tube (haustra of the colon).
        fold_length_mm: Distance between two constrictions.
    """
    curve = smooth_curve(controls)
    wanted = np.broadcast_to(np.asarray(radii_mm, dtype=float), (len(np.asarray(controls)),))
    radius = PchipInterpolator(np.arange(len(wanted)), wanted)(curve.parameter)
    length = np.arange(len(radius)) * np.linalg.norm(np.diff(curve.points, axis=0), axis=1).mean()
    radius = radius - folds_mm * (0.5 + 0.5 * np.cos(2 * np.pi * length / fold_length_mm))
    tree, index = cKDTree(curve.points), np.arange(len(radius))

    def field(points: Floats) -> Floats:
        foot = nearest(curve, tree, points)
        return np.asarray(np.linalg.norm(points - foot.place, axis=1) - np.interp(foot.node, index, radius))

    return field


def ribbon(controls: ArrayLike, outward: ArrayLike, half_height_mm: float, half_thickness_mm: float) -> Field:
    """A flat bar with round edges that follows a curve, as a rib does.

    Args:
        outward: Direction of the thin side at each control point, shape (m, 3).
    """
    curve = smooth_curve(controls)
    knots = np.arange(len(np.asarray(controls)))
    columns = np.asarray(outward, dtype=float).T
    thin = np.stack([np.interp(curve.parameter, knots, column) for column in columns], axis=1)
    tangent = np.gradient(curve.points, axis=0)
    height = np.cross(tangent, thin)
    height /= np.linalg.norm(height, axis=1, keepdims=True)
    tree, index = cKDTree(curve.points), np.arange(len(height))
    flat = half_height_mm - half_thickness_mm

    def field(points: Floats) -> Floats:
        foot = nearest(curve, tree, points)
        up = np.stack([np.interp(foot.node, index, column) for column in height.T], axis=1)
        offset = points - foot.place
        tall = np.sum(offset * up, axis=1)
        shrunk = offset - np.clip(tall, -flat, flat)[:, None] * up
        return np.asarray(np.linalg.norm(shrunk, axis=1) - half_thickness_mm)

    return field
