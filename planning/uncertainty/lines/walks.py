"""Lines of displaced needles, walked to where they touch: the compiled inside of `line_sampling`.

A step is never longer than the needle's distance over the fastest that any of its points moves, so that no approach
is outrun; through what it touches it goes in small steps, and at every exit it is tested whether the needle is inside.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.displaced_axis import beyond
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.uncertainty.lines.displaced_needle import (
    FARTHEST,
    displacement,
    fastest_approach,
    gap_beyond,
    next_step,
    outran,
)

SMALLEST_STEP, INSIDE_STEP = 0.04, 0.25
"""Standard deviations: of a walk that all but touches, and through what it touches."""

END_WITHIN = 0.005
"""Standard deviations within which an end of a stretch is known; counted as touched, so that no chance is too small."""

LITTLE = 0.01
"""A walk ends where what is left of its normal is this part of what it has: all that is left counts as touched."""

NUDGE_MM = 1e-6
"""By which a tip's path is moved aside, so that it does not run through an edge of a face."""

ROOT_HALF = math.sqrt(0.5)


@nb.njit(cache=True, error_model="numpy")
def walked(problem, root, surface_mm, basis, offsets, sizes):  # type: ignore[no-untyped-def]  # numba infers
    """The chance along each line, shape (n,); its errors are so many times as large (n,)."""
    chances, hint = np.empty(len(offsets)), np.int64(0)
    triangles, faces, blocks, origin, outward, length, threshold = problem
    scene = (triangles, faces, blocks, origin, outward, length, threshold, surface_mm)
    down = displacement(root, basis[0])
    for line in range(len(offsets)):
        z = np.zeros(6)
        for k in range(5):
            for x in range(6):
                z[x] += offsets[line, k] * basis[k + 1, x]
        start, ahead = sizes[line] * displacement(root, z), sizes[line] * down
        chances[line], hint = _walk(scene, start, ahead, hint)
    return chances


@nb.njit(cache=True, error_model="numpy")
def _walk(scene, start, ahead, hint):  # type: ignore[no-untyped-def]
    """Sum of Phi over the stretches of one line that touch."""
    fastest = fastest_approach(scene, start, ahead)
    low, high, closing, inside, entry, total = -np.inf, -FARTHEST, False, False, -np.inf, 0.0
    clear = 0.0  # beyond low, of what the last distance leaves free
    while True:  # one place that wants the distance: it is compiled into each
        beta = 0.5 * (low + high) if closing else high
        gap, hint = gap_beyond(scene, start, ahead, beta, hint)
        doubtful = inside or low == -np.inf or scene[7] > 0.0
        touches = gap < 0.0 or (doubtful and _swallowed(scene, start, ahead, beta))
        if low == -np.inf:
            inside = touches
        elif not inside and not closing and outran(low + clear, beta, gap / fastest, SMALLEST_STEP):
            high = low + max(clear, SMALLEST_STEP)
            continue
        elif closing or touches != inside:  # an end of a stretch lies between low and high
            low, high = (beta, high) if touches == inside else (low, beta)
            closing = high - low > END_WITHIN
            if closing:
                continue
            if inside:
                total += _normal(high) - _normal(entry)
            entry, inside, beta, gap = low, not inside, high, SMALLEST_STEP * fastest
        left, so_far = _normal(-beta), total + (_normal(beta) - _normal(entry) if inside else 0.0)
        if beta >= FARTHEST or left <= LITTLE * so_far:
            return so_far + (left if so_far > 0.0 else 0.0), hint
        step = INSIDE_STEP if inside else next_step(gap / fastest, clear, beta - low, SMALLEST_STEP)
        low, high, clear = beta, min(beta + step, FARTHEST), gap / fastest


@nb.njit(cache=True, error_model="numpy")
def _swallowed(scene, start, ahead, beta):  # type: ignore[no-untyped-def]
    """Whether a needle that is near no face is inside: its tip came through an odd number of them.

    Faces that the tip can come through are near the nominal needle, all of them.
    """
    triangles, origin = scene[0], scene[3]
    ox, oy, oz = origin[0] + NUDGE_MM, origin[1] - 0.61 * NUDGE_MM, origin[2] + 0.37 * NUDGE_MM
    x, y, z = start[0] + beta * ahead[0], start[1] + beta * ahead[1], start[2] + beta * ahead[2]
    size = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = (x / size, y / size, z / size) if size > 0.0 else (0.0, 0.0, 0.0)
    odd = False
    for row in range(len(triangles)):
        if row % LANES == 0:
            passed = beyond(scene[2][row // LANES], ox, oy, oz, ux, uy, uz, size, 0.0)
        if passed:
            continue
        t = triangles[row]
        ax, ay, az, bx, by, bz = t[0] - ox, t[1] - oy, t[2] - oz, t[3] - ox, t[4] - oy, t[5] - oz
        cx, cy, cz = t[6] - ox, t[7] - oy, t[8] - oz
        wa = x * (by * cz - bz * cy) + y * (bz * cx - bx * cz) + z * (bx * cy - by * cx)
        wb = x * (cy * az - cz * ay) + y * (cz * ax - cx * az) + z * (cx * ay - cy * ax)
        wc = x * (ay * bz - az * by) + y * (az * bx - ax * bz) + z * (ax * by - ay * bx)
        if not ((wa > 0.0 and wb > 0.0 and wc > 0.0) or (wa < 0.0 and wb < 0.0 and wc < 0.0)):
            continue
        total = wa + wb + wc
        px, py, pz = wa * ax + wb * bx + wc * cx, wa * ay + wb * by + wc * cy, wa * az + wb * bz + wc * cz
        along = (px * x + py * y + pz * z) / total
        if 0.0 < along < x * x + y * y + z * z and not (row > 0 and np.array_equal(t, triangles[row - 1])):
            odd = not odd  # the last block of a surface repeats its last face
    return odd


@nb.njit(cache=True, error_model="numpy")
def _normal(x):  # type: ignore[no-untyped-def]
    return 0.5 * math.erfc(-x * ROOT_HALF)
