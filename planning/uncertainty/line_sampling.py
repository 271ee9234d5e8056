"""The chance to touch, beyond first order: the needle is moved along lines, and asked where it touches.

With Sigma5 the covariance of the tip's shift and of the lean across the needle (turning about its own axis moves it
nowhere), xi = B z, B B' = Sigma5, and z standard normal, every line is

    z = y + beta a,   a = -B'g / sigma,   y across a,      P = E_y[sum Phi(beta_out) - Phi(beta_in)]

over the stretches of the line on which the needle is nearer than the threshold (line sampling: Koutsourelakis,
Pradlwarter, Schueller, Prob. Eng. Mech. 19, 2004). The mean over y is a rule of 25 lines, exact to the fifth degree
(Stroud, Approximate Calculation of Multiple Integrals, 1971, E_n^r2 5-2 with n = 4); where its lines disagree, 128
lines. A line is walked in steps that no approach can outrun (the axis' fastest point bounds how fast its distance
falls), so that entry *and* exit of every stretch are found. A surface that may lie off as a whole is one more normal.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import chdtri, ndtr, ndtri, stdtr
from scipy.stats import qmc

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distance
from puncture_twin.planning.clearance.near_faces import NearFaces
from puncture_twin.planning.geometry.rigid import frame_about, skew

FARTHEST = 5.0
"""Standard deviations that a line is walked to either side; a stretch that is open there goes on for ever."""

MOST_LINES = 128
"""Where the lines of the small rule disagree."""

WIDEST = 4.0
"""Standard deviations across which a line may lie: what lies beyond has a chance of .003 and less to matter."""

DISAGREE = 0.06
"""Standard deviation of the lines' chances from which on the small rule is not trusted with .005."""

SMALLEST_STEP, INSIDE_STEP = 0.04, 0.25
"""Standard deviations: of a walk that all but touches, and through what it touches."""

HALVINGS = 5
"""Of the step in which an end of a stretch lies: it is then known to .001."""

SIZES = 12
"""Of chi-squared, at the middles of equal parts, where the errors' size is uncertain."""

NUDGE_MM = 1e-6
"""By which a tip's way is moved aside, so that it does not run through an edge of a face."""

ROOT_HALF = math.sqrt(0.5)


@dataclass(frozen=True, eq=False)
class NeedleDoubt:
    """One needle, and how it may be displaced; CT frame, mm and rad.

    Attributes:
        origin: Shape (3,), the tip's own place, where the axis starts.
        outward: Shape (3,), unit.
        root: Shape (6, 5), B: shift and lean of each of five standard normals.
        surface_mm: Standard deviation of a structure's surface as a whole.
        freedom: Degrees of the errors' size where the residuals gave it.
    """

    origin: Floats
    outward: Floats
    root: Floats
    surface_mm: float
    freedom: int | None

    def reach(self, length: float, threshold: float) -> tuple[float, float]:
        """How near a face must be to matter, mm, at the tip and at the axis' other end: farther than any line leads."""
        size = math.hypot(FARTHEST, WIDEST + 1.0) * (1.0 if self.freedom is None else float(_sizes(self.freedom).max()))
        shift, lean = self.root[:3], self.root[3:]
        top = shift - length * skew(self.outward) @ lean
        turn = size * np.linalg.norm(lean, 2)
        start = threshold + size * (self.surface_mm + float(np.linalg.norm(shift, 2)))
        end = threshold + size * (self.surface_mm + float(np.linalg.norm(top, 2))) + 0.5 * length * float(turn) ** 2
        return start, end


def needle_doubt(
    origin: Floats, outward: Floats, cov_ct: Floats, surface_mm: float, freedom: int | None = None
) -> NeedleDoubt:
    """From Sigma6.

    Args:
        origin: Shape (3,), mm, the covariance's point of reference.
        outward: Shape (3,), unit.
        cov_ct: Shape (6, 6), CT axes.
        surface_mm: As there.
        freedom: As there.
    """
    across = frame_about(outward)[:, :2]
    keep = np.zeros((6, 5))
    keep[:3, :3], keep[3:, 3:] = np.eye(3), across
    values, axes = np.linalg.eigh(_balanced(keep.T @ cov_ct @ keep))
    root = keep @ (_scales(keep.T @ cov_ct @ keep)[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))
    return NeedleDoubt(origin, outward, np.ascontiguousarray(root), surface_mm, freedom)


def _scales(cov: Floats) -> Floats:
    """Standard deviations; mm and rad differ by orders of magnitude."""
    return np.asarray(np.sqrt(np.maximum(np.diag(cov), 0.0)))


def _balanced(cov: Floats) -> Floats:
    """Correlations."""
    scale = np.where(_scales(cov) > 0, _scales(cov), 1.0)
    return np.asarray(cov / np.outer(scale, scale))


def line_chance(near: NearFaces, doubt: NeedleDoubt, length: float, threshold: float, gradient: Floats) -> float:
    """P that the needle comes nearer to a structure than a threshold; NaN where nothing displaces it.

    Args:
        near: The structure's faces within `NeedleDoubt.reach` of the axis.
        doubt: The needle and its doubt.
        length: Of the axis, mm.
        threshold: Needle radius, or that and a margin, mm.
        gradient: Shape (6,), g: what shift and rotation do to the distance, to first order.
    """
    slope = doubt.root.T @ gradient
    sigma = math.hypot(float(np.linalg.norm(slope)), doubt.surface_mm)
    if not sigma > 0.0:
        return math.nan
    basis = _basis(slope, doubt.surface_mm / sigma, float(np.linalg.norm(slope)) / sigma)
    problem = (near.triangles, near.faces, near.blocks, doubt.origin, doubt.outward, float(length), float(threshold))
    if doubt.freedom is None:
        return _chance(problem, doubt.root, doubt.surface_mm, basis)
    origin = (float(doubt.origin[0]), float(doubt.origin[1]), float(doubt.origin[2]))
    along = (float(doubt.outward[0]), float(doubt.outward[1]), float(doubt.outward[2]))
    slack = displaced_distance(near.triangles, near.faces, near.blocks, origin, along, float(length), -1.0, 0)[0]
    first = -(min(slack, 1e9) - threshold) / sigma
    beyond = 0.0
    for size in _sizes(doubt.freedom):
        beyond += _chance(problem, size * doubt.root, size * doubt.surface_mm, basis) - float(ndtr(first / size))
    return float(np.clip(stdtr(doubt.freedom, first) + beyond / SIZES, 0.0, 1.0))


def _chance(problem: tuple[object, ...], root: Floats, surface_mm: float, basis: Floats) -> float:
    """By the small rule; by many lines where its lines disagree."""
    offsets, weights = _few_lines(surface_mm > 0.0)
    chances = _lines(problem, root, surface_mm, basis, offsets)
    mean = float(weights @ chances)
    if float(weights @ (chances - mean) ** 2) > DISAGREE**2:
        mean = float(_lines(problem, root, surface_mm, basis, _many_lines(surface_mm > 0.0)).mean())
    return min(max(mean, 0.0), 1.0)


@cache
def _sizes(freedom: int) -> Floats:
    """By how much the errors' true size may exceed the estimate: sqrt(nu / chi-squared) at equal chances."""
    return np.asarray(np.sqrt(freedom / chdtri(freedom, (np.arange(SIZES) + 0.5) / SIZES)))


@cache
def _few_lines(surface: bool) -> tuple[Floats, Floats]:
    """Offsets (n, 5), four of the pose and one mixed with the surface, and weights (n,)."""
    signs = list(itertools.product((1.0, -1.0), repeat=2))
    pairs = list(itertools.combinations(range(4), 2))
    offsets, weights = np.zeros((1 + len(signs) * len(pairs), 5)), np.full(1 + len(signs) * len(pairs), 1.0 / 36.0)
    weights[0] = 1.0 / 3.0
    for row, (pair, sign) in enumerate(itertools.product(pairs, signs)):
        offsets[row + 1, list(pair)] = math.sqrt(3.0) * np.array(sign)
    if not surface:
        return offsets, weights
    mixed = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
    return np.concatenate([offsets + mixed, offsets - mixed]), np.tile(weights, 2) / 2


@cache
def _many_lines(surface: bool) -> Floats:
    """Offsets (n, 5), spread evenly over a normal."""
    drawn = qmc.Sobol(5 if surface else 4, scramble=True, seed=20191104).random(MOST_LINES)
    normal = ndtri(np.clip(drawn, 1e-12, 1 - 1e-12))
    length = np.linalg.norm(normal, axis=1)[:, None]
    offsets = np.zeros((MOST_LINES, 5))
    offsets[:, : normal.shape[1]] = normal * np.minimum(1.0, WIDEST / length)
    return offsets


def _basis(slope: Floats, by_surface: float, by_pose: float) -> Floats:
    """Orthonormal rows (6, 6) of six normals (five of the pose, the surface's): a, four across, the mixed one."""
    size = float(np.linalg.norm(slope))
    down = -slope / size if size > 0.0 else np.eye(5)[0]
    frame = np.linalg.qr(np.column_stack([down, np.eye(5)]))[0]
    basis = np.zeros((6, 6))
    basis[0, :5], basis[0, 5] = by_pose * down, -by_surface
    basis[1:5, :5] = frame[:, 1:5].T
    basis[5, :5], basis[5, 5] = by_surface * down, by_pose
    return basis


@nb.njit(cache=True, error_model="numpy")
def _lines(problem, root, surface_mm, basis, offsets):  # type: ignore[no-untyped-def]  # numba infers
    """The chance along each line, shape (n,)."""
    chances, hint = np.empty(len(offsets)), 0
    triangles, faces, blocks, origin, outward, length, threshold = problem
    scene = (triangles, faces, blocks, origin, outward, length, threshold, surface_mm)
    ahead = _displacement(root, basis[0])
    for line in range(len(offsets)):
        z = np.zeros(6)
        for k in range(5):
            for x in range(6):
                z[x] += offsets[line, k] * basis[k + 1, x]
        chances[line], hint = _walk(scene, _displacement(root, z), ahead, hint)
    return chances


@nb.njit(cache=True, error_model="numpy")
def _displacement(root, z):  # type: ignore[no-untyped-def]
    """Shift, lean and the surface's normal, shape (7,)."""
    found = np.zeros(7)
    for row in range(6):
        for k in range(5):
            found[row] += root[row, k] * z[k]
    found[6] = z[5]
    return found


@nb.njit(cache=True, error_model="numpy")
def _walk(scene, start, ahead, hint):  # type: ignore[no-untyped-def]
    """Sum of Phi over the stretches of one line that touch."""
    fastest = _fastest(scene, start, ahead)
    low, high, halvings, inside, entry, total = -np.inf, -FARTHEST, 0, False, -np.inf, 0.0
    while True:  # one place that asks for the distance: it is compiled into each
        beta = 0.5 * (low + high) if halvings > 0 else high
        gap, hint = _gap(scene, start, ahead, beta, hint)
        doubtful = inside or low == -np.inf or scene[7] > 0.0
        touches = gap < 0.0 or (doubtful and _swallowed(scene, start, ahead, beta))
        if low == -np.inf:
            inside = touches
        elif halvings > 0 or touches != inside:  # an end of a stretch lies between low and high
            low, high = (beta, high) if touches == inside and halvings > 0 else (low, beta)
            halvings = halvings - 1 if halvings > 0 else HALVINGS
            if halvings > 0:
                continue
            if inside:
                total += _normal(high) - _normal(entry)
            entry, inside, beta, gap = low, not inside, high, SMALLEST_STEP * fastest
        if beta >= FARTHEST:
            return total + (_normal(-entry) if inside else 0.0), hint
        low, high = beta, min(beta + (INSIDE_STEP if inside else max(gap / fastest, SMALLEST_STEP)), FARTHEST)


@nb.njit(cache=True, error_model="numpy")
def _swallowed(scene, start, ahead, beta):  # type: ignore[no-untyped-def]
    """Whether a needle that is near no face is inside: its tip came through an odd number of them on its way.

    Faces that the tip can come through are near the nominal needle, all of them.
    """
    triangles, origin = scene[0], scene[3]
    ox, oy, oz = origin[0] + NUDGE_MM, origin[1] - 0.61 * NUDGE_MM, origin[2] + 0.37 * NUDGE_MM
    x, y, z = start[0] + beta * ahead[0], start[1] + beta * ahead[1], start[2] + beta * ahead[2]
    odd = False
    for row in range(len(triangles)):
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


@nb.njit(cache=True, error_model="numpy")
def _fastest(scene, start, ahead):  # type: ignore[no-untyped-def]
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
def _gap(scene, start, ahead, beta, hint):  # type: ignore[no-untyped-def]
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
