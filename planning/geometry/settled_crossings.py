"""Where rays from inside a surface cross it, also those through an edge."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.crossings import Crossings, crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh

NUDGE = 1e-7
"""Radians by which a ray through an edge or corner is turned when its crossings do not add up."""


def settled_crossings(mesh: TriangleMesh, origin: Floats, directions: Floats) -> tuple[Crossings, Bools]:
    """Crossings, and which rays leave the body an odd number of times, as a ray from inside a closed surface must.

    A ray through an edge or corner may count twice or touch without crossing; it is turned by `NUDGE` and asked again.
    """
    found = crossings(mesh, origin, directions)
    odd = found.count % 2 == 1
    if mesh.closed and not odd.all():
        rotated = directions.copy()
        rotated[~odd] = _rotated(directions[~odd])
        found = crossings(mesh, origin, rotated)
        odd = found.count % 2 == 1
    return found, odd


def _rotated(directions: Floats) -> Floats:
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    aside = np.cross(directions, helper)
    rotated = directions + NUDGE * aside / np.linalg.norm(aside, axis=1, keepdims=True)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1, keepdims=True))
