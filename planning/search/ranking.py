"""The order of the safe candidates: a weighted cost of six terms, and the Pareto front of these terms.

One of the terms is the safe cone: by how much a direction may be off and still be safe, as far as the grid shows.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints32
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.tables import RankingSection
from puncture_twin.planning.search.candidates import Candidates, Ranking

COMFORT_MM = 20.0
"""Clearance from which on more is no better: several times any registration error that a case should have."""
TIE_DIGITS = 9
"""Costs that agree to so many digits are equal: rounding must not decide a rank, nor differ between engines."""
COMFORT_CONE = np.radians(5.0)
"""Safe cone from which on more is no better: a hand-held or robotic needle is aimed within a degree or two."""
NO_RISK = 1e-6
"""Chance to touch from which down less is no better: what no model of a patient can tell."""
TERMS = ("clearance", "path_length", "skin_angle", "tissue", "reach", "safe_cone")
"""The cost's terms, in the order of the columns."""


class Order(NamedTuple):
    """Terms (n, 6) in 0..1 of n safe candidates, their weighted mean, the ranks by it, and `pareto_front`."""

    terms: Floats  # shape (n, 6), each in 0..1, 0 is best, columns as `TERMS`
    cost: Floats  # shape (n,), weighted mean of the terms
    rank: Ints32  # shape (n,), 1 is best; equal costs keep their order
    pareto: Bools  # shape (n,), no other candidate is at least as good in every term and better in one


def ranked(case: Case, candidates: Candidates) -> Candidates:
    """Give cost, rank and Pareto mark to the safe candidates."""
    rows = np.flatnonzero(candidates.safe)
    order = rank(
        min_clearance=candidates.least_clearance[rows],
        path_length=candidates.path.length[rows],
        skin_angle=candidates.path.skin_angle[rows],
        tissue=candidates.path.tissue[rows],
        reach_margin=candidates.arm.margin[rows],
        safe_cone=candidates.safe_cone[rows],
        shaft=case.needle.shaft_mm,
        max_skin_angle=case.search.max_skin_angle,
        weights=case.ranking,
        touch_chance=None if candidates.chances is None else candidates.chances.touch_any[rows],
    )
    blank = Ranking.none(len(candidates))
    cost, ranks, pareto = blank.cost.copy(), blank.rank.copy(), blank.pareto.copy()
    cost[rows], ranks[rows], pareto[rows] = order[1:]
    return replace(candidates, ranking=Ranking(cost, ranks, pareto))


def ranked_by(candidates: Candidates, cost: Floats) -> Candidates:
    """The safe candidates ranked by a cost (n,) of the caller's, smaller is better; equal costs keep their order.

    Raises:
        InputError: Another shape, or a safe candidate whose cost is not finite.
    """
    rows = np.flatnonzero(candidates.safe)
    if cost.shape != (len(candidates),) or cost.dtype.kind not in "iufb" or not np.isfinite(cost[rows]).all():
        allowed = f"shape ({len(candidates)},), real numbers, finite for the {len(rows)} safe candidates"
        refuse(f"a cost of shape {cost.shape}, {cost.dtype}", "rerank", allowed, "wrong_shape")
    ranks = np.zeros(len(candidates), np.int32)
    ranks[rows[np.argsort(cost[rows], kind="stable")]] = np.arange(1, len(rows) + 1)
    ranking = Ranking(np.where(candidates.safe, cost, np.nan), ranks, candidates.ranking.pareto)
    return replace(candidates, ranking=ranking)


def rank(
    *,
    min_clearance: Floats,
    path_length: Floats,
    skin_angle: Floats,
    tissue: Floats,
    reach_margin: Floats,
    safe_cone: Floats,
    shaft: float,
    max_skin_angle: float,
    weights: RankingSection,
    touch_chance: Floats | None = None,
) -> Order:
    """Rank candidates by the weighted mean of six terms in 0..1, 0 is best; all arrays have shape (n,), mm and rad.

    clearance    1 - min(clearance, 20 mm) / 20 mm; where chances are known log10(p / 1e-6) / 6, of touching any
    path_length  path length / usable shaft
    skin_angle   skin angle / largest allowed
    tissue       length through other structures / usable shaft
    reach        1 - reach margin (0 for all where reach was not checked)
    safe_cone    1 - min(safe cone, 5 degrees) / 5 degrees (0 for all where no cone is known)
    """
    risk = np.asarray(1 - np.clip(min_clearance, 0, COMFORT_MM) / COMFORT_MM)
    if touch_chance is not None:
        decades = np.log10(np.maximum(touch_chance, NO_RISK) / NO_RISK) / -np.log10(NO_RISK)  # 0 at 1e-6, 1 at 1
        risk = np.where(np.isnan(touch_chance), risk, np.minimum(decades, 1.0))
    terms = np.stack(
        [
            risk,
            path_length / shaft,
            skin_angle / max_skin_angle,
            tissue / shaft,
            np.where(np.isnan(reach_margin), 0.0, 1 - reach_margin),
            np.where(np.isnan(safe_cone), 0.0, 1 - np.clip(safe_cone, 0, COMFORT_CONE) / COMFORT_CONE),
        ],
        axis=1,
    )
    terms = np.clip(np.nan_to_num(terms, nan=1.0), 0, 1)  # what is not known counts as worst
    factors = np.array([getattr(weights, term) for term in TERMS])
    cost = terms @ factors / max(factors.sum(), np.finfo(float).tiny)  # all weights may be 0
    order = np.argsort(np.round(cost, TIE_DIGITS), kind="stable")
    ranks = np.empty(len(cost), np.int32)
    ranks[order] = np.arange(1, len(cost) + 1)
    return Order(terms, cost, ranks, pareto_front(terms))


def pareto_front(terms: Floats) -> Bools:
    """Which rows of (n, m) no other row dominates (at most as large everywhere, smaller somewhere); shape (n,).

    In ascending order of the sum no row is dominated by a later one: the first is of the front, and takes out its own.
    """
    front, order = np.zeros(len(terms), bool), np.lexsort((*terms.T, terms.sum(axis=1)))
    left = terms[order]
    while len(left):
        front[order[0]] = True
        stays = (left[1:] < left[0]).any(axis=1) | (left[1:] == left[0]).all(axis=1)
        left, order = left[1:][stays], order[1:][stays]
    return front
