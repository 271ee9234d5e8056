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
from dataclasses import dataclass, replace
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import ndtr, ndtri, stdtr

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.clearance.kernels.blocks import Blocks
from puncture_twin.planning.clearance.kernels.displaced_axis import displaced_distance
from puncture_twin.planning.clearance.near_faces import NearFaces, near_faces
from puncture_twin.planning.uncertainty.lines.needle_doubt import (
    SIZES,
    WIDEST,
    NeedleDoubt,
    Problem,
    error_sizes,
    needle_doubt,
)
from puncture_twin.planning.uncertainty.lines.walks import likeliest_slope, walked
from puncture_twin.planning.uncertainty.touch import Proximity


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
    likeliest, alone = likeliest_slope(problem, doubt, slope, _slack(problem))
    steep = math.hypot(float(np.linalg.norm(likeliest)), doubt.surface_mm)
    if not steep > 0.0:
        return math.nan
    basis = line_basis(likeliest, doubt.surface_mm / steep, float(np.linalg.norm(likeliest)) / steep)
    first = -_slack(problem) / max(sigma, 1e-12)
    return chance_by_rules(problem, doubt, basis, first, alone)


def _slack(problem: Problem) -> float:
    """Of the nominal needle, mm."""
    triangles, faces, blocks, origin, outward, length, threshold = problem
    tip = (float(origin[0]), float(origin[1]), float(origin[2]))
    along = (float(outward[0]), float(outward[1]), float(outward[2]))
    return min(float(displaced_distance(triangles, faces, blocks, tip, along, length, -1.0, 0)[0]), 1e9) - threshold


SCRAMBLED_WITH = 20191104
"""Seed of the lines' spread."""


def by_lines(problem: Problem, doubt: NeedleDoubt, basis: Floats, lines: Lines, first: float) -> tuple[float, float]:
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
def few_lines(surface: bool) -> Lines:
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
def many_lines(surface: bool, count: int, freedom: int | None) -> Lines:
    """Spread evenly over a normal, and over the sizes that are as likely."""
    mixed = 1 if surface else 0
    drawn = _sobol(4 + mixed + (freedom is not None), count)
    normal = ndtri(np.clip(drawn[:, : 4 + mixed], 1e-12, 1 - 1e-12))
    length = np.linalg.norm(normal, axis=1)[:, None]
    offsets = np.zeros((count, 5))
    offsets[:, : 4 + mixed] = normal * np.minimum(1.0, WIDEST / length)
    sizes = np.ones(count) if freedom is None else error_sizes(freedom)[(drawn[:, -1] * SIZES).astype(np.int64)]
    return Lines(offsets, sizes, np.full(count, 1.0 / count))


def _sobol(dimensions: int, count: int) -> Floats:
    """Points spread evenly over the unit cube, shape (count, dimensions), from the user's cache if they are there."""

    def make() -> Arrays:
        return {"points": scipy.stats.qmc.Sobol(dimensions, scramble=True, seed=SCRAMBLED_WITH).random(count)}

    made_from = {"what": "sobol", "dimensions": dimensions, "count": count, "seed": SCRAMBLED_WITH}
    return user_cache().arrays(made_from, make, by=__name__)["points"]


MANY_LINES, MOST_LINES = 128, 512
"""Where something else is touched about as soon as what is likeliest, or sizes are uncertain; where these disagree."""

DISAGREE = 0.1
"""Standard deviation of the lines' chances up to which few are trusted with .003: against 4,096 lines they err by that
at most, and by .013 where it is .2 (three anatomies; beside a lung and between ribs)."""


def chance_by_rules(problem: Problem, doubt: NeedleDoubt, basis: Floats, first: float, alone: bool) -> float:
    """By the small rule; by many lines where its lines disagree, or several things are touched, or by most lines.

    Where the errors' size is uncertain every line has its own, and the lines say by how much first order, of quantile
    ``first``, errs.
    """
    surface = doubt.surface_mm > 0.0
    rules = [many_lines(surface, count, doubt.freedom) for count in (MANY_LINES, MOST_LINES)]
    if alone and doubt.freedom is None:
        rules.insert(0, few_lines(surface))
    for lines in rules:
        mean, spread = by_lines(problem, doubt, basis, lines, first)
        if spread <= DISAGREE:
            break
    return min(max(mean, 0.0), 1.0)


def line_basis(slope: Floats, by_surface: float, by_pose: float) -> Floats:
    """Orthonormal rows (6, 6) of six normals (five of the pose, the surface's): a, four across, the mixed one."""
    size = float(np.linalg.norm(slope))
    down = -slope / size if size > 0.0 else np.eye(5)[0]
    frame = np.linalg.qr(np.column_stack([down, np.eye(5)]))[0]
    basis = np.zeros((6, 6))
    basis[0, :5], basis[0, 5] = by_pose * down, -by_surface
    basis[1:5, :5] = frame[:, 1:5].T
    basis[5, :5], basis[5, 5] = by_surface * down, by_pose
    return basis


@dataclass(frozen=True, eq=False)
class Surroundings:
    """What must not be touched about one target; CT frame, mm.

    Attributes:
        blocks: The faces of each of the k structures.
        length: Shape (n, k), of each needle's axis for each.
        target_ct: Shape (3,), where every axis starts.
    """

    blocks: tuple[Blocks, ...]
    length: Floats
    target_ct: Floats


@dataclass(frozen=True, eq=False)
class Needles:
    """n needles and the doubt about them.

    Attributes:
        outward_ct: Shape (n, 3), unit.
        cov_ct: Shape (n, 6, 6), Sigma6, CT axes.
        near: How they pass the k structures, to first order.
        surface_mm: Shape (n, k), by which each structure's surface may lie off as a whole where the needle passes it.
        freedom: Degrees of the errors' size where the residuals gave it.
    """

    outward_ct: Floats
    cov_ct: Floats
    near: Proximity
    surface_mm: Floats
    freedom: int | None


def refined(around: Surroundings, needles: Needles, threshold_mm: Floats, first: Floats, wanted: Bools) -> Floats:
    """First-order chances, those that are wanted refined.

    A structure of which no face is within the needle's reach keeps its first order: it is touched less than once in
    100,000 times.

    Args:
        around: What must not be touched.
        needles: The n needles.
        threshold_mm: Shape (k,), needle radius, or that and a margin.
        first: Shape (n, k), to first order; NaN where a needle meets a structure already.
        wanted: Shape (n, k).

    Returns:
        Shape (n, k).
    """
    found = first.copy()
    rows = np.flatnonzero((wanted & np.isfinite(first)).any(axis=1))
    for row in rows:
        outward = needles.outward_ct[row]
        pose = needle_doubt(around.target_ct, outward, needles.cov_ct[row], 0.0, needles.freedom)
        for column in np.flatnonzero(wanted[row] & np.isfinite(first[row])):
            surface_mm = float(needles.surface_mm[row, column])
            doubt = replace(pose, surface_mm=surface_mm) if surface_mm > 0 else pose
            length, threshold = float(around.length[row, column]), float(threshold_mm[column])
            reach = doubt.reach(length, threshold)
            if needles.near.distance[row, column] > max(reach):
                continue
            faces = near_faces(around.blocks[column], around.target_ct, outward, length, reach)
            if len(faces):
                chance = line_chance(faces, doubt, length, threshold, needles.near.gradient[row, column])
                found[row, column] = first[row, column] if np.isnan(chance) else chance
    return found
