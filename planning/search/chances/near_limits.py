"""Chances near a limit by first order, and those of the best, refined by line sampling; and what is too likely."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.refined import with_refined
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.touch import touch_bound

REFINED_FROM, REFINED_TO = 1 / 60, 3.0
"""Times its limit: what first order, or its bound, puts in between is refined. The chance to be displaced so far to any
side at all is 56 times that to one side at 3.5 standard deviations, and less for less."""

ROWS_AT_ONCE = 4096
"""Of candidates: a table of gradients of 60 structures stays below 20 MB."""


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


def _touch_bounds(found: Candidates, model: ChanceModel) -> Floats:
    """Shape (n, k), of the safe candidates' chances to touch; NaN for others."""
    error, columns, length = model.error, model.columns, float(model.lengths.max())
    bounds, rows = np.full((len(found), len(columns)), np.nan), np.flatnonzero(found.safe)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        slack, cov_ct = found.clearance.distance[part][:, columns], error.covariance_ct(found.arm.q_insertion[part])
        bounds[part] = touch_bound(slack, found.outward_ct[part], cov_ct, length, error.surface_mm, error.freedom)
    return bounds
