"""The spheres of the bodies' full shapes."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.cache.array_cache import Arrays, Cache
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.collision.enclosures.sphere_tree import SphereTree, sphere_tree
from puncture_twin.planning.collision.packed.frames import in_frame
from puncture_twin.planning.collision.packed.made_from import made_from


def _tree_arrays(pieces: Sequence[Floats]) -> Arrays:
    return dict(vars(sphere_tree(pieces)))


def packed_trees(bodies: Sequence[Body], cache: Cache) -> tuple[dict[str, int], tuple[Floats, Floats, Ints]]:
    """The spheres of the bodies' full shapes, each in the body's frame, and the row of each body's root."""
    roots: dict[str, int] = {}
    centres, radii, children = [np.empty((0, 3))], [np.empty(0)], [np.empty((0, 2), np.int64)]
    for body in bodies:
        pieces = [in_frame(hull, body) for hull in body.full.hulls]
        tree = SphereTree(**cache.arrays(made_from("balls", pieces), partial(_tree_arrays, pieces), by=__name__))
        start = sum(len(part) for part in radii)
        roots[body.name] = start
        centres.append(tree.centres)
        radii.append(tree.radii)
        children.append(np.where(tree.children < 0, -1, tree.children + start))
    return roots, (np.concatenate(centres), np.concatenate(radii), np.concatenate(children))
