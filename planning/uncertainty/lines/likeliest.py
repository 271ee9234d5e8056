"""The direction of displacement in which a needle touches soonest."""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.uncertainty.lines.needle_doubt import NeedleDoubt, Problem
from puncture_twin.planning.uncertainty.lines.rays import first_touches

PREFERRED, SOONER, NO_MATTER = 0.1, 0.8, 3.8
"""Standard deviations by which another direction must be better than first order's; how much sooner than a plane
something else is touched; and how far out it does not matter."""


def likeliest_slope(problem: Problem, doubt: NeedleDoubt, slope: Floats, slack: float) -> tuple[Floats, bool]:
    """The slope (5,) along which the needle touches soonest, and whether nothing else touches about as soon.

    The nearest face need not be the likeliest, where a farther one lies in the direction of greater doubt: rays are
    sent in 51 directions. What touches sooner than a plane across the likeliest direction would is something else.
    """
    size = float(np.linalg.norm(slope))
    directions = np.vstack([-slope / size if size > 0.0 else np.eye(5)[0], _rays()])
    radii = np.empty(len(directions))
    first_touches(problem, doubt.root, directions, radii)
    best = int(np.argmin(radii))
    if not np.isfinite(radii[best]) or radii[best] <= 0.0 or radii[0] < radii[best] + PREFERRED:
        best = 0
    flat = np.full(len(radii), np.inf)
    towards = directions @ directions[best]
    np.divide(radii[best], towards, out=flat, where=towards > 0.05)
    alone = not bool(((radii < SOONER * flat) & (radii < NO_MATTER)).any())
    return (slope, alone) if best == 0 else (-directions[best] * (slack / radii[best]), alone)


@cache
def _rays() -> Floats:
    """Along each of five normals and between each two, with both signs: shape (50, 5)."""
    signs = (1.0, -1.0)
    ones = [sign * np.eye(5)[k] for k in range(5) for sign in signs]
    twos = [
        math.sqrt(0.5) * (one * np.eye(5)[i] + other * np.eye(5)[j])
        for i, j in itertools.combinations(range(5), 2)
        for one in signs
        for other in signs
    ]
    return np.array(ones + twos)
