"""A few corners of a convex hull, and how far the others stand out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.enclosures.sphere import SLACK_MM
from puncture_twin.planning.geometry.triangle_distance import farthest_from

COARSE_DIRECTIONS = 60
"""In which a coarse hull is as wide as the hull: 26 degrees apart, so a round body of 45 mm bulges out by 1.5 mm."""


class Coarse(NamedTuple):
    """A few corners of a convex hull."""

    corners: Floats
    """Shape (n, 3), mm."""
    slack_mm: float
    """No point of the whole hull lies farther outside the hull of these."""


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
