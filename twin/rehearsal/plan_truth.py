"""The ground truth that a plan is rehearsed with: from a file, or drawn from the declared errors (the median trial).

For the simulator the errors of markers and arm become one, where the patient lies: executed by an arm without errors,
the plan ends at the trial's own place, and rotated as there, exactly so at the target alone:

    T_base_ct_true = T_base_tip T_ct_tip^-1,   T_base_tip as planned, T_ct_tip as the trial found it
"""

from dataclasses import replace
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, Ints, rms
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.uncertainty.hit import hit_in_ball
from puncture_twin.planning.uncertainty.pose_error import pose_error
from puncture_twin.twin.plant.true_needle import AtTarget, TouchTruth, TrueNeedle, true_needle
from puncture_twin.twin.plant.truth import Truth, draw_truth
from puncture_twin.twin.rehearsal.distribution import Distribution, bend_along, rehearse_trials
from puncture_twin.twin.rehearsal.rehearsal import rehearse
from puncture_twin.twin.rehearsal.result import ErrorRank, Rehearsal
from puncture_twin.twin.rehearsal.trials import Puncture, Trials, bent

TRIED = 16
"""Trials that are drawn for one: the arm may not reach the pose that a trial's registration demands."""


def drawn_truth(puncture: Puncture, trials: Trials, row: int, seed: int, source: str) -> Truth:
    """The truth whose execution ends as one of the trials did."""
    T_base_tip = np.array(flange_pose(puncture.model, puncture.q_insertion))
    T_base_tip[:3, 3] += puncture.tip_mm * T_base_tip[:3, 2]
    T_ct_tip = np.eye(4)
    T_ct_tip[:3, :3], T_ct_tip[:3, 3] = trials.R_ct_needle[row], trials.tip_ct[row]
    T_base_ct, side = T_base_tip @ np.linalg.inv(T_ct_tip), float(trials.bevel_side[row])
    return Truth(T_base_ct, np.zeros(6), seed, source, trials.target_ct[row], side)


def plan_truth(context: CaseContext, plan: Plan, seed: int | None = None) -> Truth:
    """The truth of one rehearsal: a trial of the declared errors, unless the case states true positions or none.

    Raises:
        InputError: A file of true positions that cannot be used.
        NoAnswerError: In no trial the arm reaches the pose that its registration demands.
    """
    case = context.case
    if case.errors is None or case.registration is None or case.rehearsal.truth_base is not None:
        return bent_truth(context, plan, draw_truth(case, plan.T_base_ct, seed=seed))
    seed = case.rehearsal.seed if seed is None else seed
    distribution = rehearse_trials(context, plan.outward_ct, plan.insertion.q[-1], TRIED, seed)
    return _of_drawn(distribution, 0, f"drawn with seed {seed} from {_declared(distribution)}")


def bent_truth(context: CaseContext, plan: Plan, truth: Truth) -> Truth:
    """A truth with a needle that bends to a drawn side: the patient moved by what a straight one misses."""
    bend = bend_along(context, plan.outward_ct)
    if bend is None:
        return truth
    T = np.array(flange_pose(plan.model, plan.insertion.q[-1]))
    T[:3, 3] += plan.needle_length_mm * T[:3, 2]
    side = float(np.random.default_rng([truth.seed, 3]).uniform(0, 2 * np.pi))
    end = bent(TrueNeedle(T[None, :3, 3], T[None, :3, :3]), bend, np.array([side]))
    moved = T @ np.linalg.inv(pose(end.R_base_needle[0], end.tip_base[0])) @ truth.T_base_ct_true
    source = f"{truth.source}; the needle bends by {bend.tip_mm:.2f} mm, to a drawn side"
    return replace(truth, T_base_ct_true=moved, bevel_side=side, source=source)


def median_truth(distribution: Distribution) -> Truth:
    """The truth of the median trial by tip error; errors as of `plan_truth`."""
    count = len(distribution) + distribution.unreached + distribution.stopped
    row = int(spread_rows(distribution, 1)[0]) if len(distribution) else 0
    return _of_drawn(
        distribution,
        row,
        f"the median of {plural(count, 'trial')}, seed {distribution.seed}, from {_declared(distribution)}",
    )


def spread_rows(distribution: Distribution, count: int) -> Ints:
    """Trials spread evenly over the order of their tip errors, shape (count,) at most; the median where it is one."""
    order = np.argsort(distribution.tip_error_mm, kind="stable")
    places = ((np.arange(count) + 0.5) / count * len(order) - 0.5).round(9)
    return np.asarray(np.unique(order[np.floor(places).clip(0).astype(np.int64)]))


def _of_drawn(distribution: Distribution, row: int, source: str) -> Truth:
    if len(distribution) == 0:
        what = f"the needle reached the target in none of {distribution.unreached + distribution.stopped} trials"
        stopped = f"{distribution.stopped} stopped before a correction left the corridor"
        why = f"{distribution.unreached} beyond the arm's reach, {stopped}"
        raise NoAnswerError(f"{what}: {why}", code="out_of_reach")
    return drawn_truth(distribution.puncture, distribution.trials, row, distribution.seed, source)


def _declared(distribution: Distribution) -> str:
    return "[rehearsal.errors], not from the believed errors" if distribution.wrong_belief else "[errors]"


def error_rank(
    context: CaseContext, q_insertion: Floats, distribution: Distribution | None, tip_error_mm: float
) -> ErrorRank | None:
    """Rank of a tip error among trials, or without them in the prediction; None without declared errors."""
    if distribution is not None:
        errors = distribution.tip_error_mm
        below = np.mean(errors < tip_error_mm) + np.mean(errors <= tip_error_mm)
        return ErrorRank(float(50 * below), len(distribution) + distribution.unreached)
    registration = None if context.placement is None else context.placement.registration
    error = pose_error(context.case, registration)
    if error is None:
        return None
    outward_ct = -error.fit.R_base_ct.T @ flange_pose(error.model, q_insertion)[:3, 2]
    cov = replace(error, bend=bend_along(context, outward_ct)).tip_covariance(q_insertion[None])
    return ErrorRank(100 * float(hit_in_ball(cov, tip_error_mm, error.freedom)[0]))


def rehearse_touched(context: CaseContext, plan: Plan, truth: TouchTruth, at_target: AtTarget) -> Rehearsal:
    """Execute the puncture of touches in their ground truth, by an arm that is nominal but for its joints."""
    model, q = plan.model, plan.insertion.q[-1] + at_target.arrival
    nominal = np.array(flange_pose(model, q))
    nominal[:3, 3] += plan.needle_length_mm * nominal[:3, 2]
    needle = true_needle(model, q, truth.eta, plan.needle_length_mm)
    T_base_ct = nominal @ np.linalg.inv(pose(needle.R_base_needle, needle.tip_base)) @ truth.T_base_ct
    source = f"as at the touches, drawn with seed {truth.seed}"
    hit = Truth(T_base_ct, at_target.arrival, truth.seed, source, at_target.target_ct)
    return rehearse(plan, context.case, context.anatomy, bent_truth(context, plan, hit))


def physics_trials(
    context: CaseContext, plan: Plan, distribution: Distribution, count: int, progress: Count
) -> dict[str, Any]:
    """Some trials, spread over the order of tip errors, in the simulator: how far tips ended from the kinematics'."""
    rows = spread_rows(distribution, count)
    apart, contacts = np.empty(len(rows)), 0
    for number, row in enumerate(rows.tolist()):
        truth = drawn_truth(distribution.puncture, distribution.trials, row, distribution.seed, "a room")
        done = rehearse(plan, context.case, context.anatomy, truth)
        apart[number] = np.linalg.norm(done.tip_true_ct[-1] - distribution.trials.tip_ct[row])
        contacts += bool(done.contacts)
        progress(number + 1, len(rows))
    return {
        "rooms": len(apart),
        "largest_apart_mm": float(apart.max()),
        "rms_apart_mm": rms(apart),
        "rooms_with_contacts": contacts,
    }
