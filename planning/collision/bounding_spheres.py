"""Spheres that enclose the bodies of an arm: what is clear of them is clear of the body.

A sphere is convex, so it contains the convex hull of any points in it. A convex piece is cut by planes into smaller
ones; the corners of each part are the piece's corners on that side and the points where its edges cross the plane;
a sphere about those corners contains the part, and the parts together are the piece (docs/concepts/arm-collisions.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.triangle_distance import farthest_from

LEAF_RADIUS_MM = 30.0
"""Parts are cut until their sphere is no larger: half of a UR3 wrist's size."""

SLACK_MM = 1e-6
"""Every sphere is larger by this: covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""

CENTRE_STEPS = 25
"""Of the walk to a sphere's centre; how good it is decides how tight the sphere is, never whether it encloses."""

INSIDE = 1e-5
"""By this fraction a prism within a cylinder is smaller still: more than the slack of any cylinder of 1 mm or more."""

PRISM_SIDES = 24
"""Of the prism about a cylinder: 0.9 % fuller than it."""


class BoundingSphere(NamedTuple):
    """A sphere, mm."""

    centre: Floats
    radius: float


COARSE_DIRECTIONS = 60
"""In which a coarse hull is as wide as the hull: 26 degrees apart, so a round body of 45 mm bulges out by 1.5 mm."""


class Coarse(NamedTuple):
    """A few corners of a convex hull."""

    corners: Floats
    """Shape (n, 3), mm."""
    slack_mm: float
    """No point of the whole hull lies farther outside the hull of these."""


@dataclass(frozen=True, eq=False)
class SphereTree:
    """Spheres in a tree, the root first: every node's sphere encloses all parts below it.

    Attributes:
        centres: Shape (n, 3), mm, in the frame of the body.
        radii: Shape (n,), mm.
        children: Shape (n, 2): rows of the two children; -1 at a leaf.
    """

    centres: Floats
    radii: Floats
    children: NDArray[np.int64]

    @property
    def leaves(self) -> NDArray[np.int64]:
        """Rows of the leaves, whose spheres together cover the body."""
        return np.flatnonzero(self.children[:, 0] < 0)


def settings() -> dict[str, float]:
    """The numbers of this module that decide what it makes."""
    return {
        "leaf": LEAF_RADIUS_MM,
        "slack": SLACK_MM,
        "steps": CENTRE_STEPS,
        "sides": PRISM_SIDES,
        "few": COARSE_DIRECTIONS,
    }


def enclosing_sphere(points: Floats) -> BoundingSphere:
    """A small sphere about points (n, 3): steps toward the farthest point, ever shorter (Badoiu and Clarkson 2003)."""
    centre = np.empty(3)
    radius = _walk_to_centre(np.ascontiguousarray(points), CENTRE_STEPS, centre)
    return BoundingSphere(centre, radius + SLACK_MM)


@nb.njit(cache=True)
def _walk_to_centre(points, steps, best):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``best`` (3,) with the best centre met for points (n, 3); the radius that it needs."""
    x, y, z = [(points[:, i].min() + points[:, i].max()) / 2.0 for i in range(3)]
    least = math.inf
    for step in range(1, steps + 1):
        most, far = -1.0, 0
        for i in range(len(points)):
            squared = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if squared > most:
                most, far = squared, i
        if most < least:
            least = most
            best[0], best[1], best[2] = x, y, z
        x += (points[far, 0] - x) / (step + 1)
        y += (points[far, 1] - y) / (step + 1)
        z += (points[far, 2] - z) / (step + 1)
    return math.sqrt(least)


def prism(radius_mm: float, length_mm: float) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``PRISM_SIDES``, 3), mm."""
    turn = 2.0 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / PRISM_SIDES)
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def inscribed_prism(corners: Floats) -> Floats:
    """Corners of a prism inside the cylinder that :func:`prism` gave the corners about, along z of any frame."""
    middle, inside = corners.mean(axis=0), 1.0 - INSIDE
    return np.asarray(middle + (corners - middle) * (2 * [inside * np.cos(np.pi / PRISM_SIDES)] + [inside]))


class Neighbours(NamedTuple):
    """The edges of a convex hull of n corners."""

    degrees: NDArray[np.int64]
    """Shape (n,): how many neighbours each corner has."""
    rows: NDArray[np.int64]
    """The neighbours of the first corner, of the second, and so on."""


def neighbours(corners: Floats) -> Neighbours:
    """Which corners (n, 3) of a convex hull share an edge of its triangles; a corner within the hull has none."""
    faces = scipy.spatial.ConvexHull(corners).simplices
    edges = np.concatenate([np.roll(faces, turn, axis=1)[:, :2] for turn in range(3)])
    pairs = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0).astype(np.int64)
    return Neighbours(np.bincount(pairs[:, 0], minlength=len(corners)), pairs[:, 1])


def halves(corners: Floats) -> tuple[Floats, Floats]:
    """A convex hull's corners (n, 3), cut in the middle of its longest side: the corners of the two parts, mm."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    cut = (low[axis] + high[axis]) / 2.0
    faces = scipy.spatial.ConvexHull(corners).simplices
    below = corners[:, axis] < cut
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    crosses = below[starts] & ~below[ends]  # of the two faces at an edge one runs along it this way
    a, b = corners[starts[crosses]], corners[ends[crosses]]
    crossings = a + ((cut - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
    return np.concatenate([corners[below], crossings]), np.concatenate([corners[~below], crossings])


def sphere_tree(pieces: Sequence[Floats], leaf_radius_mm: float = LEAF_RADIUS_MM) -> SphereTree:
    """Spheres that enclose the union of convex pieces, each given by its corners (n, 3), mm."""
    spheres: list[BoundingSphere] = []
    children: list[tuple[int, int]] = []

    def add(parts: Sequence[Floats]) -> int:
        row = len(spheres)
        spheres.append(enclosing_sphere(np.concatenate(parts)))
        children.append((-1, -1))
        if len(parts) > 1:
            half = len(parts) // 2
            children[row] = (add(parts[:half]), add(parts[half:]))
        elif spheres[row].radius > leaf_radius_mm:
            below, above = halves(parts[0])
            children[row] = (add([below]), add([above]))
        return row

    add(pieces)
    return SphereTree(
        np.array([sphere.centre for sphere in spheres]),
        np.array([sphere.radius for sphere in spheres]),
        np.array(children, dtype=np.int64),
    )


def coarse_hull(corners: Floats) -> Coarse:
    """The corners (n, 3) that are outermost in some of many directions, mm, and how far the others stand out.

    Distance to a convex set is a convex function, so over the whole hull it is largest at a corner.
    """
    if len(corners) <= COARSE_DIRECTIONS:
        return Coarse(corners, 0.0)
    few = corners[np.unique(np.argmax(_directions(COARSE_DIRECTIONS) @ corners.T, axis=1))]
    hull = scipy.spatial.ConvexHull(few)
    outside = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > -SLACK_MM
    triangles = np.ascontiguousarray(few[hull.simplices])
    return Coarse(few, float(farthest_from(triangles, corners[outside])) + SLACK_MM)


def _directions(count: int) -> Floats:
    """Unit vectors (count, 3) spread evenly: a spiral of equal steps in z and golden turns."""
    z = 1.0 - (2.0 * np.arange(count) + 1.0) / count
    turn = np.pi * (3.0 - np.sqrt(5.0)) * np.arange(count)
    ring = np.sqrt(1.0 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
