"""Directions on which a needle that bends, to any side, may come into a margin.

The shaft is nowhere further from its straight axis than the bound of its path's length, so a clearance of margin and
bound is enough whatever side the bevel points to.
"""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.needle.deflection import DeflectionBound
from puncture_twin.planning.search.candidates import Candidates, Verdict


def with_bending(anatomy: Anatomy, found: Candidates, bound: DeflectionBound | None) -> Candidates:
    """Reject what lacks the clearance to bend; nothing that was rejected becomes safe.

    Args:
        anatomy: The structures of ``found``.
        found: Checked for a straight needle.
        bound: How far the needle may bend; None bends nothing.
    """
    if bound is None:
        return found
    deflection = bound.at(found.path.length)
    verdict = bent_verdict(found.verdict, anatomy.checked, found.clearance.distance, deflection)
    return replace(found, verdict=verdict, deflection=deflection)


def bent_verdict(verdict: Verdict, structures: tuple[Structure, ...], clearance: Floats, deflection: Floats) -> Verdict:
    """A verdict with those rejected whose clearance is less than a margin and the deflection.

    Args:
        verdict: Of n candidates.
        structures: The k structures.
        clearance: Shape (n, k), of the straight needle, mm.
        deflection: Shape (n,), the greatest, mm.
    """
    demanding = np.flatnonzero([one.demands_margin for one in structures])
    if not len(demanding):
        return verdict
    excess = clearance[:, demanding] - np.array([structures[column].margin_mm for column in demanding])
    nearest = demanding[excess.argmin(axis=1)]
    rows = np.flatnonzero((verdict.reason == Reason.NONE.value) & ~(excess.min(axis=1) >= deflection))
    arrays = {field.name: getattr(verdict, field.name).copy() for field in fields(verdict)}
    arrays["reason"][rows] = Reason.NEEDLE_BENDS.value
    for row in rows:
        one = structures[nearest[row]]
        arrays["structure"][row], arrays["amount"][row] = one.name, clearance[row, nearest[row]]
        arrays["detail"][row] = f"it may bend by {deflection[row]:.2f} mm, and the margin is {one.margin_mm:g} mm"
    return Verdict(**arrays)
