"""The refusal of what is too unlikely to hit, or too likely to touch."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints, Texts
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.search.candidates import Candidates, Verdict
from puncture_twin.planning.uncertainty.limits import touch_limit


def limited(case: Case, found: Candidates) -> Candidates:
    """Reject what is too unlikely to hit, or too likely to touch."""
    chances, least = found.chances, case.search.min_hit
    assert chances is not None
    if least is not None:
        rows = np.flatnonzero(found.safe & ~(chances.hit >= least))  # what is not known is not enough
        target = np.full(len(rows), case.target_structure, dtype=object)
        found = _rejected(found, rows, Reason.HIT_UNLIKELY, target, chances.hit[rows])
    limits = np.array([touch_limit(case, name) for name in chances.structures])
    touch = np.where(np.isnan(chances.touch), np.inf, chances.touch)  # nor is it little enough
    with np.errstate(invalid="ignore"):  # without a limit both may be infinite
        beyond = np.where(touch > limits, touch - limits, -np.inf)
    rows = np.flatnonzero(found.safe & (beyond > 0).any(axis=1))
    worst = beyond[rows].argmax(axis=1) if len(rows) else rows
    names = np.array(chances.structures, dtype=object)[worst]
    return _rejected(found, rows, Reason.TOUCH_LIKELY, names, chances.touch[rows, worst])


def _rejected(found: Candidates, rows: Ints, reason: Reason, structure: Texts, amount: Floats) -> Candidates:
    """With some rows rejected: each by a structure, shape (m,), and a number, shape (m,)."""
    arrays = {field.name: getattr(found.verdict, field.name).copy() for field in fields(found.verdict)}
    arrays["reason"][rows], arrays["structure"][rows], arrays["amount"][rows] = reason.value, structure, amount
    return replace(found, verdict=Verdict(**arrays))
