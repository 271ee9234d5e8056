"""Chances near a limit by first order, and those of the best, refined by line sampling; and what is too likely."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.limits import touch_limit
from puncture_twin.planning.uncertainty.touch import touch_bound

REFINED_FROM, REFINED_TO = 1 / 60, 3.0
"""Times its limit: what first order, or its bound, puts in between is refined. The chance to be displaced so far to any
side at all is 56 times that to one side at 3.5 standard deviations, and less for less."""

ROWS_AT_ONCE = 4096
"""Of candidates: a table of gradients of 60 structures stays below 20 MB."""

BEST = 200
"""Of the ranked candidates: how many get the dearer chances."""


def refined_near_limits(found: Candidates, model: ChanceModel, limits: Floats) -> Candidates:
    """Refine the chances to touch that first order puts near a limit, or that may be there if the needle leans."""
    chances = found.chances
    assert chances is not None
    if not np.isfinite(limits).any():
        return found
    greatest = np.fmax(chances.touch, _touch_bounds(found, model))
    wanted = (greatest >= REFINED_FROM * limits) & (chances.touch <= REFINED_TO * limits)
    rows = np.flatnonzero(wanted.any(axis=1) & found.safe)
    return with_refined(found, model, rows, wanted[rows]) if len(rows) else found


def with_refined(found: Candidates, model: ChanceModel, rows: Ints, wanted: Bools | None = None) -> Candidates:
    """Refine some rows; ``wanted`` as in `ChanceModel.refined`."""
    chances = found.chances
    assert chances is not None
    better = model.refined(found.outward_ct[rows], found.arm.q_insertion[rows], chances.at(rows), wanted)
    return replace(found, chances=chances.put(rows, better))


def _touch_bounds(found: Candidates, model: ChanceModel) -> Floats:
    """Shape (n, k), of the safe candidates' chances to touch; NaN for others."""
    error, columns, length = model.error, model.columns, float(model.lengths.max())
    bounds, rows = np.full((len(found), len(columns)), np.nan), np.flatnonzero(found.safe)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        slack, cov_ct = found.clearance.distance[part][:, columns], error.covariance_ct(found.arm.q_insertion[part])
        bounds[part] = touch_bound(slack, found.outward_ct[part], cov_ct, length, error.surface_mm, error.freedom)
    return bounds


def with_best_refined(found: Candidates, model: ChanceModel | None) -> Candidates:
    """Refine the best candidates, reject those that break a limit then, and rank again until no new one is among them.

    Args:
        found: Ranked, with chances.
        model: As in `with_chances`.
    """
    if model is None or found.chances is None:
        return found
    done, case = np.zeros(len(found), bool), model.case
    while len(rows := (best := found.ranked[:BEST])[~done[best]]):
        found = ranked(case, limited(case, with_refined(found, model, rows)))
        done[rows] = True
    return found


def limited(case: Case, found: Candidates) -> Candidates:
    """Reject what is too unlikely to hit, or too likely to touch."""
    chances, least = found.chances, case.search.min_hit
    assert chances is not None
    if least is not None:
        rows = np.flatnonzero(found.safe & ~(chances.hit >= least))  # what is not known is not enough
        target = np.full(len(rows), case.target_structure, dtype=object)
        found = replace(found, verdict=found.verdict.rejected(rows, Reason.HIT_UNLIKELY, target, chances.hit[rows]))
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    touch = np.where(np.isnan(chances.touch), np.inf, chances.touch)  # nor is it little enough
    with np.errstate(invalid="ignore"):  # without a limit both may be infinite
        beyond = np.where(touch > limits, touch - limits, -np.inf)
    rows = np.flatnonzero(found.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names = np.array(chances.structures, dtype=object)[worst]
    amounts = chances.touch[rows, worst]
    return replace(found, verdict=found.verdict.rejected(rows, Reason.TOUCH_LIKELY, names, amounts))
