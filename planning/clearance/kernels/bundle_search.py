"""The exact distances of a bundle of axes from the blocks that it may come near to.

Pairs of an axis and a block are filtered in float32 (`_test_block`), the triangles that are left measured in float64
(`_try_all`). Each step goes through all pairs before the next begins, so that no pair waits for another's result; only
between the steps do the upper bounds fall.
"""

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.bounds import HUGE, ZERO, correct_for_ends, disc_bounds, line_distances
from puncture_twin.planning.clearance.kernels.lanes import LANES, lanes_at_most, least_of, lowest_bit
from puncture_twin.planning.clearance.kernels.side_by_side import (
    PAIRS,
    bring_into_frame,
    measure_lateral,
    measure_marked,
)

ROUNDING = np.float32(4e-6)
"""Fraction of its corners' distance from the line by which a float32 distance may err
(docs/concepts/fast-search.md)."""
AREA_ROUNDING = np.float32(2e-6)
"""Fraction of that distance's square by which a float32 edge function may err."""
SINGLE_CHORD = np.float32(2e-7)
"""Chord of one direction: what float32 takes from a unit vector."""
ROUNDED_UP = np.float32(1 + 1e-6)
"""Factor that raises a number by more than float32 takes from a root and a product."""
LEAST_SLOPE = np.float32(0.05)
"""Cosine between an axis and a disc's normal below which the depth of their intersection is not bounded by the slab."""
AREA_SLACKS = np.float32(3)
"""Slacks, times the distance from the line, that an edge function may err by (docs/concepts/fast-search.md)."""
OFFSET_SLACKS = np.float32(4)
"""Slacks that a sum of products of coordinates is allowed to err by: a plane's offset c.n, or a corner's distance."""


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def measure_bundle(surface, needle, count, low, high, lanes, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure a bundle's axes from the collected blocks: each from the most promising, then from those still nearer.

    Args:
        surface: `Blocks.triangles` and ``local``.
        count: How many blocks were collected; their nodes are in ``scratch.chosen``.
        lanes: `LANES`, as an argument: a constant would be unrolled to scalar code.
        answer: `SearchOutput`; rows ``low`` to ``high`` are lowered.

    Returns:
        The row of a triangle that is nearest to one of the axes: the next bundle begins with its distance.
    """
    groups = (count + LANES - 1) // LANES
    waiting, m, group = _most_promising(needle, groups, low, high, scratch, answer), np.int64(0), np.int64(0)
    while waiting > 0 or m < high - low:
        seed = _measure_pairs(surface, needle, low, waiting, lanes, scratch, answer, seed)
        waiting = np.int64(0)
        while m < high - low and waiting <= PAIRS - LANES:  # one more group adds 16 pairs at most
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
    """Unit vectors e and f that complete the direction of a bundle's member to a frame."""
    return (frames[3, m], frames[4, m], frames[5, m]), (frames[6, m], frames[7, m], frames[8, m])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _most_promising(needle, groups, low, high, scratch, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Bound all collected blocks for all axes, and pair each axis with the block of the least bound; how many pairs."""
    waiting = 0
    for m in range(high - low):
        u, best, least = direction(scratch.frames32, m), 0, HUGE
        length = np.float32(needle.length[low + m])
        for group in range(groups):
            row = m * groups + group
            disc_bounds(scratch.chosen, group, u, SINGLE_CHORD, length, needle.slack, scratch.bounds, row)
            bound = least_of(scratch.bounds, row)
            best, least = row if bound < least else best, bound if bound < least else least
        if least <= scratch.upper[m]:
            lane = lowest_bit(lanes_at_most(scratch.bounds, best, least))
            scratch.bounds[best, lane] = HUGE  # `_others` must not pair it again
            scratch.pairs[waiting, 0], scratch.pairs[waiting, 1] = m, (best - m * groups) * LANES + lane
            waiting += 1
    answer.counts[3] += high - low
    answer.counts[4] += groups * (high - low)
    return waiting


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _others(needle, groups, m, group, low, waiting, scratch, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Pair an axis with the blocks of a group that may still be nearer, or intersected at a lesser depth; how many."""
    bits = lanes_at_most(scratch.bounds, m * groups + group, scratch.upper[m])
    while bits != 0:
        lane = lowest_bit(bits)
        bits &= bits - 1
        scratch.pairs[waiting, 0], scratch.pairs[waiting, 1] = m, group * LANES + lane
        waiting += 1
        if answer.square[low + m] == 0.0:  # it intersects the surface: only an earlier intersection counts now
            contact_from = _contact_from(scratch.chosen, group, lane, direction(scratch.frames32, m), needle.slack)
            waiting -= 1 if contact_from > np.float32(answer.depth[low + m]) * ROUNDED_UP else 0
    return waiting


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _contact_from(chosen, group, lane, u, slack):  # type: ignore[no-untyped-def]  # numba infers
    """Depth before which an axis cannot intersect what a disc holds: where it enters the disc's sphere and slab, mm.

    sphere: s >= c.u - R        slab |(p - c).n| <= h: s >= (c.n -+ h) / (n.u)        (docs/concepts/fast-search.md)
    """
    center = (chosen[group, 0, lane], chosen[group, 1, lane], chosen[group, 2, lane])
    normal = (chosen[group, 3, lane], chosen[group, 4, lane], chosen[group, 5, lane])
    h, slope = chosen[group, 7, lane] + slack, _dot(normal, u)
    enters = (_dot(center, normal) - (h if slope > ZERO else -h)) / slope if abs(slope) > LEAST_SLOPE else ZERO
    return max(_dot(center, u) - chosen[group, 8, lane] - slack, enters - OFFSET_SLACKS * slack / LEAST_SLOPE)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _measure_pairs(surface, needle, low, waiting, lanes, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure pairs of an axis and a block; row of a triangle that is nearer than before, or ``seed``.

    In the first of two rounds, of each block the triangle that is nearest in float32; in the second, those that float32
    cannot tell from the nearest distance now known.
    """
    answer.counts[5] += waiting
    for p in range(waiting):
        _test_block(surface[1], needle, low, p, lanes, scratch)
    for iteration in range(2):
        count = np.int64(0)
        for p in range(waiting):
            m, first = scratch.pairs[p, 0], scratch.blocks[scratch.pairs[p, 1]] * LANES
            reach = (scratch.upper[m] + scratch.errors[p]) * (scratch.upper[m] + scratch.errors[p]) * ROUNDED_UP
            limit = reach if iteration == 1 or reach < scratch.least[p] else scratch.least[p]
            bits = lanes_at_most(scratch.squares, p, limit)
            while bits != 0:
                lane = lowest_bit(bits)
                bits &= bits - 1
                scratch.squares[p, lane] = HUGE  # each triangle once
                scratch.tried[count, 0], scratch.tried[count, 1] = m, first + lane
                count += 1
        seed = _try_all(surface[0], needle, low, count, scratch, answer, seed)
    return seed


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _test_block(local, needle, low, p, lanes, scratch):  # type: ignore[no-untyped-def]  # numba infers
    """Fill the float32 squared distances of a pair's axis from its block's triangles, the least, and their error."""
    m, slot, slack = scratch.pairs[p, 0], scratch.pairs[p, 1], needle.slack
    group, at, block = slot // LANES, slot % LANES, scratch.blocks[slot]
    u, (e, f) = direction(scratch.frames32, m), across(scratch.frames32, m)
    center = (scratch.chosen[group, 0, at], scratch.chosen[group, 1, at], scratch.chosen[group, 2, at])
    radius, x, y, along = scratch.chosen[group, 8, at], _dot(center, e), _dot(center, f), _dot(center, u)
    around = np.sqrt(x * x + y * y) + radius
    tolerance = -around * (AREA_ROUNDING * around + AREA_SLACKS * slack)
    line_distances(local, block, e, f, x, y, tolerance, scratch.squares, p)
    length = np.float32(needle.length[low + m])
    if along + radius > length or along < radius:  # the block may reach beyond an end of the axis
        near = slack + ROUNDING * (abs(along) + radius)
        correct_for_ends(local, block, lanes, u, along, length, near, scratch.squares, p)
    scratch.least[p], scratch.errors[p] = least_of(scratch.squares, p), ROUNDING * around + slack


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _try_all(triangles, needle, low, count, scratch, answer, seed):  # type: ignore[no-untyped-def]  # numba infers
    """Measure axes from triangles in float64; row of one that is nearer than before, or ``seed``.

    The least distance is the answer; of equal ones that at the least depth.
    """
    corners = scratch.corners
    for k in range(count):
        m, (e, f) = scratch.tried[k, 0], across(scratch.frames, scratch.tried[k, 0])
        bring_into_frame(direction(scratch.frames, m), e, f, triangles, scratch.tried[k, 1], needle.target, corners, k)
        corners[11, k] = needle.length[low + m]
    measure_lateral(corners, count)
    answer.counts[6] += count
    for k in range(count):
        m, square, depth = scratch.tried[k, 0], corners[9, k], corners[10, k]
        if square < 0.0:  # `UNDECIDED` or `BEYOND`
            square, depth = measure_marked(corners, k)
        i = low + m
        if square < answer.square[i] or (square == answer.square[i] and depth < answer.depth[i]):
            answer.square[i], answer.depth[i], seed = square, depth, scratch.tried[k, 1]
            answer.triangle[i] = seed
            scratch.upper[m] = min(scratch.upper[m], np.float32(np.sqrt(square)) * ROUNDED_UP)
    return seed
