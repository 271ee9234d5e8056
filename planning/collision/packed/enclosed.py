"""Spheres, coarse hulls and edges of convex hulls, as arrays."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Arrays
from puncture_twin.planning.collision.enclosures.coarse_hull import coarse_hull
from puncture_twin.planning.collision.enclosures.hull_edges import neighbours
from puncture_twin.planning.collision.enclosures.sphere import enclosing_sphere
from puncture_twin.planning.collision.packed.ragged import row_starts


def enclosed(hulls: Sequence[Floats]) -> Arrays:
    """Of each convex hull a sphere about it and a coarse hull: their numbers, one array each."""
    spheres, coarse = [enclosing_sphere(corners) for corners in hulls], [coarse_hull(corners) for corners in hulls]
    edges, first = [neighbours(corners) for corners in hulls], row_starts([len(corners) for corners in hulls])
    rows = [hull.rows + start for hull, start in zip(edges, first[:-1], strict=True)]
    return {
        "centres": np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
        "radii": np.array([sphere.radius for sphere in spheres]),
        "slack": np.array([hull.slack_mm for hull in coarse]),
        "sizes": np.array([len(hull.corners) for hull in coarse], dtype=np.int64),
        "few": np.concatenate([np.empty((0, 3)), *(hull.corners for hull in coarse)]),
        "degrees": np.concatenate([np.empty(0, np.int64), *(hull.degrees for hull in edges)]),
        "neighbours": np.concatenate([np.empty(0, np.int64), *rows]),
    }
