"""Chances refined by line sampling: where a limit may decide, and where people are shown them, as `check` has them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.limited import limited
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.search.selection.windows import find_windows
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.chances import Chances
from puncture_twin.planning.uncertainty.refined_chances import refined_chances
from puncture_twin.planning.uncertainty.touch import touch_bound

BEST = 200
"""Of the ranked candidates: how many get the dearer chances."""


REFINED_FROM = 1 / 60
"""Times its limit: what first order, or its bound, puts above is refined. The chance to be displaced so far to any
side at all is 56 times that to one side at 3.5 standard deviations, and less for less."""

ROWS_AT_ONCE = 4096
"""Of candidates: a table of gradients of 60 structures stays below 20 MB."""


def refined_near_limits(found: Candidates, model: ChanceModel) -> Candidates:
    """Refine the chances to touch that first order puts near a limit or beyond, or that may be if the needle leans."""
    chances, limits = found.chances, model.limits
    assert chances is not None
    if not np.isfinite(limits).any():
        return found
    greatest = np.fmax(chances.touch, _touch_bounds(found, model))
    rows = np.flatnonzero((greatest >= REFINED_FROM * limits).any(axis=1) & np.isfinite(chances.hit))
    return with_refined(found, model, rows) if len(rows) else found


def _touch_bounds(found: Candidates, model: ChanceModel) -> Floats:
    """Shape (n, k), of the safe candidates' chances to touch; NaN for others."""
    error, columns, length = model.error, model.columns, float(model.lengths.max())
    surface_mm = np.sqrt(np.linalg.eigvalsh(model.surfaces)[:, -1])
    bounds, rows = np.full((len(found), len(columns)), np.nan), np.flatnonzero(found.safe)
    for part in (rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)):
        slack, cov_ct = found.clearance.distance[part][:, columns], error.covariance_ct(found.arm.q_insertion[part])
        bounds[part] = touch_bound(slack, found.outward_ct[part], cov_ct, length, surface_mm, error.freedom)
    return bounds


def with_refined(found: Candidates, model: ChanceModel, rows: Ints) -> Candidates:
    """Refine some rows."""
    chances = found.chances
    assert chances is not None
    names = [field.name for field in fields(chances) if field.name != "structures"]
    first = Chances(chances.structures, **{name: getattr(chances, name)[rows] for name in names})
    better = refined_chances(model, found.outward_ct[rows], found.arm.q_insertion[rows], first)
    return replace(found, chances=chances.put(rows, better))


def with_best_refined(found: Candidates, model: ChanceModel | None) -> Candidates:
    """Refine what is shown: the best of all, and the best of every window.

    Those that break a limit then are rejected, and the rest ranked again, until no new one is among them.

    Args:
        found: Ranked, with chances.
        model: As in `with_chances`.
    """
    if model is None or found.chances is None:
        return found
    while len(rows := _shown(found)):
        found = ranked(model.case, limited(model.case, with_refined(found, model, rows)))
    return found


def _shown(found: Candidates) -> Ints:
    """Rows that people are shown, and whose chances are of first order yet."""
    assert found.chances is not None
    best = [window.best for window in find_windows(found).windows]
    shown = np.unique(np.append(found.ranked[:BEST], best)).astype(np.int64)
    return shown[~found.chances.refined[shown] & np.isfinite(found.chances.hit[shown])]
