"""The batch search: a case in, one judged row per direction out."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.skin_entry import skin_paths
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions, direction, grid
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.clearance.measure import measure
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.reach.reach import ReachRequest, assess_reach_all
from puncture_twin.planning.reach.standoff import axis_lengths, farthest_flange, standoffs
from puncture_twin.planning.search.candidates import (
    ARM_CHECKED,
    ArmColumns,
    Candidates,
    Clearance,
    Path,
    Ranking,
    Verdict,
)
from puncture_twin.planning.search.chance import ChanceModel, with_best_refined, with_chances, with_joint_chances
from puncture_twin.planning.search.constraints import judge
from puncture_twin.planning.search.ranking import rank
from puncture_twin.planning.search.tissue import tissue_crossed


@dataclass(frozen=True, eq=False)
class ArmReach:
    """Who answers whether the arm can hold a candidate: the checked room, and where the patient is in it."""

    checker: CellChecker
    T_base_ct: Floats


def case_directions(case: Case) -> Directions:
    """The grid that the case asks for."""
    settings = case.search
    return grid(settings.theta, settings.beta, settings.step, case.T_ct_entry[:3, :3])


def one_direction(case: Case, theta: float, beta: float) -> Directions:
    """A single direction (rad) of the case's entry frame."""
    return direction(theta, beta, case.T_ct_entry[:3, :3])


def search(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    directions: Directions,
    *,
    reach: ArmReach | None = None,
    chance: ChanceModel | None = None,
    progress: Count | None = None,
) -> Candidates:
    """Judge every direction against the organs, those that pass against the arm, and rank what is left.

    Args:
        case: The validated case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``, in that order.
        directions: What to judge.
        reach: Who answers for the arm; None leaves ``reachable`` unasked.
        chance: Of the case's declared errors; None leaves the chances blank.
        progress: Called with (candidates asked, candidates to ask) while the arm is checked.
    """
    found = organ_candidates(case, anatomy, engine, directions)
    if reach is not None:
        found = with_reach(case, found, reach, progress)
    found = ranked(case, with_chances(case, anatomy, engine, found, chance))
    found = with_best_refined(case, anatomy, engine, found, chance, ranked)
    return with_joint_chances(case, anatomy, engine, found, chance)


def organ_candidates(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> Candidates:
    """Judge every direction against skin and organs alone; nothing is ranked yet."""
    needle, outward = case.needle, directions.outward_ct
    checked, farthest = anatomy.checked, farthest_flange(needle, case.search.max_skin_angle)
    paths = skin_paths(anatomy.skin, case.target_ct, outward, needle.length_mm, farthest)
    lengths = axis_lengths(case, checked)
    clearances = measure(engine, checked, case.target_ct, outward, length=lengths, radius=needle.radius_mm)
    verdicts = judge(paths, clearances, checked, needle=needle, max_skin_angle=case.search.max_skin_angle)
    demanding = np.array([s.demands_margin for s in checked], bool)
    count = len(directions)
    return Candidates(
        theta=directions.theta,
        beta=directions.beta,
        outward_ct=outward,
        verdict=verdicts,
        path=Path(
            entry_ct=paths.entry_ct,
            length=paths.path_length,
            skin_angle=paths.skin_angle,
            tissue=tissue_crossed(checked, case.target_structure, case.target_ct, outward, paths.path_length),
        ),
        clearance=Clearance(
            structures=tuple(s.name for s in checked),
            margins=np.array([s.margin_mm if s.demands_margin else np.nan for s in checked]),
            distance=clearances.clearance,
            least=clearances.clearance[:, demanding].min(axis=1, initial=np.inf),
        ),
        arm=ArmColumns.unknown(count),
        ranking=Ranking.none(count),
        safe_cone=np.full(count, np.nan),
    )


def reach_request(case: Case, candidates: Candidates, row: int, T_base_ct: Floats) -> ReachRequest:
    """What the arm is asked to hold for one candidate."""
    return ReachRequest(
        target_base=T_base_ct[:3, :3] @ case.target_ct + T_base_ct[:3, 3],
        outward_base=T_base_ct[:3, :3] @ candidates.outward_ct[row],
        needle_length_mm=case.needle.length_mm,
        standoff_mm=float(standoffs(case.needle, candidates.path.length[row], candidates.path.skin_angle[row])),
    )


def with_reach(case: Case, found: Candidates, reach: ArmReach, progress: Count | None = None) -> Candidates:
    """Ask the arm for every candidate that the organs allow."""
    rows = np.flatnonzero(found.safe)
    requests = [reach_request(case, found, int(row), reach.T_base_ct) for row in rows]
    answers = assess_reach_all(reach.checker, requests, progress)
    verdict = {field.name: getattr(found.verdict, field.name).copy() for field in fields(found.verdict)}
    reachable, margin, q_insertion = (getattr(found.arm, field.name).copy() for field in fields(found.arm))
    for row, answer in zip(rows, answers, strict=True):
        reachable[row] = int(answer.reachable)
        margin[row] = answer.margin
        if answer.reachable:
            q_insertion[row] = answer.insertion_q[-1]
        else:
            verdict["reason"][row], verdict["detail"][row] = answer.reason.value, answer.detail
            verdict["structure"][row] = "" if answer.contact is None else "/".join(answer.contact)
            depth = answer.depth_mm
            verdict["depth"][row] = np.nan if depth is None else reach_depth(case, found, int(row), depth)
    return replace(
        found, verdict=Verdict(**verdict), arm=ArmColumns(reachable, margin, q_insertion), arm_note=ARM_CHECKED
    )


def reach_depth(case: Case, found: Candidates, row: int, inserted_mm: float) -> float:
    """Where the tip stands, from the target along the needle, after so many mm of insertion; mm."""
    return float(standoffs(case.needle, found.path.length[row], found.path.skin_angle[row])) - inserted_mm


def ranked(case: Case, found: Candidates) -> Candidates:
    """Give cost, rank and Pareto mark to the safe candidates."""
    rows = np.flatnonzero(found.safe)
    order = rank(
        min_clearance=found.clearance.least[rows],
        path_length=found.path.length[rows],
        skin_angle=found.path.skin_angle[rows],
        tissue=found.path.tissue[rows],
        reach_margin=found.arm.margin[rows],
        safe_cone=found.safe_cone[rows],
        shaft=case.needle.shaft_mm,
        max_skin_angle=case.search.max_skin_angle,
        weights=case.ranking,
        touch_chance=None if found.chances is None else found.chances.touch_any[rows],
    )
    blank = Ranking.none(len(found))
    cost, ranks, pareto = blank.cost.copy(), blank.rank.copy(), blank.pareto.copy()
    cost[rows], ranks[rows], pareto[rows] = order.cost, order.rank, order.pareto
    return replace(found, ranking=Ranking(cost, ranks, pareto))


def ranked_by(found: Candidates, cost: Floats) -> Candidates:
    """The safe candidates ranked by a cost of the caller's, smaller is better; equal costs keep their order.

    Args:
        found: Candidates.
        cost: Shape (n,); rejected candidates' entries are not looked at.

    Raises:
        InputError: Another shape, or a safe candidate whose cost is not finite.
    """
    rows = np.flatnonzero(found.safe)
    if cost.shape != (len(found),) or not np.isfinite(cost[rows]).all():
        allowed = f"shape ({len(found)},), finite for the {len(rows)} safe candidates"
        raise InputError(f"a cost of shape {cost.shape}", where="rerank", allowed=allowed)
    ranks = np.zeros(len(found), np.int32)
    ranks[rows[np.argsort(cost[rows], kind="stable")]] = np.arange(1, len(rows) + 1)
    ranking = Ranking(np.where(found.safe, cost, np.nan), ranks, found.ranking.pareto)
    return replace(found, ranking=ranking)


def closest_miss(found: Candidates) -> int | None:
    """Row of the rejected candidate that came closest: the least lack of clearance among those that lack only that.

    Without such a row, the one that passed most constraints; None for no rows at all.
    """
    lacking = np.flatnonzero(found.verdict.reason == Reason.TOO_CLOSE.value)
    if len(lacking):
        demanded = ~np.isnan(found.clearance.margins)
        lack = (found.clearance.margins - found.clearance.distance)[:, demanded].max(axis=1)
        return int(lacking[np.argmin(lack[lacking])])
    chances = (Reason.TOUCH_LIKELY, Reason.HIT_UNLIKELY)
    order = (*chances, Reason.APPROACH_NOT_FOUND, Reason.INSERTION_BLOCKED, Reason.ARM_COLLISION, Reason.UNREACHABLE)
    for reason in (*order, Reason.SKIN_ANGLE, Reason.TOO_LONG, Reason.REENTERS_SKIN, Reason.UNKNOWN_REGION):
        rows = np.flatnonzero(found.verdict.reason == reason.value)
        if len(rows):
            return int(rows[0])
    return None
