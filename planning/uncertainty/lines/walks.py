"""Lines of displaced needles, walked to where they touch: the compiled inside of `line_sampling`.

A step is never longer than the needle's distance over the fastest that any of its points moves, so that no approach
is outrun; through what it touches it goes in small steps, and at every exit it is tested whether the needle is inside.
"""

from __future__ import annotations

import itertools
import math
from functools import cache

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.displaced_axis import beyond, displaced_distance
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.uncertainty.lines.needle_doubt import FARTHEST, NeedleDoubt, Problem


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
