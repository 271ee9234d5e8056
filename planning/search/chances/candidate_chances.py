"""Chances of a search's candidates, and their refusal where a chance breaks the case's limit.

To first order for all; by line sampling where that may decide: from near a limit on, and for what people are shown.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.clearance.engine import AxisDistances
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.limited import limited
from puncture_twin.planning.search.chances.refined import ROWS_AT_ONCE, refined_near_limits
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.chances import Chances
from puncture_twin.planning.uncertainty.limits import check_limits, demanding


def with_chances(
    case: Case,
    anatomy: Anatomy,
    found: Candidates,
    model: ChanceModel | None,
    axes: AxisDistances | None = None,
) -> Candidates:
    """Compute the chances of all candidates that geometry and reach left, and reject those beyond the case's limits.

    Args:
        case: Declares errors; else nothing is computed.
        anatomy: Its structures.
        found: Checked against organs and arm.
        model: None where the pose's error is not known: the chances are blank.
        axes: What the engine measured of the candidates; None measures those that are left again.

    Raises:
        InputError: A limit that nothing can be compared with.
    """
    if case.errors is None:
        return found
    check_limits(case, anatomy, model is not None)
    names = tuple(anatomy.checked[column].name for column in demanding(anatomy.checked))
    rows = np.flatnonzero(found.safe & np.isfinite(found.arm.q_insertion).all(axis=1))
    if model is None or not len(rows):
        return replace(found, chances=Chances.unknown(names, len(found)))
    parts = [rows[start : start + ROWS_AT_ONCE] for start in range(0, len(rows), ROWS_AT_ONCE)]
    computed = [
        model.chances(found.outward_ct[part], found.arm.q_insertion[part], None if axes is None else axes.at(part))
        for part in parts
    ]
    chances = Chances.unknown(names, len(found))
    for part, of_part in zip(parts, computed, strict=True):
        chances = chances.put(part, of_part)
    return limited(case, refined_near_limits(replace(found, chances=chances), model))
