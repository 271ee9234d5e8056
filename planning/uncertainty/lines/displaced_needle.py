"""A displaced needle: its displacement, how near it comes, and how fast that can change along a line."""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distance

FARTHEST = 5.0
"""Standard deviations that a line is walked to either side; a stretch that is open there goes on for ever."""


@nb.njit(cache=True, error_model="numpy")
def displacement(root, z):  # type: ignore[no-untyped-def]
    """Shift, lean and the surface's normal, shape (7,)."""
    found = np.zeros(7)
    for row in range(6):
        for k in range(5):
            found[row] += root[row, k] * z[k]
    found[6] = z[5]
    return found


@nb.njit(cache=True, error_model="numpy")
def next_step(clear, before, stepped, smallest):  # type: ignore[no-untyped-def]
    """How far on, where nothing is nearer than ``clear``: as far as what is clear there will reach back, it seems."""
    if clear < smallest:
        return smallest
    falls = min(max((before - clear) / stepped, -0.8), 1.0) if before > 0.0 else 1.0
    return 2.0 * clear / (1.0 + falls)


@nb.njit(cache=True, error_model="numpy")
def outran(clear_to, beta, clear, smallest):  # type: ignore[no-untyped-def]
    """Whether something may have been passed between what was clear before a step and what is clear after it."""
    return beta - clear_to > smallest and beta - max(clear, 0.0) > clear_to


@nb.njit(cache=True, error_model="numpy")
def fastest_approach(scene, start, ahead):  # type: ignore[no-untyped-def]
    """The most by which the distance can fall per standard deviation: an end of the axis is its fastest point."""
    outward, length, surface_mm = scene[4], scene[5], scene[7]
    ux, uy, uz = outward[0], outward[1], outward[2]
    dx, dy, dz, px, py, pz = ahead[0], ahead[1], ahead[2], ahead[3], ahead[4], ahead[5]
    at_tip = dx * dx + dy * dy + dz * dz
    x, y = dx + length * (py * uz - pz * uy), dy + length * (pz * ux - px * uz)
    z = dz + length * (px * uy - py * ux)
    turn = math.sqrt(px * px + py * py + pz * pz)
    lean = math.sqrt(start[3] ** 2 + start[4] ** 2 + start[5] ** 2) + FARTHEST * turn
    fastest = math.sqrt(max(at_tip, x * x + y * y + z * z)) + length * lean * turn
    return fastest + surface_mm * abs(ahead[6]) + 1e-12


@nb.njit(cache=True, error_model="numpy")
def gap_beyond(scene, start, ahead, beta, hint):  # type: ignore[no-untyped-def]
    """Distance of the displaced needle beyond its threshold, mm; negative where it touches."""
    triangles, faces, blocks, origin, outward, length, threshold, surface_mm = scene
    ux, uy, uz = outward[0], outward[1], outward[2]
    px, py, pz = start[3] + beta * ahead[3], start[4] + beta * ahead[4], start[5] + beta * ahead[5]
    turn = math.sqrt(px * px + py * py + pz * pz)
    sine, cosine = (math.sin(turn) / turn if turn > 1e-12 else 1.0), math.cos(turn)
    along = (
        cosine * ux + sine * (py * uz - pz * uy),
        cosine * uy + sine * (pz * ux - px * uz),
        cosine * uz + sine * (px * uy - py * ux),
    )
    tip = (
        origin[0] + start[0] + beta * ahead[0],
        origin[1] + start[1] + beta * ahead[1],
        origin[2] + start[2] + beta * ahead[2],
    )
    enough = max(threshold - surface_mm * (start[6] + beta * ahead[6]), 0.0)  # a surface that is met is touched
    distance, nearest = displaced_distance(triangles, faces, blocks, tip, along, length, enough, hint)
    return (-1.0 if distance == 0.0 else distance - enough), nearest
