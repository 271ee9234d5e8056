"""Balls that enclose the bodies of an arm: what is clear of them is clear of the body.

A ball is convex, so it contains the convex hull of any points in it. A convex piece is cut by planes into smaller
ones; the corners of each part are the piece's corners on that side and the points where its edges cross the plane;
a ball about those corners contains the part, and the parts together are the piece (docs/arm.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull

from planning.robot.proof_kernels import farthest_from

Array = NDArray[np.float64]

LEAF_RADIUS_MM = 30.0
"""Parts are cut until their ball is no larger: half of a UR3 wrist's size."""

SLACK_MM = 1e-6
"""Every ball is larger by this: covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""

CENTRE_STEPS = 25
"""Of the walk to a ball's centre; how good it is decides how tight the ball is, never whether it encloses."""

PRISM_SIDES = 24
"""Of the prism about a cylinder: 0.9 % fuller than it."""


class Ball(NamedTuple):
    """A ball, mm."""

    centre: Array
    radius: float


COARSE_DIRECTIONS = 60
"""In which a coarse hull is as wide as the hull: 26 degrees apart, so a round body of 45 mm bulges out by 1.5 mm."""


class Coarse(NamedTuple):
    """A few corners of a convex hull."""

    corners: Array
    """Shape (n, 3), mm."""
    slack_mm: float
    """No point of the whole hull lies farther outside the hull of these."""


@dataclass(frozen=True, eq=False)
class BallTree:
    """Balls in a tree, the root first: every node's ball encloses all parts below it.

    Attributes:
        centres: Shape (n, 3), mm, in the frame of the body.
        radii: Shape (n,), mm.
        children: Shape (n, 2): rows of the two children; -1 at a leaf.
    """

    centres: Array
    radii: Array
    children: NDArray[np.int64]

    @property
    def leaves(self) -> NDArray[np.int64]:
        """Rows of the leaves, whose balls together cover the body."""
        return np.flatnonzero(self.children[:, 0] < 0)


def enclosing_ball(points: Array) -> Ball:
    """A small ball about points (n, 3): steps toward the farthest point, ever shorter (Badoiu and Clarkson 2003)."""
    centre = (points.min(axis=0) + points.max(axis=0)) / 2.0
    best = Ball(centre, np.inf)
    for step in range(1, CENTRE_STEPS + 1):
        squared = ((points - centre) ** 2).sum(axis=1)
        farthest = int(np.argmax(squared))
        if squared[farthest] < best.radius**2:
            best = Ball(centre, float(np.sqrt(squared[farthest])))
        centre = centre + (points[farthest] - centre) / (step + 1)
    return Ball(best.centre, best.radius + SLACK_MM)


def prism(radius_mm: float, length_mm: float) -> Array:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``PRISM_SIDES``, 3), mm."""
    turn = 2.0 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / PRISM_SIDES)
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def halves(corners: Array) -> tuple[Array, Array]:
    """A convex hull's corners (n, 3), cut in the middle of its longest side: the corners of the two parts, mm."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    cut = (low[axis] + high[axis]) / 2.0
    faces = ConvexHull(corners).simplices
    edges = np.unique(np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]]), axis=1), axis=0)
    a, b = corners[edges[:, 0]], corners[edges[:, 1]]
    crosses = (a[:, axis] < cut) != (b[:, axis] < cut)
    a, b = a[crosses], b[crosses]
    crossings = a + ((cut - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
    below = corners[:, axis] < cut
    return np.concatenate([corners[below], crossings]), np.concatenate([corners[~below], crossings])


def ball_tree(pieces: Sequence[Array], leaf_radius_mm: float = LEAF_RADIUS_MM) -> BallTree:
    """Balls that enclose the union of convex pieces, each given by its corners (n, 3), mm."""
    balls: list[Ball] = []
    children: list[tuple[int, int]] = []

    def add(parts: Sequence[Array]) -> int:
        row = len(balls)
        balls.append(enclosing_ball(np.concatenate(parts)))
        children.append((-1, -1))
        if len(parts) > 1:
            half = len(parts) // 2
            children[row] = (add(parts[:half]), add(parts[half:]))
        elif balls[row].radius > leaf_radius_mm:
            below, above = halves(parts[0])
            children[row] = (add([below]), add([above]))
        return row

    add(pieces)
    return BallTree(
        np.array([ball.centre for ball in balls]),
        np.array([ball.radius for ball in balls]),
        np.array(children, dtype=np.int64),
    )


def coarse_hull(corners: Array) -> Coarse:
    """The corners (n, 3) that are outermost in some of many directions, mm, and how far the others stand out.

    Distance to a convex set is a convex function, so over the whole hull it is largest at a corner.
    """
    if len(corners) <= COARSE_DIRECTIONS:
        return Coarse(corners, 0.0)
    few = corners[np.unique(np.argmax(_directions(COARSE_DIRECTIONS) @ corners.T, axis=1))]
    hull = ConvexHull(few)
    outside = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > -SLACK_MM
    triangles = np.ascontiguousarray(few[hull.simplices])
    return Coarse(few, float(farthest_from(triangles, corners[outside])) + SLACK_MM)


def _directions(count: int) -> Array:
    """Unit vectors (count, 3) spread evenly: a spiral of equal steps in z and golden turns."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
