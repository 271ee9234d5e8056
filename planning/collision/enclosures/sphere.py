"""A small sphere about points: it contains their convex hull too."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb

SLACK_MM = 1e-6
"""Every sphere is larger by this: covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""

CENTRE_STEPS = 25
"""Of the walk to a sphere's centre; how good it is decides how tight the sphere is, never whether it encloses."""


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
