"""A verdict with what is rejected at one position of the breath."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from puncture_twin.planning.base.arrays import Ints
from puncture_twin.planning.base.reasons import REASON_TEXT, Reason
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.search.candidates import Verdict
from puncture_twin.planning.search.phases.one_phase import CLEARANCES


def rejected_at(verdict: Verdict, rows: Ints, at_phase: Verdict, breathing: Breathing, s: float) -> Verdict:
    """A verdict with what is rejected at one phase; what is rejected already keeps its reason.

    Args:
        verdict: Of n candidates.
        rows: Shape (m,), those that were checked at the phase.
        at_phase: Of these m.
        breathing: For the words.
        s: The phase's position.
    """
    new = (at_phase.reason != Reason.NONE.value) & (verdict.reason[rows] == Reason.NONE.value)
    arrays = {field.name: getattr(verdict, field.name).copy() for field in fields(verdict)}
    near = np.isin(at_phase.reason[new], CLEARANCES)
    arrays["structure"][rows[new]], arrays["depth"][rows[new]] = at_phase.structure[new], at_phase.depth[new]
    arrays["amount"][rows[new]] = np.where(near, at_phase.amount[new], np.nan)
    arrays["reason"][rows[new]] = Reason.UNSAFE_WHEN_BREATHING.value
    for row, reason, more in zip(rows[new], at_phase.reason[new], at_phase.detail[new], strict=True):
        arrays["detail"][row] = f"at {breathing.phase_text(s)}: {REASON_TEXT[Reason(reason)]}{more and f', {more}'}"
    return Verdict(**arrays)
