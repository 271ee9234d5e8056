"""The exact distances of a bundle of axes from the blocks that it may come near to.

Each step goes through all pairs of an axis and a block (then of an axis and a triangle) before the next step begins, so
that no pair waits for what another finds; only between the steps do the upper bounds fall.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.bounds import HUGE, ZERO, disc_bounds, heed_ends, line_distances
from puncture_twin.planning.clearance.kernels.lanes import LANES, at_most, least_of, lowest
from puncture_twin.planning.clearance.kernels.side_by_side import PAIRS, bring_into_frame, measure_beside, measure_other

ROUNDING = np.float32(4e-6)
"""Fraction of its corners' distance from the line by which a float32 distance may err
(docs/concepts/fast-search.md)."""

AREA_ROUNDING = np.float32(2e-6)
"""Fraction of that distance's square by which a float32 edge function may err."""

SINGLE = np.float32(2e-7)
"""Chord of one direction: what float32 takes from a unit vector."""

GROWN = np.float32(1 + 1e-6)
"""More than float32 takes from a root and a product."""

SLOPE = np.float32(0.05)
"""Cosine between an axis and a disc's normal below which the disc's slab says nothing of where it is met."""

THREE, FOUR = np.float32(3), np.float32(4)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def measure_bundle(surface, needle, count, low, high, lanes, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure a bundle's axes from the found blocks: each from its most promising one, then from what may be nearer.

    Args:
        surface: `Blocks.triangles` and ``local``.
        needle: `Needle`.
        count: Found blocks, their nodes in ``scratch.chosen``.
        low: First direction of the bundle.
        high: The one behind its last.
        lanes: `LANES`, as an argument: a constant would be unrolled to scalar code.
        scratch: `Scratch`.
        answer: `Found`; rows ``low`` to ``high`` are lowered.
        seed: Returned where nothing nearer is found.

    Returns:
        The row of a triangle that was found nearest to one of the axes.
    """
    groups = (count + LANES - 1) // LANES
    waiting, m, group = _most_promising(needle, groups, low, high, scratch, answer), np.int64(0), np.int64(0)
    while waiting > 0 or m < high - low:
        seed = _measure_pairs(surface, needle, low, waiting, lanes, scratch, answer, seed)
        waiting = np.int64(0)
        while m < high - low and waiting <= PAIRS - LANES:
            waiting = _others(needle, groups, m, group, low, waiting, scratch, answer)
            group += 1
            if group == groups:
                m, group = m + 1, np.int64(0)
    return seed


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def direction(frames, m):  # type: ignore[no-untyped-def]  # numba infers
    """Direction u of a bundle's member."""
    return frames[0, m], frames[1, m], frames[2, m]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def across(frames, m):  # type: ignore[no-untyped-def]  # numba infers
    """The two unit vectors e and f that complete it to a frame."""
    return (frames[3, m], frames[4, m], frames[5, m]), (frames[6, m], frames[7, m], frames[8, m])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _most_promising(needle, groups, low, high, scratch, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Bound all found blocks for all axes; pair each axis with the block of the least bound. How many pairs."""
    waiting = 0
    for m in range(high - low):
        u, best, least = direction(scratch.frames32, m), 0, HUGE
        length = np.float32(needle.length[low + m])
        for group in range(groups):
            row = m * groups + group
            disc_bounds(scratch.chosen, group, u, SINGLE, length, needle.slack, scratch.bounds, row)
            bound = least_of(scratch.bounds, row)
            best, least = row if bound < least else best, bound if bound < least else least
        if least <= scratch.upper[m]:
            lane = lowest(at_most(scratch.bounds, best, least))
            scratch.bounds[best, lane] = HUGE
            scratch.pairs[waiting, 0], scratch.pairs[waiting, 1] = m, (best - m * groups) * LANES + lane
            waiting += 1
    answer.counts[3] += high - low
    answer.counts[4] += groups * (high - low)
    return waiting


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _others(needle, groups, m, group, low, waiting, scratch, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Pair an axis with the blocks of a group that may be nearer, or be met before, than what was found."""
    bits = at_most(scratch.bounds, m * groups + group, scratch.upper[m])
    while bits != 0:
        lane = lowest(bits)
        bits &= bits - 1
        scratch.pairs[waiting, 0], scratch.pairs[waiting, 1] = m, group * LANES + lane
        waiting += 1
        if answer.square[low + m] == 0.0:
            contact_from = _contact_from(scratch.chosen, group, lane, direction(scratch.frames32, m), needle.slack)
            waiting -= 1 if contact_from > np.float32(answer.depth[low + m]) * GROWN else 0
    return waiting


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _contact_from(chosen, group, lane, u, slack):  # type: ignore[no-untyped-def]  # numba infers
    """Depth before which an axis cannot touch a disc's content: where it enters its sphere and its slab, mm."""
    center = (chosen[group, 0, lane], chosen[group, 1, lane], chosen[group, 2, lane])
    normal = (chosen[group, 3, lane], chosen[group, 4, lane], chosen[group, 5, lane])
    h, slope = chosen[group, 7, lane] + slack, _dot(normal, u)
    enters = (_dot(center, normal) - (h if slope > ZERO else -h)) / slope if abs(slope) > SLOPE else ZERO
    return max(_dot(center, u) - chosen[group, 8, lane] - slack, enters - FOUR * slack / SLOPE)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    """Inner product of two vectors of three."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _measure_pairs(surface, needle, low, waiting, lanes, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure axes from blocks; row of a triangle that was found nearer, or ``seed``.

    Of each block the triangle that seems nearest comes first; then what is still as near as the nearest found.
    """
    answer.counts[5] += waiting
    for p in range(waiting):
        _test_block(surface[1], needle, low, p, lanes, scratch)
    for turn in range(2):
        count = np.int64(0)
        for p in range(waiting):
            m, first = scratch.pairs[p, 0], scratch.found[scratch.pairs[p, 1]] * LANES
            reach = (scratch.upper[m] + scratch.errors[p]) * (scratch.upper[m] + scratch.errors[p]) * GROWN
            limit = reach if turn == 1 or reach < scratch.least[p] else scratch.least[p]
            bits = at_most(scratch.squares, p, limit)
            while bits != 0:
                lane = lowest(bits)
                bits &= bits - 1
                scratch.squares[p, lane] = HUGE
                scratch.tried[count, 0], scratch.tried[count, 1] = m, first + lane
                count += 1
        seed = _try_all(surface[0], needle, low, count, scratch, answer, seed)
    return seed


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _test_block(local, needle, low, p, lanes, scratch):  # type: ignore[no-untyped-def]  # numba infers
    """The float32 distances of a pair's axis from the triangles of its block, the least of them, and their error."""
    m, slot, slack = scratch.pairs[p, 0], scratch.pairs[p, 1], needle.slack
    group, at, block = slot // LANES, slot % LANES, scratch.found[slot]
    u, (e, f) = direction(scratch.frames32, m), across(scratch.frames32, m)
    center = (scratch.chosen[group, 0, at], scratch.chosen[group, 1, at], scratch.chosen[group, 2, at])
    radius, x, y, along = scratch.chosen[group, 8, at], _dot(center, e), _dot(center, f), _dot(center, u)
    around = np.sqrt(x * x + y * y) + radius
    tolerance = -around * (AREA_ROUNDING * around + THREE * slack)
    line_distances(local, block, e, f, x, y, tolerance, scratch.squares, p)
    length = np.float32(needle.length[low + m])
    if along + radius > length or along < radius:
        near = slack + ROUNDING * (abs(along) + radius)
        heed_ends(local, block, lanes, u, along, length, near, scratch.squares, p)
    scratch.least[p], scratch.errors[p] = least_of(scratch.squares, p), ROUNDING * around + slack


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _try_all(triangles, needle, low, count, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure axes from triangles; row of one that was found nearer, or ``seed``.

    What is nearer is kept, and of equals what comes first.
    """
    corners = scratch.corners
    for k in range(count):
        m, (e, f) = scratch.tried[k, 0], across(scratch.frames, scratch.tried[k, 0])
        bring_into_frame(direction(scratch.frames, m), e, f, triangles, scratch.tried[k, 1], needle.target, corners, k)
        corners[11, k] = needle.length[low + m]
    measure_beside(corners, count)
    answer.counts[6] += count
    for k in range(count):
        m, square, depth = scratch.tried[k, 0], corners[9, k], corners[10, k]
        if square < 0.0:
            square, depth = measure_other(corners, k)
        i = low + m
        if square < answer.square[i] or (square == answer.square[i] and depth < answer.depth[i]):
            answer.square[i], answer.depth[i], seed = square, depth, scratch.tried[k, 1]
            answer.triangle[i] = seed
            scratch.upper[m] = min(scratch.upper[m], np.float32(np.sqrt(square)) * GROWN)
    return seed
