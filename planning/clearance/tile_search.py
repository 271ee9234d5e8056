"""The search of one structure: bundles of directions against the packed surface, exact distances out."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from planning.clearance.bare import bare
from planning.clearance.blocks import LANES
from planning.clearance.bounds import HUGE, ZERO, add_beyond, disc_bounds, line_distances, lower_upper_bounds
from planning.clearance.segment_triangle import axis_triangle_beside

STACK = 512
"""Groups of nodes that wait: at most 16 for each of a tree's levels, and 2^31 triangles have 8 levels."""

ROUNDING = np.float32(4e-6)
"""Share of its corners' distance from the line by which a float32 distance may err (docs/fast-search.md)."""

AREA_ROUNDING = np.float32(2e-6)
"""Share of that distance's square by which a float32 edge function may err."""

NODE_ROWS = 10

SINGLE = np.float32(2e-7)
"""Chord of one direction: what float32 takes from a unit vector."""

GROWN = np.float32(1 + 1e-6)
"""More than float32 takes from a root and a product."""

THREE, FOUR = np.float32(3), np.float32(4)

COUNTED = ("bundles", "nodes", "blocks found", "axes", "filters", "block tests", "triangle tests")
"""What `search_tiles` counts: the times it went through each of its stages, a node and a filter being 16 discs."""


def scratch_for(groups: int) -> tuple[NDArray[Any], ...]:
    """Room for the blocks that one bundle may have to look at: in the worst case all of ``groups`` groups of them."""
    room = groups + 1
    bounds = np.empty((room, LANES), np.float32)
    found, listed = np.empty(room * LANES, np.int64), np.empty(room * LANES, np.int64)
    chosen, stack = np.empty((room, NODE_ROWS, LANES), np.float32), np.empty((STACK, 2), np.int64)
    upper, squares, lanes = np.empty(LANES, np.float32), np.empty(LANES, np.float32), np.empty(LANES, np.int64)
    frames, frames32 = np.empty((9, LANES)), np.empty((9, LANES), np.float32)
    return found, bounds, listed, chosen, stack, upper, squares, lanes, frames, frames32


@nb.njit(cache=True, error_model="numpy")
def search_tiles(  # type: ignore[no-untyped-def]  # numba infers
    surface, all_nodes, slack, origin, length, at_target, nearest, cap, enough, tiles, scratch, lanes,
    squares_out, depth_out, counts,
):  # fmt: skip
    """Distance and depth of every axis; a structure's whole search.

    Args:
        surface: `Blocks.triangles`, ``local`` and ``base``.
        all_nodes: See `bounds.disc_bounds`, made for this target.
        slack: Rounding of a node's coordinate, mm.
        origin: Shape (3,), the target, where the axes start.
        length: Of the axes, mm.
        at_target: Distance of the target itself from the surface, mm; bounds every answer from above.
        nearest: Row of the triangle that is nearest to the target.
        cap: Distances at or beyond need not be found: they are given as ``cap``, mm.
        enough: An axis nearer than this need not be measured further, mm; negative to measure all.
        tiles: `Tiles.outward`, ``starts``, ``middle`` and ``chord``.
        scratch: See `scratch_for`.
        lanes: `LANES`.
        squares_out: Shape (n,), squared distances in the tiles' order, written.
        depth_out: Shape (n,), depths likewise.
        counts: Shape (7,), raised, see `COUNTED`.
    """
    triangles, local, base = surface
    triangles, local, base = bare(triangles), bare(local), bare(base)  # type: ignore[call-arg]  # numba gives the first
    outward, starts, middle, chords = tiles
    outward, starts, middle, chords = bare(outward), bare(starts), bare(middle), bare(chords)
    nodes, distance, depth, done = bare(all_nodes), bare(squares_out), bare(depth_out), bare(counts)
    target = (origin[0], origin[1], origin[2])
    found, bounds, listed, chosen, stack, upper, squares, close, frames, frames32 = scratch
    found, bounds, listed, chosen, stack = bare(found), bare(bounds), bare(listed), bare(chosen), bare(stack)
    upper, squares, close, frames, frames32 = bare(upper), bare(squares), bare(close), bare(frames), bare(frames32)
    seed, start = nearest, min(at_target, cap)
    room = (found, bounds, listed, chosen, upper, squares, close, frames, frames32, distance, depth, done)
    needle = (target, length, np.float32(length), np.float32(slack), np.float32(enough))
    for tile in range(len(middle)):
        low, high, axis = starts[tile], starts[tile + 1], middle[tile]
        _begin(outward, low, high, start, lanes, frames, frames32, upper, distance, depth)
        if seed != nearest:
            lower_upper_bounds(frames32, lanes, _corners(triangles, seed, target), needle[2], FOUR * needle[3], upper)
        worst = ZERO
        for k in range(high - low):
            worst = max(worst, upper[k])
        u = _column(frames32, axis - low)[0]
        count = _collect(
            nodes, base, u, np.float32(chords[tile]), needle[2], needle[3], worst, lanes, bounds, stack, found, done
        )
        seed = nearest
        if count == 0:
            continue
        _gather(nodes, found, count, chosen)
        for turn in range(low - 1, high):
            i = axis if turn < low else turn
            if turn == axis:
                continue
            got = _one_axis(triangles, local, needle, count, i, i - low, lanes, room)
            seed = got if got >= 0 else seed
            if turn < low and got >= 0:
                corners = _corners(triangles, seed, target)
                lower_upper_bounds(frames32, lanes, corners, needle[2], FOUR * needle[3], upper)


@nb.njit(cache=True, error_model="numpy")
def nearest_triangle(triangles, nodes, base, target, slack, lanes):  # type: ignore[no-untyped-def]  # numba infers
    """Distance of the target from a surface, mm, and the row of the nearest triangle: an axis of length 0."""
    distance, depth = np.full(1, np.inf), np.zeros(1)
    nearest, waiting = 0, 1
    _try_point(triangles, 0, target, distance, depth)
    stack = np.empty((STACK, 2), np.int64)
    stack[0, 0], stack[0, 1] = base[-1], len(base) - 1
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        for k in range(lanes):
            reach = nodes[first, 9, k] - 2 * nodes[first, 8, k]
            if reach - slack - 1e-5 * abs(reach) >= distance[0]:
                continue
            child = (first - base[level]) * LANES + k
            if level > 0:
                stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                waiting += 1
                continue
            for row in range(child * lanes, (child + 1) * lanes):
                if _try_point(triangles, row, target, distance, depth):
                    nearest = row
    return distance[0], nearest


@nb.njit(cache=True, error_model="numpy")
def _try_point(triangles, row, target, distance, depth):  # type: ignore[no-untyped-def]  # numba infers
    """Measure the target itself from one triangle; whether that is nearer than what was found so far."""
    square, _ = axis_triangle_beside(
        (0.0, 0.0, 1.0), (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), 0.0, triangles, row, (target[0], target[1], target[2])
    )
    if np.sqrt(square) >= distance[0]:
        return False
    distance[0], depth[0] = np.sqrt(square), 0.0
    return True


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _try(triangles, row, target, length, u, e, f, i, distance, depth):  # type: ignore[no-untyped-def]  # numba infers
    """Measure one axis from one triangle; keep what is nearer, and of equals what comes first. Whether it was kept."""
    square, at = axis_triangle_beside(u, e, f, length, triangles, row, target)
    if square < distance[i] or (square == distance[i] and at < depth[i]):
        distance[i], depth[i] = square, at
        return True
    return False


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
def _begin(outward, low, high, start, lanes, frames, frames32, upper, distance, depth):  # type: ignore[no-untyped-def]  # numba infers
    """Set up a bundle: its members' frames and the first upper bound; lanes to spare repeat the last member."""
    for i in range(low, high):
        distance[i], depth[i] = start * start, 0.0
    for k in range(lanes):
        i = min(low + k, high - 1)
        u = (outward[i, 0], outward[i, 1], outward[i, 2])
        e, f = _across(u)
        frames[0, k], frames[1, k], frames[2, k] = u
        frames[3, k], frames[4, k], frames[5, k] = e
        frames[6, k], frames[7, k], frames[8, k] = f
        upper[k] = np.float32(start) * GROWN
    for row in range(9):
        for k in range(lanes):
            frames32[row, k] = np.float32(frames[row, k])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _corners(triangles, row, o):  # type: ignore[no-untyped-def]  # numba infers
    """A triangle's corners from the target, nine float32 numbers."""
    x, y, z = o
    t = triangles[row]
    a, b, c = (t[0] - x, t[1] - y, t[2] - z), (t[3] - x, t[4] - y, t[5] - z), (t[6] - x, t[7] - y, t[8] - z)
    return _single(a) + _single(b) + _single(c)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _column(frames, k):  # type: ignore[no-untyped-def]  # numba infers
    """Direction u of a bundle's member, and e and f."""
    u, e = (frames[0, k], frames[1, k], frames[2, k]), (frames[3, k], frames[4, k], frames[5, k])
    return u, e, (frames[6, k], frames[7, k], frames[8, k])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _collect(nodes, base, axis, chord, length, slack, worst, lanes, bounds, stack, found, done):  # type: ignore[no-untyped-def]  # numba infers
    """Walk the tree: the blocks that may be nearer than ``worst`` to some axis of a bundle."""
    top = len(base) - 1
    stack[0, 0], stack[0, 1] = base[top], top
    waiting, count = 1, 0
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        disc_bounds(nodes, first, lanes, axis, chord, length, slack, bounds, 0)
        done[1] += 1
        for k in range(lanes):
            if bounds[0, k] <= worst:
                child = (first - base[level]) * LANES + k
                if level == 0:
                    found[count] = child
                    count += 1
                else:
                    stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                    waiting += 1
    done[0] += 1
    done[2] += count
    return count


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _gather(nodes, found, count, chosen):  # type: ignore[no-untyped-def]  # numba infers
    """Copy the nodes of the found blocks side by side; what else the last group holds is never read."""
    for k in range(count):
        group, lane = found[k] // LANES, found[k] % LANES
        for row in range(NODE_ROWS):
            chosen[k // LANES, row, k % LANES] = nodes[group, row, lane]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _one_axis(triangles, local, needle, count, i, lane, lanes, room):  # type: ignore[no-untyped-def]  # numba infers
    """Measure one axis from the found blocks, the most promising first; row of the nearest triangle, -1 for none."""
    found, bounds, listed, chosen, upper, _, _, _, frames32, distance, depth, done = room
    short, slack, enough = needle[2], needle[3], needle[4]
    limit, nearest, until = upper[lane], -1, HUGE
    if limit < enough:
        distance[i] = limit * limit
        return nearest
    u, e, f = _column(frames32, lane)
    kept, best, least = 0, 0, HUGE
    for group in range((count + LANES - 1) // LANES):
        disc_bounds(chosen, group, lanes, u, SINGLE, short, slack, bounds, group)
        for k in range(min(lanes, count - group * LANES)):
            bound = bounds[group, k]
            listed[kept] = group * LANES + k
            best, least = kept if bound < least else best, bound if bound < least else least
            kept += 1 if bound <= limit else 0
    done[3] += 1
    done[4] += (count + LANES - 1) // LANES
    if kept == 0:
        return nearest
    listed[0], listed[best] = listed[best], listed[0]
    for turn in range(kept):
        group, at = listed[turn] // LANES, listed[turn] % LANES
        if bounds[group, at] > limit:
            continue
        center = (chosen[group, 0, at], chosen[group, 1, at], chosen[group, 2, at])
        radius, along = chosen[group, 8, at], _dot(center, u)
        if along - radius > until:
            continue
        row = _one_block(
            triangles, local, found[listed[turn]], center, radius, along, needle, limit, i, lane, lanes, u, e, f, room
        )
        if row < 0:
            continue
        nearest, limit = row, min(limit, np.float32(np.sqrt(distance[i])) * GROWN)
        if limit < enough:
            break
        until = np.float32(depth[i]) * GROWN + slack if distance[i] == 0.0 else HUGE
    return nearest


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _dot(p, q):  # type: ignore[no-untyped-def]  # numba infers
    """Inner product of two vectors of three."""
    return p[0] * q[0] + p[1] * q[1] + p[2] * q[2]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _one_block(triangles, local, block, center, radius, along, needle, limit, i, lane, lanes, u, e, f, room):  # type: ignore[no-untyped-def]  # numba infers
    """Measure one axis from one block: float32 sorts out, float64 measures the rest; row of what is nearer, or -1."""
    _, _, _, _, _, squares, close, frames, _, distance, depth, done = room
    target, length, short, slack, _ = needle
    x, y = _dot(center, e), _dot(center, f)
    around = np.sqrt(x * x + y * y) + radius
    error, tolerance = ROUNDING * around + slack, -around * (AREA_ROUNDING * around + THREE * slack)
    reach = (limit + error) * (limit + error) * GROWN
    left = line_distances(local, block, lanes, e, f, x, y, tolerance, reach, squares)
    done[5] += 1
    if left == ZERO:
        return -1
    over = along - short
    if over + radius > ZERO:
        add_beyond(local, block, lanes, u, over, slack + ROUNDING * (abs(over) + radius), squares)
    count, best, least = 0, 0, HUGE
    for k in range(lanes):
        close[count] = k
        best, least = count if squares[k] < least else best, squares[k] if squares[k] < least else least
        count += 1 if squares[k] <= reach else 0
    if count == 0:
        return -1
    close[0], close[best] = close[best], close[0]
    nearest, exact = -1, _column(frames, lane)
    for k in range(count):
        if squares[close[k]] > reach:
            continue
        done[6] += 1
        row = block * LANES + close[k]
        if _try(triangles, row, target, length, exact[0], exact[1], exact[2], i, distance, depth):
            nearest = row
            reach = (np.float32(np.sqrt(distance[i])) * GROWN + error) ** 2 * GROWN
    return nearest
