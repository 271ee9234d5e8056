"""Chance to touch beyond first order, by line sampling: a needle is displaced along lines to where it touches.

With Sigma5 the covariance of the tip's shift and of the lean across the needle (a rotation about its own axis moves it
nowhere), xi = B z, B B' = Sigma5, and z standard normal, every line is

    z = y + beta a,   a = -B'g / sigma,   y across a,      P = E_y[sum Phi(beta_out) - Phi(beta_in)]

over the stretches of the line on which the needle is nearer than the threshold (line sampling: Koutsourelakis,
Pradlwarter, Schueller, Prob. Eng. Mech. 19, 2004). The mean over y is a rule of 25 lines, exact to the fifth degree
(Stroud, Approximate Calculation of Multiple Integrals, 1971, E_n^r2 5-2 with n = 4). Where its lines disagree, or
several things are about as likely, 128 lines spread by Sobol; where these disagree, 512. Where another direction
touches sooner than first order's (found by 51 rays), a is that one. A surface that may lie off as a whole is one more
normal.

Errors whose size is uncertain, sqrt(nu / chi-squared), make z a Student's t of nu degrees in d dimensions, and no size
has to be drawn: y is one in d - 1, and beta, where y is given, Student's t of nu + d - 1 degrees and scale

    c = sqrt((nu + y'y) / (nu + d - 1)),      P = E_y[sum T(beta_out / c) - T(beta_in / c)]

(Ding, Am. Stat. 70, 2016). The length of y is stratified more densely the rarer it is, and lines are weighted for it.
Were the structure flat, a line would say T(-slack / (sigma c)), of which the mean is known: the lines say by how much
it differs.

A step along a line is never longer than the needle's distance over the fastest that any of its points moves, so that
entry *and* exit of every stretch are found. Through what it touches the walk goes in small steps, and at every exit it
is tested whether the needle is inside.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import fdtri, ndtr, ndtri, stdtr, stdtrit

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.processes import on_threads
from puncture_twin.planning.clearance.fast_engine import MOST_THREADS, NearFaces, near_faces
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.clearance.kernels.segment_triangle import beyond, displaced_distance
from puncture_twin.planning.geometry.rigid import frame_about, skew
from puncture_twin.planning.uncertainty.hit import Proximity, student_within


@dataclass(frozen=True, eq=False)
class Needles:
    """n needles with their covariances and proximity to the structures."""

    outward_ct: Floats  # shape (n, 3), unit
    cov_ct: Floats  # shape (n, 6, 6), Sigma6, CT axes
    near: Proximity  # how they pass the k structures, to first order
    surface_mm: Floats
    """Shape (n, k), by which each structure's surface may lie off as a whole where the needle passes it."""
    freedom: int | None  # degrees of the errors' size where the residuals gave it


def refined(
    blocks: Sequence[Blocks],
    length: Floats,
    target_ct: Floats,
    needles: Needles,
    threshold_mm: Floats,
    first: Floats,
    wanted: Bools,
) -> Floats:
    """First-order chances (n, k) with the wanted ones refined by line sampling; NaN where a needle intersects already.

    Of the faces of k structures in blocks, axes of a length (n, k) from the target (3,), and thresholds (k,): radius,
    or that and a margin; mm. A structure of which no face is within the needle's reach keeps its first order: it is
    touched less than once in 100,000 times, or in 10,000 where the errors' size is uncertain.
    """
    chances = first.copy()
    rows = np.flatnonzero((wanted & np.isfinite(first)).any(axis=1))

    def refine(k: int) -> None:
        row = rows[k]
        outward = needles.outward_ct[row]
        pose = needle_uncertainty(target_ct, outward, needles.cov_ct[row], 0.0, needles.freedom)
        for column in np.flatnonzero(wanted[row] & np.isfinite(first[row])).tolist():
            surface_mm = float(needles.surface_mm[row, column])
            uncertainty = replace(pose, surface_mm=surface_mm) if surface_mm > 0 else pose
            axis, threshold = float(length[row, column]), float(threshold_mm[column])
            reach = uncertainty.reach(axis, threshold)
            if needles.near.distance[row, column] > max(reach):  # no line leads so far
                continue
            faces = near_faces(blocks[column], target_ct, outward, axis, reach)
            if len(faces):
                chance = line_chance(faces, uncertainty, axis, threshold, needles.near.gradient[row, column])
                chances[row, column] = first[row, column] if np.isnan(chance) else chance

    for _ in on_threads(refine, len(rows), MOST_THREADS):
        pass
    return chances


def line_chance(
    near: NearFaces, uncertainty: NeedleUncertainty, length: float, threshold: float, gradient: Floats
) -> float:
    """P that the needle comes nearer to a structure than a threshold, mm; NaN where nothing displaces it.

    By the small rule; by many lines where its lines disagree, or several things are touched, or by most lines. The
    faces are those within `NeedleUncertainty.reach`, and g (6,) is what shift and rotation do to the distance, to first
    order.
    """
    origin, outward, freedom = uncertainty.origin, uncertainty.outward, uncertainty.freedom
    problem = (near.triangles, near.faces, near.blocks, origin, outward, float(length), float(threshold))
    ends = tuple(origin.tolist()), tuple(outward.tolist())
    nominal = displaced_distance(near.triangles, near.faces, near.blocks, *ends, float(length), -1.0, 0)[0]
    slack, slope = min(float(nominal), 1e9) - threshold, uncertainty.root.T @ gradient
    likeliest, alone = likeliest_slope(problem, uncertainty, slope, slack)
    steep = math.hypot(float(np.linalg.norm(likeliest)), uncertainty.surface_mm)
    if not steep > 0.0:  # nothing moves the needle against the structure
        return math.nan
    basis = line_basis(likeliest, uncertainty.surface_mm / steep, float(np.linalg.norm(likeliest)) / steep)
    surface, flat, whole = uncertainty.surface_mm > 0.0, -slack / steep, 0.0
    rules = [many_lines(surface, count, freedom) for count in MANY_LINES]
    if alone and freedom is None:
        rules.insert(0, few_lines(surface))  # exact enough only about one smooth nearest surface
    done = np.empty(0)
    for lines in rules:
        more = lines.without_first(len(done))
        chances = np.append(done, walked(problem, uncertainty.root, uncertainty.surface_mm, basis, more))
        done = done if lines.few else chances  # every spread of lines continues the one before
        if freedom is not None:
            whole, chances = float(stdtr(freedom, flat)), chances - stdtr(lines.degrees, flat / lines.scales)
        mean = float(lines.weights @ chances)
        deviation = math.sqrt(float(lines.weights @ (chances - mean) ** 2))
        if deviation <= agreement(lines, whole + mean):
            break
    return min(max(whole + mean, 0.0), 1.0)


def agreement(lines: Lines, chance: float) -> float:
    """Deviation of the lines' chances up to which their mean is trusted.

    Many, spread evenly, err by a quarter of its error. Few lie all equally far out, and see an edge there or none: they
    err by as much as they deviate.
    """
    fewer = 1.0 if lines.few else 4.0 * math.sqrt(len(lines.weights))
    return fewer * max(ERRS_BY, ERRS_BY_PART * chance)


MANY_LINES = (128, 256, 512)
"""Where something else is touched about as soon as what is likeliest, or sizes are uncertain; where these disagree."""
ERRS_BY, ERRS_BY_PART = 3e-4, 0.02
"""Error of a chance, and of what is that part of it, that is not worth more lines."""


class Lines(NamedTuple):
    """Offsets of n lines, and the distribution of the error along each."""

    offsets: Floats  # shape (n, 5), standard deviations, four of the pose and one mixed with the surface
    scales: Floats  # shape (n,), of the error along it, standard deviations
    farthest: Floats  # shape (n,), scales that it is walked to either side; an open stretch there goes on for ever
    degrees: int  # of Student's t along it; 0 of the normal
    weights: Floats  # shape (n,), their sum is 1
    few: bool = False  # whether they are the small rule's

    def without_first(self, count: int) -> Lines:
        """All but the first of them."""
        offsets, scales, farthest, weights = (
            part[count:] for part in (self.offsets, self.scales, self.farthest, self.weights)
        )
        return Lines(offsets, scales, farthest, self.degrees, weights, self.few)


@cache
def few_lines(surface: bool) -> Lines:
    """The 25 lines of the small rule."""
    signs = list(itertools.product((1.0, -1.0), repeat=2))
    pairs = list(itertools.combinations(range(4), 2))
    offsets, weights = np.zeros((1 + len(signs) * len(pairs), 5)), np.full(1 + len(signs) * len(pairs), 1.0 / 36.0)
    weights[0] = 1.0 / 3.0
    for row, (pair, sign) in enumerate(itertools.product(pairs, signs)):
        offsets[row + 1, list(pair)] = math.sqrt(3.0) * np.array(sign)
    if surface:
        mixed = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
        offsets, weights = np.concatenate([offsets + mixed, offsets - mixed]), np.tile(weights, 2) / 2
    return _normal_lines(offsets, weights, few=True)


@cache
def many_lines(surface: bool, count: int, freedom: int | None) -> Lines:
    """Lines spread evenly over a normal, or over Student's t."""
    across = 5 if surface else 4
    dimensions = across + (freedom is not None)

    def make() -> Arrays:
        return {"points": scipy.stats.qmc.Sobol(dimensions, scramble=True, seed=SCRAMBLED_WITH).random(count)}

    made_from = {"what": "sobol", "dimensions": dimensions, "count": count, "seed": SCRAMBLED_WITH}
    drawn = user_cache().arrays(made_from, make, by=__name__)["points"]  # shape (count, dimensions), in 0..1
    normal = ndtri(np.clip(drawn[:, :across], 1e-12, 1 - 1e-12))
    length = np.linalg.norm(normal, axis=1)[:, None]
    offsets = np.zeros((count, 5))
    if freedom is None:
        offsets[:, :across] = normal * np.minimum(1.0, WIDEST / length)  # farther ones are pulled in
        return _normal_lines(offsets, np.full(count, 1.0 / count))
    edge = widest_error(freedom)
    radii = np.minimum(student_radius(across, freedom, drawn[:, -1] ** RARER), 0.9 * edge)
    offsets[:, :across] = normal * (radii[:, None] / length)
    weights, degrees = drawn[:, -1] ** (RARER - 1), freedom + across
    scales = np.sqrt((freedom + radii**2) / degrees)
    farthest = np.minimum(np.sqrt(edge**2 - radii**2) / scales, -stdtrit(degrees, BEYOND))
    return Lines(offsets, scales, farthest, degrees, weights / weights.sum())


def _normal_lines(offsets: Floats, weights: Floats, *, few: bool = False) -> Lines:
    return Lines(offsets, np.ones(len(offsets)), np.full(len(offsets), FARTHEST), 0, weights, few)


def student_radius(dimensions: int, freedom: int, chance: Floats | float) -> Floats:
    """Length that Student's t in some dimensions exceeds with a chance, standard deviations."""
    return np.asarray(np.sqrt(dimensions / fdtri(freedom, dimensions, chance)))


def widest_error(freedom: int) -> float:
    """Radius of the ball within which lines are walked where the errors' size is uncertain, standard deviations."""
    return min(float(student_radius(6, freedom, BEYOND)), WIDEST_UNCERTAIN)


SCRAMBLED_WITH = 20191104
"""Seed of the lines' spread."""


def line_basis(slope: Floats, by_surface: float, by_pose: float) -> Floats:
    """Orthonormal rows (6, 6) of six normals (five of the pose, the surface's): a, four across, the mixed one."""
    size = float(np.linalg.norm(slope))
    down = -slope / size if size > 0.0 else np.eye(5)[0]
    frame = np.linalg.qr(np.column_stack([down, np.eye(5)]))[0]  # its first column is down, up to its sign
    basis = np.zeros((6, 6))
    basis[0, :5], basis[0, 5] = by_pose * down, -by_surface
    basis[1:5, :5] = frame[:, 1:5].T
    basis[5, :5], basis[5, 5] = by_surface * down, by_pose
    return basis


Problem = tuple[Floats, Floats, Floats, Floats, Floats, float, float]
"""Faces near a needle and spheres around them, its start and direction, its length and the threshold."""
FARTHEST = 5.0
"""Standard deviations that a line is walked to either side; a stretch that is open there goes on for ever."""
WIDEST = 4.0
"""Standard deviations across which a line may lie: what lies beyond has a chance of .003 and less to matter."""
RARER = 2
"""The line at a fraction v of all has an offset that is exceeded with a chance of v to this power."""
BEYOND, WIDEST_UNCERTAIN = 1e-4, 60.0
"""Chance of errors of an uncertain size that are larger than any that is walked; and the most standard deviations."""


@dataclass(frozen=True, eq=False)
class NeedleUncertainty:
    """One needle and the distribution of its displacement; CT frame, mm and rad."""

    origin: Floats  # shape (3,), the tip's own place, where the axis starts
    outward: Floats  # shape (3,), unit
    root: Floats  # shape (6, 5), B: shift and lean of each of five standard normals
    surface_mm: float  # standard deviation of the surface, as a whole, of the structure in question
    freedom: int | None  # degrees of the errors' size where the residuals gave it

    def reach(self, length: float, threshold: float) -> tuple[float, float]:
        """Distance within which a face may matter, mm, at the tip and at the axis' other end."""
        tip, top, rotation = self._widths(length)
        start, end = threshold + self._size * (self.surface_mm + tip), threshold + self._size * (self.surface_mm + top)
        return start, end + 0.5 * length * (self._size * rotation) ** 2

    @cached_property
    def _size(self) -> float:
        """Bound of the displacement on any line, in standard deviations."""
        return math.hypot(FARTHEST, WIDEST + 1.0) if self.freedom is None else widest_error(self.freedom)

    @property
    def rays_to(self) -> float:
        """Standard deviations that a ray is followed."""
        return RAYS_TO if self.freedom is None else min(-float(stdtrit(self.freedom, ndtr(-RAYS_TO))), self._size)

    @cached_property
    def _widths(self) -> Callable[[float], tuple[float, float, float]]:
        """Largest displacement of tip (mm), other end (mm) and direction (rad) per deviation, by length of the axis."""
        shift, lean = self.root[:3], self.root[3:]
        tip, rotation = float(np.linalg.norm(shift, 2)), float(np.linalg.norm(lean, 2))

        @cache  # many structures are measured from axes of one length
        def of(length: float) -> tuple[float, float, float]:
            return tip, float(np.linalg.norm(shift - length * skew(self.outward) @ lean, 2)), rotation

        return of


def needle_uncertainty(
    origin: Floats, outward: Floats, cov_ct: Floats, surface_mm: float, freedom: int | None = None
) -> NeedleUncertainty:
    """The uncertainty of one needle from its Sigma6 (6, 6), CT axes, about its origin (3,), mm; of a surface too."""
    across = frame_about(outward)[:, :2]
    keep = np.zeros((6, 5))
    keep[:3, :3], keep[3:, 3:] = np.eye(3), across
    cov = keep.T @ cov_ct @ keep
    sizes = np.sqrt(np.maximum(np.diag(cov), 0.0))  # mm and rad differ by orders of magnitude: correlations are rooted
    scale = np.where(sizes > 0, sizes, 1.0)
    values, axes = np.linalg.eigh(cov / np.outer(scale, scale))
    root = keep @ (sizes[:, None] * axes * np.sqrt(np.maximum(values, 0.0)))
    return NeedleUncertainty(origin, outward, np.ascontiguousarray(root), surface_mm, freedom)


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
    """Next step, where nothing is nearer than ``clear``: as far as what is clear there will probably reach back."""
    if clear < smallest:
        return smallest
    falls = min(max((before - clear) / stepped, -0.8), 1.0) if before > 0.0 else 1.0
    return 2.0 * clear / (1.0 + falls)


@nb.njit(cache=True, error_model="numpy")
def outran(clear_to, beta, clear, smallest):  # type: ignore[no-untyped-def]
    """Whether something may have been passed between what was clear before a step and what is clear after it."""
    return beta - clear_to > smallest and beta - max(clear, 0.0) > clear_to


@nb.njit(cache=True, error_model="numpy")
def fastest_approach(scene, start, ahead, farthest):  # type: ignore[no-untyped-def]
    """The most by which the distance can fall per scale, as far as the farthest: an end of the axis moves fastest."""
    outward, length, surface_mm = scene[4], scene[5], scene[7]
    ux, uy, uz = outward[0], outward[1], outward[2]
    dx, dy, dz, px, py, pz = ahead[0], ahead[1], ahead[2], ahead[3], ahead[4], ahead[5]
    at_tip = dx * dx + dy * dy + dz * dz
    x, y = dx + length * (py * uz - pz * uy), dy + length * (pz * ux - px * uz)
    z = dz + length * (px * uy - py * ux)
    turn = math.sqrt(px * px + py * py + pz * pz)
    lean = math.sqrt(start[3] ** 2 + start[4] ** 2 + start[5] ** 2) + farthest * turn
    fastest = math.sqrt(max(at_tip, x * x + y * y + z * z)) + length * lean * turn
    return fastest + surface_mm * abs(ahead[6]) + 1e-12


@nb.njit(cache=True, error_model="numpy")
def fastest_far_out(scene, ahead):  # type: ignore[no-untyped-def]
    """Another bound, however far the needle has leant: the tip's speed and the length times that of the rotation."""
    tip = math.sqrt(ahead[0] ** 2 + ahead[1] ** 2 + ahead[2] ** 2)
    turn = math.sqrt(ahead[3] ** 2 + ahead[4] ** 2 + ahead[5] ** 2)
    return tip + scene[5] * turn + scene[7] * abs(ahead[6]) + 1e-12


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
    enough = max(threshold - surface_mm * (start[6] + beta * ahead[6]), 0.0)  # a surface that is reached is touched
    distance, nearest = displaced_distance(triangles, faces, blocks, tip, along, length, enough, hint)
    return (-1.0 if distance == 0.0 else distance - enough), nearest


SMALLEST_STEP, INSIDE_STEP = 0.04, 0.25
"""Standard deviations: of a walk that all but touches, and through what it touches."""
END_WITHIN = 0.005
"""Standard deviations within which an end of a stretch is known; counted as touched, so that no chance is too small."""
LITTLE = 0.01
"""A walk ends where what is left of its normal is this part of what it has: all that is left counts as touched."""
NUDGE_MM = 1e-6
"""mm by which a tip's path is moved aside, so that it does not run through an edge of a face."""
ROOT_HALF = math.sqrt(0.5)


@nb.njit(cache=True, error_model="numpy", nogil=True)
def walked(problem, root, surface_mm, basis, lines):  # type: ignore[no-untyped-def]  # numba infers
    """The chance along each line, shape (n,)."""
    chances, hint = np.empty(len(lines.offsets)), np.int64(0)
    triangles, faces, blocks, origin, outward, length, threshold = problem
    scene = (triangles, faces, blocks, origin, outward, length, threshold, surface_mm)
    down = displacement(root, basis[0])
    for line in range(len(chances)):
        z = np.zeros(6)
        for k in range(5):
            for x in range(6):
                z[x] += lines.offsets[line, k] * basis[k + 1, x]
        start, ahead, farthest = displacement(root, z), lines.scales[line] * down, lines.farthest[line]
        chances[line], hint = _walk(scene, start, ahead, farthest, lines.degrees, hint)
    return chances


@nb.njit(cache=True, error_model="numpy")
def _walk(scene, start, ahead, farthest, degrees, hint):  # type: ignore[no-untyped-def]
    """Sum of Phi, or of Student's T, over the stretches of one line that touch."""
    fastest = fastest_approach(scene, start, ahead, farthest)
    if degrees > 0:
        fastest = min(fastest, fastest_far_out(scene, ahead))
    low, high, closing, inside, entry, total = -np.inf, -farthest, False, False, -np.inf, 0.0
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
                total += _below(high, degrees) - _below(entry, degrees)
            entry, inside, beta, gap = low, not inside, high, SMALLEST_STEP * fastest
        left = _below(-beta, degrees)
        so_far = total + (_below(beta, degrees) - _below(entry, degrees) if inside else 0.0)
        if beta >= farthest or left <= LITTLE * so_far:
            return so_far + (left if so_far > 0.0 else 0.0), hint
        step = INSIDE_STEP if inside else next_step(gap / fastest, clear, beta - low, SMALLEST_STEP)
        low, high, clear = beta, min(beta + step, farthest), gap / fastest


@nb.njit(cache=True, error_model="numpy")
def _swallowed(scene, start, ahead, beta):  # type: ignore[no-untyped-def]
    """Whether a needle that is near no face lies inside a structure: its tip crossed an odd number of faces.

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
def _below(x, degrees):  # type: ignore[no-untyped-def]
    """The normal's distribution, or that of Student's t."""
    if degrees == 0:
        return 0.5 * math.erfc(-x * ROOT_HALF)
    return 0.5 + 0.5 * student_within(x, degrees) if math.isfinite(x) else 0.0


RAYS_TO, RAY_STEP = 4.0, 0.1
"""Standard deviations that a ray is followed, or what is as rare of Student's t, and its smallest step: it only tells
what is touched about as soon."""


@nb.njit(cache=True, error_model="numpy", nogil=True)
def first_touches(problem, root, directions, rays_to, radii):  # type: ignore[no-untyped-def]
    """Fill, for rays along ``directions`` (n, 5) from the nominal needle, how far out each touches; or infinity."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    scene = (triangles, faces, blocks, origin, outward, length, threshold, 0.0)
    start, z = np.zeros(7), np.zeros(6)
    nominal, nearest = gap_beyond(scene, start, start, 0.0, np.int64(0))
    for ray in range(len(directions)):
        for k in range(5):
            z[k] = directions[ray, k]
        radii[ray] = _first_touch(scene, start, displacement(root, z), rays_to, nominal, nearest)


@nb.njit(cache=True, error_model="numpy")
def _first_touch(scene, start, ahead, rays_to, gap, hint):  # type: ignore[no-untyped-def]
    """Standard deviations at which a ray first touches, from where the clearance is ``gap``."""
    fastest, beta, low, clear = fastest_approach(scene, start, ahead, 1.25 * rays_to), 0.0, 0.0, 0.0
    while gap >= 0.0 and beta < rays_to:
        step = next_step(gap / fastest, clear, beta - low, RAY_STEP)
        low, clear, beta = beta, gap / fastest, min(beta + step, rays_to)
        gap, hint = gap_beyond(scene, start, ahead, beta, hint)
        if outran(low + clear, beta, gap / fastest, RAY_STEP):
            beta = low + max(clear, RAY_STEP)
            gap, hint = gap_beyond(scene, start, ahead, beta, hint)
    return beta if gap < 0.0 else np.inf


BETTER_BY, TOUCHED_SOONER, TOO_FAR = 0.1, 0.8, 0.95
"""Standard deviations by which another direction must be better than first order's; how much sooner than a plane
something else is touched; and at which part of a ray it does not matter."""


def likeliest_slope(
    problem: Problem, uncertainty: NeedleUncertainty, slope: Floats, slack: float
) -> tuple[Floats, bool]:
    """The slope (5,) along which the needle touches soonest, and whether nothing else touches about as soon.

    The nearest face need not be the likeliest, where a farther one lies in the direction of greater uncertainty: rays
    are sent in 51 directions. What touches sooner than a plane across the likeliest direction would is something else.
    """
    size = float(np.linalg.norm(slope))
    directions = np.vstack([-slope / size if size > 0.0 else np.eye(5)[0], _rays()])
    radii = np.empty(len(directions))
    first_touches(problem, uncertainty.root, directions, uncertainty.rays_to, radii)
    best = int(np.argmin(radii))
    if not np.isfinite(radii[best]) or radii[best] <= 0.0 or radii[0] < radii[best] + BETTER_BY:
        best = 0
    flat = np.full(len(radii), np.inf)
    towards = directions @ directions[best]  # cosine: a plane across the best is hit at radius / cosine
    np.divide(radii[best], towards, out=flat, where=towards > 0.05)
    alone = not bool(((radii < TOUCHED_SOONER * flat) & (radii < TOO_FAR * uncertainty.rays_to)).any())
    return (slope, alone) if best == 0 else (-directions[best] * (slack / radii[best]), alone)


@cache
def _rays() -> Floats:
    """Unit vectors along each of five normals and between each two, with both signs: shape (50, 5)."""
    signs = (1.0, -1.0)
    ones = [sign * np.eye(5)[k] for k in range(5) for sign in signs]
    twos = [
        math.sqrt(0.5) * (one * np.eye(5)[i] + other * np.eye(5)[j])
        for i, j in itertools.combinations(range(5), 2)
        for one in signs
        for other in signs
    ]
    return np.array(ones + twos)
