"""Rules of lines: where they lie, and the mean of their chances."""

from __future__ import annotations

import itertools
import math
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import ndtr, ndtri, stdtr

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.uncertainty.lines.needle_doubt import SIZES, WIDEST, NeedleDoubt, Problem, error_sizes
from puncture_twin.planning.uncertainty.lines.walks import walked

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
