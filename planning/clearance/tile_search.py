"""The search of one structure: bundles of directions against the packed surface, exact distances out."""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np
from numpy.typing import NDArray

from planning.clearance.bare import bare
from planning.clearance.blocks import LANES
from planning.clearance.bounds import add_beyond, disc_bounds, line_distances
from planning.clearance.segment_triangle import axis_triangle_beside

STACK = 512
"""Groups of nodes that wait: at most 16 for each of a tree's levels, and 2^31 triangles have 8 levels."""

ROUNDING = 4e-6
"""Share of its corners' distance from the line by which a float32 distance may err (docs/fast-search.md)."""

AREA_ROUNDING = 2e-6
"""Share of that distance's square by which a float32 edge function may err."""

NODE_ROWS = 10

SINGLE = np.float32(2e-7)
"""Chord of one direction: what float32 takes from a unit vector."""


def scratch_for(groups: int) -> tuple[NDArray[Any], ...]:
    """Room for the blocks that one bundle may have to look at: in the worst case all of ``groups`` groups of them."""
    room = groups + 1
    bounds = np.empty((room, LANES), np.float32)
    found, radii = np.empty(room * LANES, np.int64), np.empty(room * LANES, np.float32)
    chosen, stack = np.empty((room, NODE_ROWS, LANES), np.float32), np.empty((STACK, 2), np.int64)
    return found, bounds, bounds.reshape(-1), chosen, radii, stack, np.empty(LANES, np.float32)


@nb.njit(cache=True, error_model="numpy")
def search_tiles(  # type: ignore[no-untyped-def]  # numba infers
    surface,
    all_nodes,
    slack,
    origin,
    length,
    at_target,
    nearest,
    cap,
    enough,
    tiles,
    scratch,
    lanes,
    squares_out,
    depth_out,
):
    """Distance and depth of every axis; a structure's whole search.

    Args:
        surface: `Blocks.triangles`, ``local``, ``base`` and ``center``.
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
    """
    triangles, local, base, center = surface
    triangles, local = bare(triangles), bare(local)  # type: ignore[call-arg]  # numba gives the first argument
    base, center = bare(base), bare(center)
    outward, starts, middle, chords = tiles
    outward, starts, middle, chords = bare(outward), bare(starts), bare(middle), bare(chords)
    nodes, distance, depth = bare(all_nodes), bare(squares_out), bare(depth_out)
    target = (origin[0], origin[1], origin[2])
    found, bounds, flat, chosen, radii, stack, squares = scratch
    found, bounds, flat, chosen = bare(found), bare(bounds), bare(flat), bare(chosen)
    radii, stack, squares = bare(radii), bare(stack), bare(squares)
    seed, start, enough2 = nearest, min(at_target, cap) ** 2, enough * abs(enough)
    short, slack32 = np.float32(length), np.float32(slack)
    for tile in range(len(middle)):
        low, high, axis = starts[tile], starts[tile + 1], middle[tile]
        worst, tried = 0.0, seed
        for i in range(low, high):
            distance[i], depth[i] = start, 0.0
            if seed != nearest:
                u = (outward[i, 0], outward[i, 1], outward[i, 2])
                e, f = _across(u)
                _try(triangles, seed, target, length, u, e, f, i, distance, depth)
            worst = max(worst, distance[i])
        count = _collect(
            nodes,
            base,
            _single((outward[axis, 0], outward[axis, 1], outward[axis, 2])),
            np.float32(chords[tile]),
            short,
            slack32,
            worst,
            lanes,
            bounds,
            stack,
            found,
        )
        if count == 0:
            seed = nearest
            continue
        _gather(nodes, found, count, chosen, radii)
        for turn in range(low - 1, high):
            i = axis if turn < low else turn
            if turn == axis or distance[i] < enough2:
                continue
            seed = _one_axis(
                triangles, local, center, chosen, radii, found, count, slack32, target, length, enough2, tried,
                outward, i, lanes, bounds, flat, squares, seed, distance, depth,
            )  # fmt: skip


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
def _collect(nodes, base, axis, chord, length, slack, worst, lanes, bounds, stack, found):  # type: ignore[no-untyped-def]  # numba infers
    """Walk the tree: the blocks that may be nearer than ``worst`` to some axis of a bundle."""
    top = len(base) - 1
    stack[0, 0], stack[0, 1] = base[top], top
    waiting, count, limit = 1, 0, np.float32(np.sqrt(worst) * 1.000001)
    while waiting > 0:
        waiting -= 1
        first, level = stack[waiting, 0], stack[waiting, 1]
        disc_bounds(nodes, first, lanes, axis, chord, length, slack, bounds, 0)
        for k in range(lanes):
            if bounds[0, k] <= limit:
                child = (first - base[level]) * LANES + k
                if level == 0:
                    found[count] = child
                    count += 1
                else:
                    stack[waiting, 0], stack[waiting, 1] = base[level - 1] + child, level - 1
                    waiting += 1
    return count


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _gather(nodes, found, count, chosen, radii):  # type: ignore[no-untyped-def]  # numba infers
    """Copy the nodes of the found blocks side by side; what else the last group holds is never read."""
    for k in range(count):
        group, lane = found[k] // LANES, found[k] % LANES
        radii[k] = nodes[group, 8, lane]
        for row in range(NODE_ROWS):
            chosen[k // LANES, row, k % LANES] = nodes[group, row, lane]


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _one_axis(  # type: ignore[no-untyped-def]  # numba infers
    triangles, local, center, chosen, radii, found, count, slack, target, length, enough2, tried,
    outward, i, lanes, bounds, flat, squares, seed, distance, depth,
):  # fmt: skip
    """Measure one axis from the found blocks, the most promising first; row of the nearest triangle."""
    u = (outward[i, 0], outward[i, 1], outward[i, 2])
    e, f = _across(u)
    if seed != tried:
        _try(triangles, seed, target, length, u, e, f, i, distance, depth)
    u32, short = _single(u), np.float32(length)
    first, least = -1, np.float32(np.sqrt(distance[i]) * 1.000001)
    for group in range((count + LANES - 1) // LANES):
        disc_bounds(chosen, group, lanes, u32, SINGLE, short, slack, bounds, group)
    for k in range(count):
        if flat[k] <= least:
            first, least = k, flat[k]
    if first < 0:
        return seed
    least = np.float32(np.sqrt(distance[i]) * 1.000001)
    for k in range(-1, count):
        j = first if k < 0 else k
        if k == first or flat[j] > least:
            continue
        seed = _one_block(
            triangles, local, center, found[j], radii[j], target, length, u, i, e, f, lanes,
            squares, seed, distance, depth,
        )  # fmt: skip
        if distance[i] < enough2:
            break
        least = np.float32(np.sqrt(distance[i]) * 1.000001)
    return seed


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _across(u):  # type: ignore[no-untyped-def]  # numba infers
    """Two unit vectors that make a frame with u (Duff et al., J. Comput. Graph. Tech. 6, 2017, the revised frame)."""
    sign = 1.0 if u[2] >= 0.0 else -1.0
    a = -1.0 / (sign + u[2])
    b = u[0] * u[1] * a
    return (1.0 + sign * u[0] * u[0] * a, sign * b, -sign * u[0]), (b, sign + u[1] * u[1] * a, -u[1])


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _one_block(  # type: ignore[no-untyped-def]  # numba infers
    triangles, local, center, block, radius, target, length, u, i, e, f, lanes, squares, seed, distance, depth,
):  # fmt: skip
    """Measure one axis from one block: float32 sorts out, float64 measures the rest; row of the nearest."""
    cx, cy, cz = center[block, 0] - target[0], center[block, 1] - target[1], center[block, 2] - target[2]
    x = cx * e[0] + cy * e[1] + cz * e[2]
    y = cx * f[0] + cy * f[1] + cz * f[2]
    around = np.sqrt(x * x + y * y) + radius
    tolerance, error = np.float32(-AREA_ROUNDING * around * around), ROUNDING * around
    limit = np.float32((np.sqrt(distance[i]) + error) ** 2 * 1.000001)
    left = line_distances(
        local, block, lanes, _single(e), _single(f), np.float32(x), np.float32(y), tolerance, limit, squares
    )
    if left == 0.0:
        return seed
    over = cx * u[0] + cy * u[1] + cz * u[2] - length
    if over + radius > 0.0:
        slack = np.float32(ROUNDING * (abs(over) + radius))
        add_beyond(local, block, lanes, _single(u), np.float32(over), slack, squares)
    first = 0
    for k in range(1, lanes):
        if squares[k] < squares[first]:
            first = k
    for k in range(-1, lanes):
        lane = first if k < 0 else k
        if k == first or squares[lane] > limit:
            continue
        if _try(triangles, block * LANES + lane, target, length, u, e, f, i, distance, depth):
            seed = block * LANES + lane
            limit = np.float32((np.sqrt(distance[i]) + error) ** 2 * 1.000001)
        if left == 1.0:
            break
    return seed
