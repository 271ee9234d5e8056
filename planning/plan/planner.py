"""From ranked candidates to a plan: the best candidate that the arm can approach.

A plan is a pose, an approach from home to the standoff and an insertion, both timed. What `_plan` returns has been
checked as it will be when it is loaded.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import slowed
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.plan.plan import Plan, motion_contact, phase_clearances
from puncture_twin.planning.reach.reach import ReachAnswer, approach_goals
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances import satisfies_limits
from puncture_twin.planning.search.choice import BEST, Choice, choose
from puncture_twin.planning.search.constraints import reach_request
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import reason_text
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.pose_error import expected_error_mm

MAX_TRIES = 20
"""Candidates to which an approach is sought: where none of the best twenty allows one, the workcell is the cause."""


class Planned(NamedTuple):
    """A plan, the row that it is for, and the candidates, those without an approach now rejected."""

    plan: Plan
    candidates: Candidates
    row: int


def make_plan(
    context: CaseContext, candidates: Candidates | None, choice: Choice = BEST, *, seed: int | None = None
) -> Planned:
    """Plan to the best candidate of a choice for which an approach is found.

    Args:
        candidates: The case's search result, which a choice by angles or by entry does not need; None searches.
        seed: Of the approach's planner; None takes the case's.

    Raises:
        InputError: The case does not say where the arm's base is, or there is nothing of what was chosen.
        NoAnswerError: No candidate is safe, what was chosen is rejected, or none of the best can be approached.
    """
    context.require_arm()
    seed = context.case.rehearsal.seed if seed is None else seed
    candidates, rows = choose(context, candidates, choice)
    last = "no candidate is safe"
    for row in rows[:MAX_TRIES]:
        try:
            plan = _plan(context, candidates, int(row), seed)
        except NoAnswerError as error:
            last = str(error)
            why = {"reason": Reason.APPROACH_NOT_FOUND.value, "detail": last}
            candidates = replace(candidates, verdict=candidates.verdict.with_rows(np.array([row]), **why))
            candidates = ranked(context.case, candidates)
            continue
        return Planned(plan, candidates, int(row))
    raise NoAnswerError(f"no plan: {last}", counts=candidates.counts(), code="no_plan")


def _plan(context: CaseContext, candidates: Candidates, row: int, seed: int) -> Plan:
    assert context.reach is not None and context.placement is not None  # the caller has refused this
    case, checker = context.case, context.reach.checker
    # 0. The direction, checked anew: candidates may be of another engine, or changed; here they are an order alone.
    candidates = context.check(candidates.theta[row], candidates.beta[row])
    if not candidates.safe[0]:
        raise NoAnswerError(f"its direction is rejected: {reason_text(candidates, 0)}", code="direction_rejected")
    # 1. The approach: from home to the standoff, in any of the arm's configurations that keep the limits of chances.
    request = reach_request(case, candidates, 0, context.reach.T_base_ct)
    home, speeds = home_configuration(case), case.robot.speeds
    goals = _within_limits(context, candidates.outward_ct[0], approach_goals(checker, request, home))
    approach = plan_approach(checker, home, np.array([goal.insertion_q[0] for goal in goals]), seed=seed, speeds=speeds)
    answer = goals[approach.goal_index]
    # The tip's error is that of all declared errors, else of the markers alone.
    chance, q_end = context.chance, answer.insertion_q[-1]
    error_mm = context.placement.target_error_mm if chance is None else expected_error_mm(chance.error, q_end)
    # 2. The plan, with the insertion from that configuration in time.
    plan = Plan(
        case_name=case.name,
        inputs=case.inputs,
        seed=seed,
        model=case.robot.model,
        T_base_ct=context.placement.T_base_ct,
        expected_target_error_mm=error_mm,
        theta=float(candidates.theta[0]),
        beta=float(candidates.beta[0]),
        entry_ct=candidates.path.entry_ct[0],
        target_ct=case.target_ct,
        outward_ct=candidates.outward_ct[0],
        roll=answer.roll,
        standoff_mm=request.standoff_mm,
        needle_length_mm=case.needle.length_mm,
        approach=approach.trajectory,
        insertion=follow_smoothly(
            slowed(checker.model, speeds),
            answer.insertion_q,
            answer.insertion_depth_mm,
            max_tip_speed_mm_s=speeds.insertion_speed_mm_s,
        ),
        clearance_mm={"needle": float(candidates.clearance.least[0])},
        speeds=speeds,
        warnings=context.anatomy.warnings,
    )
    # 3. The check of the timed motions, whole, and their least clearances.
    touched = motion_contact(plan, checker)
    if touched is not None:
        raise NoAnswerError(touched, code="motion_touches")
    return replace(plan, clearance_mm={**phase_clearances(plan, checker), **plan.clearance_mm})


def _within_limits(context: CaseContext, outward_ct: Floats, goals: list[ReachAnswer]) -> list[ReachAnswer]:
    """The configurations of a direction that keep the case's limits of chances; the search has checked one alone."""
    if context.chance is None or not goals:
        return goals
    q = np.array([goal.insertion_q[-1] for goal in goals])
    satisfied = satisfies_limits(context.chance, np.tile(outward_ct, (len(goals), 1)), q)
    if not satisfied.any():
        what = "no configuration at the end of an approach keeps search.min_hit and max_touch"
        raise NoAnswerError(what, code="limits_not_kept")
    return [goal for goal, keeps in zip(goals, satisfied, strict=True) if keeps]
