"""The search of one structure: bundles of directions against the packed surface, exact distances out."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.bounds import ZERO, disc_bounds, lower_upper_bounds
from puncture_twin.planning.clearance.kernels.bundle_search import FOUR, GROWN, direction, measure_bundle
from puncture_twin.planning.clearance.kernels.lanes import LANES, at_most, bare, lowest
from puncture_twin.planning.clearance.kernels.side_by_side import NODE_ROWS, Found, NeedleAxes, Scratch

BEHIND = np.float32(-1e6)
"""Radius of what only fills up the last group of found blocks: the disc bound takes it as behind the target, mm."""

COUNTED = ("bundles", "nodes", "blocks found", "axes", "filters", "block tests", "triangle tests")
"""What `search_tiles` counts: the times it went through each of its stages, a node and a filter being 16 discs."""


@nb.njit(cache=True, nogil=True, error_model="numpy")
def search_tiles(  # type: ignore[no-untyped-def]  # numba infers
    surface, all_nodes, slack, origin, lengths, at_target, nearest, tiles, scratch, found, lanes
):
    """Distance and depth of every axis; a structure's whole search.

    Args:
        surface: `Blocks.triangles`, ``local`` and ``base``.
        all_nodes: See `bounds.disc_bounds`, made for this target.
        slack: Rounding of a node's coordinate, mm.
        origin: Shape (3,), the target, where the axes start.
        lengths: Shape (n,), of the axes, in the tiles' order, mm.
        at_target: Distance of the target itself from the surface, mm; bounds every answer from above.
        nearest: Row of the triangle that is nearest to the target.
        tiles: `Tiles.outward`, ``starts``, ``middle`` and ``chord``.
        scratch: `Scratch`, for this structure's groups.
        found: `Found`, written in the tiles' order; the counts are raised.
        lanes: `LANES`, as an argument: a constant would be unrolled to scalar code.
    """
    triangles, local, base = bare(surface[0]), bare(surface[1]), bare(surface[2])
    outward, starts, middle, chords = bare(tiles[0]), bare(tiles[1]), bare(tiles[2]), bare(tiles[3])
    nodes, work, answer = bare(all_nodes), _bare_scratch(scratch), _bare_found(found)
    target, seed = (origin[0], origin[1], origin[2]), nearest
    length = bare(lengths)
    for tile in range(len(middle)):
        low, high = starts[tile], starts[tile + 1]
        shortest, longest = length[low], length[low]
        for i in range(low + 1, high):
            shortest, longest = min(shortest, length[i]), max(longest, length[i])
        needle = NeedleAxes(target, length, np.float32(longest), np.float32(slack))
        _begin(outward, low, high, at_target, nearest, lanes, work, answer)
        if seed != nearest:
            corners = _corners(triangles, seed, target)
            lower_upper_bounds(work.frames32, lanes, corners, np.float32(shortest), FOUR * needle.slack, work.upper)
        worst = ZERO
        for k in range(high - low):
            worst = max(worst, work.upper[k])
        axis = direction(work.frames32, middle[tile] - low)
        count = _collect(nodes, base, axis, np.float32(chords[tile]), needle, worst, work, answer)
        seed = nearest
        if count > 0:
            _gather(nodes, count, work)
            seed = measure_bundle((triangles, local), needle, count, low, high, lanes, work, answer, nearest)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _bare_scratch(s):  # type: ignore[no-untyped-def]  # numba infers
    """The scratch arrays without their reference counts."""
    return Scratch(
        bare(s.found), bare(s.chosen), bare(s.bounds), bare(s.stack), bare(s.frames), bare(s.frames32), bare(s.upper),
        bare(s.pairs), bare(s.squares), bare(s.least), bare(s.errors), bare(s.tried), bare(s.corners),
    )  # fmt: skip


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _bare_found(f):  # type: ignore[no-untyped-def]  # numba infers
    """The output arrays without their reference counts."""
    return Found(bare(f.square), bare(f.depth), bare(f.triangle), bare(f.counts))


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _single(u):  # type: ignore[no-untyped-def]  # numba infers
    """Three numbers as float32."""
    return np.float32(u[0]), np.float32(u[1]), np.float32(u[2])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _across(u):  # type: ignore[no-untyped-def]  # numba infers
    """Two unit vectors that make a frame with u (Duff et al., J. Comput. Graph. Tech. 6, 2017, the revised frame)."""
    sign = 1.0 if u[2] >= 0.0 else -1.0
    a = -1.0 / (sign + u[2])
    b = u[0] * u[1] * a
    return (1.0 + sign * u[0] * u[0] * a, sign * b, -sign * u[0]), (b, sign + u[1] * u[1] * a, -u[1])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _begin(outward, low, high, start, nearest, lanes, work, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Set up a bundle: its members' frames and the first upper bound; lanes to spare repeat the last member."""
    for i in range(low, high):
        answer.square[i], answer.depth[i], answer.triangle[i] = start * start, 0.0, nearest
    for k in range(lanes):
        i = min(low + k, high - 1)
        u = (outward[i, 0], outward[i, 1], outward[i, 2])
        e, f = _across(u)
        work.frames[0, k], work.frames[1, k], work.frames[2, k] = u
        work.frames[3, k], work.frames[4, k], work.frames[5, k] = e
        work.frames[6, k], work.frames[7, k], work.frames[8, k] = f
        work.upper[k] = np.float32(start) * GROWN
    for row in range(9):
        for k in range(lanes):
            work.frames32[row, k] = np.float32(work.frames[row, k])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _corners(triangles, row, o):  # type: ignore[no-untyped-def]  # numba infers
    """A triangle's corners from the target, nine float32 numbers."""
    x, y, z = o
    t = triangles[row]
    a, b, c = (t[0] - x, t[1] - y, t[2] - z), (t[3] - x, t[4] - y, t[5] - z), (t[6] - x, t[7] - y, t[8] - z)
    return _single(a) + _single(b) + _single(c)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _collect(nodes, base, axis, chord, needle, worst, work, answer):  # type: ignore[no-untyped-def]  # numba infers
    """Walk the tree: the blocks that may be nearer than ``worst`` to some axis of a bundle."""
    stack, bounds, top = work.stack, work.bounds, len(base) - 1
    stack[0, 0], stack[0, 1] = base[top], top
    waiting, count = 1, 0
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        disc_bounds(nodes, first, axis, chord, needle.longest, needle.slack, bounds, 0)
        answer.counts[1] += 1
        bits, above = at_most(bounds, 0, worst), (first - base[level]) * LANES
        while bits != 0:
            child = above + lowest(bits)
            bits &= bits - 1
            if level == 0:
                work.found[count] = child
                count += 1
            else:
                stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                waiting += 1
    answer.counts[0] += 1
    answer.counts[2] += count
    return count


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _gather(nodes, count, work):  # type: ignore[no-untyped-def]  # numba infers
    """Copy the nodes of the found blocks side by side; what else the last group holds counts as behind the target."""
    for k in range(count):
        group, lane = work.found[k] // LANES, work.found[k] % LANES
        for row in range(NODE_ROWS):
            work.chosen[k // LANES, row, k % LANES] = nodes[group, row, lane]
    for k in range(count, (count + LANES - 1) // LANES * LANES):
        for row in range(NODE_ROWS):
            work.chosen[k // LANES, row, k % LANES] = BEHIND if row == 8 else ZERO
