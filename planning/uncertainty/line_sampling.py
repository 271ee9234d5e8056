"""The chance to touch, beyond first order: the needle is moved along lines, and where it touches is found.

With Sigma5 the covariance of the tip's shift and of the lean across the needle (turning about its own axis moves it
nowhere), xi = B z, B B' = Sigma5, and z standard normal, every line is

    z = y + beta a,   a = -B'g / sigma,   y across a,      P = E_y[sum Phi(beta_out) - Phi(beta_in)]

over the stretches of the line on which the needle is nearer than the threshold (line sampling: Koutsourelakis,
Pradlwarter, Schueller, Prob. Eng. Mech. 19, 2004). The mean over y is a rule of 25 lines, exact to the fifth degree
(Stroud, Approximate Calculation of Multiple Integrals, 1971, E_n^r2 5-2 with n = 4). Where its lines disagree, or
several things are about as likely, 128 lines spread by Sobol; where these disagree, 512. Where another direction
touches sooner than first order's, which 51 rays tell, a is that one. A line is walked in steps that no approach can
outrun, so that entry *and* exit of every stretch are found. A surface that may lie off as a whole is one more normal;
errors whose size is uncertain give every line a size of its own.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import chdtri, ndtr, ndtri, stdtr

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distance
from puncture_twin.planning.clearance.near_faces import NearFaces
from puncture_twin.planning.geometry.rigid import frame_about, skew
from puncture_twin.planning.uncertainty.needle_lines import FARTHEST, first_touches, walked

Problem = tuple[Floats, Floats, Floats, Floats, Floats, float, float]
"""Faces near a needle and spheres around them, its start and direction, its length and the threshold."""

MANY_LINES, MOST_LINES = 128, 512
"""Where something else is touched about as soon as what is likeliest, or sizes are uncertain; where these disagree."""

PREFERRED, SOONER, NO_MATTER = 0.1, 0.8, 3.8
"""Standard deviations by which another direction must be better than first order's; how much sooner than a plane
something else is touched; and how far out it does not matter."""

WIDEST = 4.0
"""Standard deviations across which a line may lie: what lies beyond has a chance of .003 and less to matter."""

DISAGREE = 0.1
"""Standard deviation of the lines' chances up to which few are trusted with .003: against 4,096 lines they err by that
at most, and by .013 where it is .2 (three anatomies; beside a lung and between ribs)."""

SCRAMBLED_WITH = 20191104
"""Seed of the lines' spread."""

SIZES = 16
"""Of chi-squared, at the middles of equal parts, where the errors' size is uncertain."""


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
        tip, top, turn = self._widths(length)
        start, end = threshold + self._size * (self.surface_mm + tip), threshold + self._size * (self.surface_mm + top)
        return start, end + 0.5 * length * (self._size * turn) ** 2

    @cached_property
    def _size(self) -> float:
        """Standard deviations, and more than any line has."""
        return math.hypot(FARTHEST, WIDEST + 1.0) * (1.0 if self.freedom is None else float(_sizes(self.freedom).max()))

    @cached_property
    def _widths(self) -> Callable[[float], tuple[float, float, float]]:
        """Of an axis as long as told: how far tip (mm), other end (mm) and direction (rad) may lie off, at most."""
        shift, lean = self.root[:3], self.root[3:]
        tip, turn = float(np.linalg.norm(shift, 2)), float(np.linalg.norm(lean, 2))

        @cache  # many structures are measured from axes of one length
        def of(length: float) -> tuple[float, float, float]:
            return tip, float(np.linalg.norm(shift - length * skew(self.outward) @ lean, 2)), turn

        return of


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
    problem = (near.triangles, near.faces, near.blocks, doubt.origin, doubt.outward, float(length), float(threshold))
    slope = doubt.root.T @ gradient
    sigma = math.hypot(float(np.linalg.norm(slope)), doubt.surface_mm)
    likeliest, alone = _likeliest(problem, doubt, slope, _slack(problem))
    steep = math.hypot(float(np.linalg.norm(likeliest)), doubt.surface_mm)
    if not steep > 0.0:
        return math.nan
    basis = _basis(likeliest, doubt.surface_mm / steep, float(np.linalg.norm(likeliest)) / steep)
    first = -_slack(problem) / max(sigma, 1e-12)
    return _chance(problem, doubt, basis, first, alone)


def _slack(problem: Problem) -> float:
    """Of the nominal needle, mm."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    tip = (float(origin[0]), float(origin[1]), float(origin[2]))
    along = (float(outward[0]), float(outward[1]), float(outward[2]))
    return min(float(displaced_distance(triangles, faces, blocks, tip, along, length, -1.0, 0)[0]), 1e9) - threshold


def _likeliest(problem: Problem, doubt: NeedleDoubt, slope: Floats, slack: float) -> tuple[Floats, bool]:
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
    """Along each of five normals and between each two, both ways: shape (50, 5)."""
    signs = (1.0, -1.0)
    ones = [sign * np.eye(5)[k] for k in range(5) for sign in signs]
    twos = [
        math.sqrt(0.5) * (one * np.eye(5)[i] + other * np.eye(5)[j])
        for i, j in itertools.combinations(range(5), 2)
        for one in signs
        for other in signs
    ]
    return np.array(ones + twos)


def _chance(problem: Problem, doubt: NeedleDoubt, basis: Floats, first: float, alone: bool) -> float:
    """By the small rule; by many lines where its lines disagree, or several things are touched, or by most lines.

    Where the errors' size is uncertain every line has its own, and the lines say by how much first order, of quantile
    ``first``, errs.
    """
    surface = doubt.surface_mm > 0.0
    rules = [_many_lines(surface, count, doubt.freedom) for count in (MANY_LINES, MOST_LINES)]
    if alone and doubt.freedom is None:
        rules.insert(0, _few_lines(surface))
    for lines in rules:
        mean, spread = _by_lines(problem, doubt, basis, lines, first)
        if spread <= DISAGREE:
            break
    return min(max(mean, 0.0), 1.0)


@cache
def _sizes(freedom: int) -> Floats:
    """By how much the errors' true size may exceed the estimate: sqrt(nu / chi-squared) at equal chances."""
    return np.asarray(np.sqrt(freedom / chdtri(freedom, (np.arange(SIZES) + 0.5) / SIZES)))


def _by_lines(problem: Problem, doubt: NeedleDoubt, basis: Floats, lines: Lines, first: float) -> tuple[float, float]:
    """The mean chance of some lines, and their standard deviation; beyond first order's where sizes are uncertain."""
    chances = walked(problem, doubt.root, doubt.surface_mm, basis, lines.offsets, lines.sizes)
    whole = 0.0
    if doubt.freedom is not None:
        whole, chances = float(stdtr(doubt.freedom, first)), chances - ndtr(first / lines.sizes)
    mean = float(lines.weights @ chances)
    return whole + mean, math.sqrt(float(lines.weights @ (chances - mean) ** 2))


class Lines(NamedTuple):
    """Where n lines lie.

    Attributes:
        offsets: Shape (n, 5), standard deviations, four of the pose and one mixed with the surface.
        sizes: Shape (n,), of each line's errors over the estimate.
        weights: Shape (n,), their sum is 1.
    """

    offsets: Floats
    sizes: Floats
    weights: Floats


@cache
def _few_lines(surface: bool) -> Lines:
    """The small rule."""
    signs = list(itertools.product((1.0, -1.0), repeat=2))
    pairs = list(itertools.combinations(range(4), 2))
    offsets, weights = np.zeros((1 + len(signs) * len(pairs), 5)), np.full(1 + len(signs) * len(pairs), 1.0 / 36.0)
    weights[0] = 1.0 / 3.0
    for row, (pair, sign) in enumerate(itertools.product(pairs, signs)):
        offsets[row + 1, list(pair)] = math.sqrt(3.0) * np.array(sign)
    if surface:
        mixed = np.array([0.0, 0.0, 0.0, 0.0, 1.0])
        offsets, weights = np.concatenate([offsets + mixed, offsets - mixed]), np.tile(weights, 2) / 2
    return Lines(offsets, np.ones(len(offsets)), weights)


@cache
def _many_lines(surface: bool, count: int, freedom: int | None) -> Lines:
    """Spread evenly over a normal, and over the sizes that are as likely."""
    mixed = 1 if surface else 0
    drawn = _sobol(4 + mixed + (freedom is not None), count)
    normal = ndtri(np.clip(drawn[:, : 4 + mixed], 1e-12, 1 - 1e-12))
    length = np.linalg.norm(normal, axis=1)[:, None]
    offsets = np.zeros((count, 5))
    offsets[:, : 4 + mixed] = normal * np.minimum(1.0, WIDEST / length)
    sizes = np.ones(count) if freedom is None else _sizes(freedom)[(drawn[:, -1] * SIZES).astype(np.int64)]
    return Lines(offsets, sizes, np.full(count, 1.0 / count))


def _sobol(dimensions: int, count: int) -> Floats:
    """Points spread evenly over the unit cube, shape (count, dimensions), from the user's cache if they are there."""

    def make() -> Arrays:
        return {"points": scipy.stats.qmc.Sobol(dimensions, scramble=True, seed=SCRAMBLED_WITH).random(count)}

    made_from = {"what": "sobol", "dimensions": dimensions, "count": count, "seed": SCRAMBLED_WITH}
    return user_cache().arrays(made_from, make, by=__name__)["points"]


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
