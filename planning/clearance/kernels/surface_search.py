"""The search of one structure: bundles of directions against the packed surface, exact distances out.

For each bundle: an upper bound for every member, a walk down the tree that collects the blocks whose lower bound does
not exceed the worst of them (branch and bound), and `measure_bundle`, which measures these blocks.
"""

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.bounds import ZERO, disc_bounds, tighten_upper_bounds
from puncture_twin.planning.clearance.kernels.bundle_search import OFFSET_SLACKS, ROUNDED_UP, direction, measure_bundle
from puncture_twin.planning.clearance.kernels.lanes import LANES, bare, lanes_at_most, lowest_bit
from puncture_twin.planning.clearance.kernels.side_by_side import (
    CACHE_PADDING,
    NODE_ROWS,
    PAIR_ROWS,
    PAIRS,
    NeedleAxes,
    Scratch,
    SearchOutput,
)

FILLER_RADIUS_MM = np.float32(-1e6)
"""Radius of the lanes that only fill up the last group of blocks: `disc_bounds` takes them as behind the target, mm."""
STACK = 512
"""Groups of nodes still to visit: at most 16 for each of a tree's levels, and 2^31 triangles have 8 levels."""
COUNTED = ("bundles", "nodes", "blocks found", "axes", "filters", "block tests", "triangle tests")
"""What `search_bundles` counts: how often it does each of its steps; a node and a filter are 16 discs."""


def scratch_for(groups: int) -> Scratch:
    """Scratch arrays for bundles that may have to test all of ``groups`` groups of blocks."""
    size = groups + 1
    return Scratch(
        blocks=np.empty(size * LANES, np.int64),
        chosen=np.empty((size, NODE_ROWS, LANES), np.float32),
        bounds=np.empty((size * LANES, LANES), np.float32),
        stack=np.empty((STACK, 2), np.int64),
        frames=np.empty((9, LANES)),
        frames32=np.empty((9, LANES), np.float32),
        upper=np.empty(LANES, np.float32),
        pairs=np.empty((PAIRS, 2), np.int64),
        squares=np.empty((PAIRS, LANES), np.float32),
        least=np.empty(PAIRS, np.float32),
        errors=np.empty(PAIRS, np.float32),
        tried=np.empty((PAIRS * LANES, 2), np.int64),
        corners=np.empty((PAIR_ROWS, PAIRS * LANES + CACHE_PADDING)),
    )


@nb.njit(cache=True, nogil=True, error_model="numpy")
def search_bundles(  # type: ignore[no-untyped-def]  # numba infers
    surface, all_nodes, slack, origin, lengths, at_target, nearest, bundles, scratch, output, lanes
):
    """Find distance and depth of every axis from one structure.

    Args:
        surface: `Blocks.triangles`, ``local`` and ``base``.
        slack: Rounding of a node's coordinate, mm.
        origin: Shape (3,), the target, where the axes start, mm.
        lengths: Shape (n,), of the axes, in the bundles' order, mm.
        at_target: Distance of the target itself from the surface, mm: an upper bound of every axis' distance.
        nearest: Row of the triangle that is nearest to the target.
        bundles: `Bundles.outward`, ``starts``, ``middle`` and ``chord``.
        output: `SearchOutput`, written in the bundles' order; the counts are raised.
        lanes: `LANES`, as an argument: a constant would be unrolled to scalar code.
    """
    triangles, local, base = bare(surface[0]), bare(surface[1]), bare(surface[2])
    outward, starts, middle, chords = bare(bundles[0]), bare(bundles[1]), bare(bundles[2]), bare(bundles[3])
    nodes, work, answer = bare(all_nodes), _bare_scratch(scratch), _bare_output(output)  # the same arrays
    target, seed = (origin[0], origin[1], origin[2]), nearest
    length = bare(lengths)
    for bundle in range(len(middle)):
        low, high = starts[bundle], starts[bundle + 1]
        shortest, longest = length[low], length[low]
        for i in range(low + 1, high):
            shortest, longest = min(shortest, length[i]), max(longest, length[i])
        needle = NeedleAxes(target, length, np.float32(longest), np.float32(slack))
        # 1. Upper bounds: the target's distance, or that of the triangle nearest to the last bundle, a neighbour.
        _begin(outward, low, high, at_target, nearest, lanes, work, answer)
        if seed != nearest:
            corners = _corners(triangles, seed, target)
            # The shortest axis is a part of every member's axis: a distance from it bounds theirs from above.
            tighten_upper_bounds(
                work.frames32, lanes, corners, np.float32(shortest), OFFSET_SLACKS * needle.slack, work.upper
            )
        worst = ZERO
        for k in range(high - low):
            worst = max(worst, work.upper[k])
        # 2. One walk for the cone of all members, by its lower bounds; 3. the exact distances.
        axis = direction(work.frames32, middle[bundle] - low)
        count = _collect(nodes, base, axis, np.float32(chords[bundle]), needle, worst, work, answer)
        seed = nearest
        if count > 0:
            _gather(nodes, count, work)
            seed = measure_bundle((triangles, local), needle, count, low, high, lanes, work, answer, nearest)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _bare_scratch(s):  # type: ignore[no-untyped-def]  # numba infers
    return Scratch(
        bare(s.blocks), bare(s.chosen), bare(s.bounds), bare(s.stack), bare(s.frames), bare(s.frames32), bare(s.upper),
        bare(s.pairs), bare(s.squares), bare(s.least), bare(s.errors), bare(s.tried), bare(s.corners),
    )  # fmt: skip


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _bare_output(o):  # type: ignore[no-untyped-def]  # numba infers
    return SearchOutput(bare(o.square), bare(o.depth), bare(o.triangle), bare(o.counts))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _single(u):  # type: ignore[no-untyped-def]  # numba infers
    return np.float32(u[0]), np.float32(u[1]), np.float32(u[2])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _across(u):  # type: ignore[no-untyped-def]  # numba infers
    """Two unit vectors that complete u to a frame (Duff et al., J. Comput. Graph. Tech. 6, 2017, the revised frame)."""
    sign = 1.0 if u[2] >= 0.0 else -1.0
    a = -1.0 / (sign + u[2])
    b = u[0] * u[1] * a
    return (1.0 + sign * u[0] * u[0] * a, sign * b, -sign * u[0]), (b, sign + u[1] * u[1] * a, -u[1])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _begin(outward, low, high, start, nearest, lanes, work, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Set up a bundle: its members' frames and first upper bounds; unused lanes repeat the last member."""
    for i in range(low, high):
        answer.square[i], answer.depth[i], answer.triangle[i] = start * start, 0.0, nearest
    for k in range(lanes):
        i = min(low + k, high - 1)
        u = (outward[i, 0], outward[i, 1], outward[i, 2])
        e, f = _across(u)
        work.frames[0, k], work.frames[1, k], work.frames[2, k] = u
        work.frames[3, k], work.frames[4, k], work.frames[5, k] = e
        work.frames[6, k], work.frames[7, k], work.frames[8, k] = f
        work.upper[k] = np.float32(start) * ROUNDED_UP
    for row in range(9):
        for k in range(lanes):
            work.frames32[row, k] = np.float32(work.frames[row, k])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _corners(triangles, row, o):  # type: ignore[no-untyped-def]  # numba infers
    """A triangle's corners from the target, subtracted in float64 and rounded to nine float32 numbers."""
    x, y, z = o
    t = triangles[row]
    a, b, c = (t[0] - x, t[1] - y, t[2] - z), (t[3] - x, t[4] - y, t[5] - z), (t[6] - x, t[7] - y, t[8] - z)
    return _single(a) + _single(b) + _single(c)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _collect(nodes, base, axis, chord, needle, worst, work, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Collect the blocks that may be nearer than ``worst`` to some axis of a bundle; how many.

    A walk down the tree, a group of 16 nodes at a time: node j of a level has group j of the level below.
    """
    stack, bounds, top = work.stack, work.bounds, len(base) - 1
    stack[0, 0], stack[0, 1] = base[top], top
    waiting, count = 1, 0
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        disc_bounds(nodes, first, axis, chord, needle.longest, needle.slack, bounds, 0)
        answer.counts[1] += 1
        bits, above = lanes_at_most(bounds, 0, worst), (first - base[level]) * LANES
        while bits != 0:  # once for each lane that passed, no matter how many did not
            child = above + lowest_bit(bits)
            bits &= bits - 1  # clears the lowest bit
            if level == 0:
                work.blocks[count] = child
                count += 1
            else:
                stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                waiting += 1
    answer.counts[0] += 1
    answer.counts[2] += count
    return count


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _gather(nodes, count, work):  # type: ignore[no-untyped-def]  # numba infers
    """Copy the nodes of the collected blocks into whole groups; unused lanes of the last count as behind the target."""
    for k in range(count):
        group, lane = work.blocks[k] // LANES, work.blocks[k] % LANES
        for row in range(NODE_ROWS):
            work.chosen[k // LANES, row, k % LANES] = nodes[group, row, lane]
    for k in range(count, (count + LANES - 1) // LANES * LANES):
        for row in range(NODE_ROWS):
            work.chosen[k // LANES, row, k % LANES] = FILLER_RADIUS_MM if row == 8 else ZERO
