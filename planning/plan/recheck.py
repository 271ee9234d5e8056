"""A plan, compared with its case again: same inputs, same verdict, and a motion that FCL finds free."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.plan.plan import Plan, motion_contact, phase_clearances
from puncture_twin.planning.plan.plan_check import check_angles, check_inputs, same_arm
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import reason_text
from puncture_twin.planning.uncertainty.chance_model import satisfies_limits
from puncture_twin.planning.uncertainty.pose_error import expected_error_mm

SAME_DIRECTION = 1e-6
"""Largest difference of two unit vectors that name one direction: degrees in the file are rounded to 1e-15."""


SAME_NUMBER_MM = 1e-4
"""A number that is computed again may differ by this: FCL's own threshold."""


def check_plan(plan: Plan, context: CaseContext, path: Path, *, seed: int | None = None) -> Candidates:
    """Check a loaded plan's direction and motion anew.

    Args:
        seed: That the plan must state: the command ``plan`` takes the case's. None where code chose another.

    Returns:
        The candidate of the plan, checked.

    Raises:
        InputError: The inputs changed, the direction is not safe any more, or the motion touches something.
    """
    check_inputs(plan, context.case, path)
    if not same_arm(plan.model, context.case.robot.model):
        refuse("its arm differs from the case's", path, "plan again", "plan_of_another")
    if context.reach is None or not np.array_equal(plan.T_base_ct, context.reach.T_base_ct):
        refuse("T_base_ct differs from the case's", path, "plan again", "plan_of_another")
    candidates = context.check(plan.theta, plan.beta)
    if not np.allclose(candidates.outward_ct[0], plan.outward_ct, atol=SAME_DIRECTION):
        refuse("outward_ct is not the direction of theta_deg, beta_deg", path, "plan again", "plan_contradicted")
    if not candidates.safe[0]:
        refuse(f"its direction is rejected now: {reason_text(candidates, 0)}", path, "plan again", "direction_rejected")
    _check_limits(plan, context, path)
    if seed is not None:
        _check_same("seed", plan.seed, seed, path)
    _check_labels(plan, context, candidates, path)
    _check_warnings(plan, context, path)
    check_angles(plan, path)
    touched = motion_contact(plan, context.reach.checker)
    if touched is not None:
        refuse(f"its {touched}", path, "a motion without contact", "motion_touches")
    for phase, known in phase_clearances(plan, context.reach.checker).items():
        _check_same(f"clearance_mm.{phase}", plan.clearance_mm.get(phase, np.nan), known, path)
    return candidates


def _check_warnings(plan: Plan, context: CaseContext, path: Path) -> None:
    """Refuse a plan that states other warnings than its case has: people decide by them."""
    if plan.warnings != context.anatomy.warnings:
        apart = set(plan.warnings) ^ set(context.anatomy.warnings)
        shown = f", such as '{min(apart)}'" if apart else ""
        refuse(f"its warnings differ from the case's{shown}", path, "plan again", "plan_of_another")


def _check_limits(plan: Plan, context: CaseContext, path: Path) -> None:
    """Refuse a plan that ends in a configuration beyond the case's limits of chances: the search's may be another."""
    if context.chance is None:
        return
    if not satisfies_limits(context.chance, plan.outward_ct[None], plan.insertion.q[-1:]).all():
        what = "its final configuration does not keep search.min_hit and max_touch"
        refuse(what, path, "plan again", "limits_not_kept")


def _check_labels(plan: Plan, context: CaseContext, candidates: Candidates, path: Path) -> None:
    """Refuse a plan whose own numbers differ from the case's: people read them."""
    case, placement = context.case, context.placement
    error = float("nan") if placement is None else placement.target_error_mm
    if context.chance is not None:
        error = expected_error_mm(context.chance.error, plan.insertion.q[-1])
    stated: tuple[tuple[str, Any, Any], ...] = (
        ("case", plan.case_name, case.name),
        ("robot", plan.model.name, case.robot.model.name),
        ("needle_length_mm", plan.needle_length_mm, case.needle.length_mm),
        ("target_ct_mm", plan.target_ct, case.target_ct),
        ("entry_ct_mm", plan.entry_ct, candidates.path.entry_ct[0]),
        (
            "standoff_mm",
            plan.standoff_mm,
            standoffs(case.needle, candidates.path.length[0], candidates.path.skin_angle[0]),
        ),
        ("expected_target_error_mm", plan.expected_target_error_mm, error),
        ("clearance_mm.needle", plan.clearance_mm.get("needle", np.nan), candidates.clearance.least[0]),
        ("speed_limits", plan.speeds, case.robot.speeds),
        ("the approach's first row", plan.approach.q[0], home_configuration(case)),
    )
    for name, said, known in stated:
        _check_same(name, said, known, path)


def _check_same(name: str, said: Any, known: Any, path: Path) -> None:
    """Refuse a stated number that is another when it is computed again; in a file, no number is null."""
    if isinstance(known, str | int):
        same = said == known
    else:
        said, known = (np.where(np.isfinite(value), value, np.nan) for value in (said, known))
        same = np.allclose(said, known, rtol=0, atol=SAME_NUMBER_MM, equal_nan=True)
    if not same:
        refuse(f"{name} is {said}, but the case gives {known}", path, "plan again", "plan_of_another")
