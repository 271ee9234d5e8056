"""A plan, held against its case again: same inputs, same verdict, and a motion that FCL finds free."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from planning.approach import FINER, RESOLUTION_RAD, dense_states
from planning.candidates import Candidates
from planning.errors import InputError
from planning.explain import reason_text
from planning.plan import Plan, check_inputs
from planning.prepared import Prepared
from planning.robot.cell import CellChecker
from planning.standoff import standoffs

Floats = NDArray[np.float64]

SAME_DIRECTION = 1e-6
"""Largest difference of two unit vectors that name one direction: degrees in the file are rounded to 1e-15."""


SAME_NUMBER_MM = 1e-4
"""A number that is computed again may differ by this: FCL's own threshold."""


def check_plan(plan: Plan, prepared: Prepared, path: Path) -> Candidates:
    """Judge a loaded plan's direction and motion anew.

    Returns:
        The candidate of the plan, judged.

    Raises:
        InputError: The inputs changed, the direction is not safe any more, or the motion touches something.
    """
    check_inputs(plan, prepared.case, path)
    if prepared.reach is None or not np.array_equal(plan.T_base_ct, prepared.reach.T_base_ct):
        raise InputError("T_base_ct is not the case's", where=path, allowed="plan again")
    candidates = prepared.check(plan.theta, plan.beta)
    if not np.allclose(candidates.outward_ct[0], plan.outward_ct, atol=SAME_DIRECTION):
        raise InputError("outward_ct is not the direction of theta_deg, beta_deg", where=path, allowed="plan again")
    if not candidates.safe[0]:
        raise InputError(f"its direction is rejected: {reason_text(candidates, 0)}", where=path, allowed="plan again")
    _check_labels(plan, prepared, candidates, path)
    touched = motion_contact(plan, prepared.reach.checker)
    if touched is not None:
        raise InputError(f"its {touched}", where=path, allowed="a motion that touches nothing")
    return candidates


def _check_labels(plan: Plan, prepared: Prepared, candidates: Candidates, path: Path) -> None:
    """Refuse what a plan says of itself where the case says otherwise: people read these numbers."""
    case, placement = prepared.case, prepared.placement
    error = float("nan") if placement is None else placement.target_error_mm
    stated: tuple[tuple[str, Any, Any], ...] = (
        ("case", plan.case_name, case.name),
        ("robot", plan.model, case.robot.model),
        ("needle_length_mm", plan.needle_length_mm, case.needle.length_mm),
        ("target_ct_mm", plan.target_ct, case.target_ct),
        ("entry_ct_mm", plan.entry_ct, candidates.entry_ct[0]),
        ("standoff_mm", plan.standoff_mm, standoffs(case.needle, candidates.path_length[0], candidates.skin_angle[0])),
        ("expected_target_error_mm", plan.expected_target_error_mm, error),
        ("clearance_mm.needle", plan.clearance_mm.get("needle", np.nan), candidates.min_clearance[0]),
    )
    for name, said, known in stated:
        same = (
            said == known if isinstance(known, str) else np.allclose(said, known, atol=SAME_NUMBER_MM, equal_nan=True)
        )
        if not same:
            raise InputError(f"{name} is {said}, the case gives {known}", where=path, allowed="plan again")


def motion_contact(plan: Plan, checker: CellChecker) -> str | None:
    """What a plan's motion touches, in words, or None: FCL at ten times the planner's resolution."""
    for phase, q, needle_free in (("approach", plan.approach.q, False), ("insertion", plan.insertion.q, True)):
        contact = _contact(checker, q, needle_free)
        if contact is not None:
            return f"{phase} is not free: {contact}"
    return None


def _contact(checker: CellChecker, q_path: Floats, needle_free: bool) -> str | None:
    """What touches what along a motion, checked as densely as when it was planned; None if nothing does."""
    for q in dense_states(checker, q_path, RESOLUTION_RAD / FINER):
        contact = CellChecker.contact(checker, q, needle_may_touch_patient=needle_free)  # FCL alone, no bounds
        if contact is not None:
            return f"{contact.body} touches {contact.other}"
    return None
