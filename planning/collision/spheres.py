"""Spheres around convex bodies, in trees, and the prisms that stand for cylinders.

A `SphereTree` encloses a body: what is clear of its spheres is clear of the body. A sphere is convex, so it contains
the convex hull of any points in it. A convex piece is cut by planes; the corners of a part are the piece's corners on
that side and the points where its edges cross the plane; a sphere about those corners contains the part
(docs/concepts/arm-collisions.md).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb

PRISM_SIDES = 24
"""Sides of the prism about a cylinder: 0.9 % fuller than it."""
FINE_SIDES = 96
"""Sides of the prism about a cylinder that is tested against triangles: 0.05 % fuller than it."""


def prism(radius_mm: float, length_mm: float, sides: int = PRISM_SIDES) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``sides``, 3), mm; those of one end first."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / sides)  # circumscribed: encloses the circle
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def finer_prism(corners: Floats) -> Floats:
    """Corners of a prism of ``FINE_SIDES`` about the cylinder that :func:`prism` gave these corners about, as there."""
    radius_mm = float(np.hypot(corners[:, 0], corners[:, 1]).max()) * np.cos(2.0 * np.pi / len(corners))
    return prism(radius_mm, float(np.ptp(corners[:, 2])), FINE_SIDES)


SLACK_MM = 1e-6
"""Every sphere is larger by this: covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""
CENTRE_STEPS = 25
"""Steps of the walk to a sphere's centre; how good it is decides how tight the sphere is, never whether it encloses."""
LEAF_RADIUS_MM = 30.0
"""Parts are cut until their sphere is no larger: half of a UR3 wrist's size."""


class BoundingSphere(NamedTuple):
    """A sphere, mm."""

    centre: Floats
    radius: float


def enclosing_sphere(points: Floats) -> BoundingSphere:
    """A small sphere about points (n, 3): steps toward the farthest point, ever shorter (Badoiu and Clarkson 2003)."""
    centre = np.empty(3)
    radius = _walk_to_centre(np.ascontiguousarray(points), CENTRE_STEPS, centre)
    return BoundingSphere(centre, radius + SLACK_MM)


@nb.njit(cache=True)
def _walk_to_centre(points, steps, best):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``best`` (3,) with the best centre visited for points (n, 3); the radius that it needs."""
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


@dataclass(frozen=True, eq=False)
class SphereTree:
    """Spheres in a tree, the root first: every node's sphere encloses all parts below it."""

    centres: Floats  # shape (n, 3), mm, in the frame of the body
    radii: Floats  # shape (n,), mm
    children: NDArray[np.int64]  # shape (n, 2): rows of the two children; -1 at a leaf

    @property
    def leaves(self) -> NDArray[np.int64]:
        """Rows of the leaves, whose spheres together cover the body."""
        return np.flatnonzero(self.children[:, 0] < 0)


def halves(corners: Floats) -> tuple[Floats, Floats]:
    """A convex hull's corners (n, 3), cut in the middle of its longest side: the corners of the two parts, mm."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    cut = (low[axis] + high[axis]) / 2.0
    faces = scipy.spatial.ConvexHull(corners).simplices
    below = corners[:, axis] < cut
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    crosses = below[starts] != below[ends]  # Qhull turns its faces either way round: each edge counts from both
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
