"""Rays from the nominal needle, followed to where it touches first."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.uncertainty.lines.displaced_needle import (
    displacement,
    fastest_approach,
    gap_beyond,
    next_step,
    outran,
)

RAYS_TO, RAY_STEP = 4.0, 0.1
"""Standard deviations that a ray is followed, and its smallest step: it only tells what is touched about as soon."""


@nb.njit(cache=True, error_model="numpy")
def first_touches(problem, root, directions, radii):  # type: ignore[no-untyped-def]
    """Fill, for rays along ``directions`` (n, 5) from the nominal needle, how far out each touches; or infinity."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    scene = (triangles, faces, blocks, origin, outward, length, threshold, 0.0)
    start, z = np.zeros(7), np.zeros(6)
    nominal, nearest = gap_beyond(scene, start, start, 0.0, np.int64(0))
    for ray in range(len(directions)):
        for k in range(5):
            z[k] = directions[ray, k]
        radii[ray] = _first_touch(scene, start, displacement(root, z), nominal, nearest)


@nb.njit(cache=True, error_model="numpy")
def _first_touch(scene, start, ahead, gap, hint):  # type: ignore[no-untyped-def]
    """How far out a ray touches, from where the distance is ``gap``."""
    fastest, beta, low, clear = fastest_approach(scene, start, ahead), 0.0, 0.0, 0.0
    while gap >= 0.0 and beta < RAYS_TO:
        step = next_step(gap / fastest, clear, beta - low, RAY_STEP)
        low, clear, beta = beta, gap / fastest, min(beta + step, RAYS_TO)
        gap, hint = gap_beyond(scene, start, ahead, beta, hint)
        if outran(low + clear, beta, gap / fastest, RAY_STEP):
            beta = low + max(clear, RAY_STEP)
            gap, hint = gap_beyond(scene, start, ahead, beta, hint)
    return beta if gap < 0.0 else np.inf
