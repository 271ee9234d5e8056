"""Which of the candidates that the organs allow the arm can reach and insert along."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from itertools import repeat

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.reach.answer import ReachRequest
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.reach.standoff import standoffs
from puncture_twin.planning.search.candidates import ARM_CHECKED, ArmColumns, Candidates, Verdict


@dataclass(frozen=True, eq=False)
class ArmReach:
    """Checks whether the arm reaches a candidate: the workcell, and where the patient is in it."""

    checker: CellChecker
    T_base_ct: Floats


def with_reach(case: Case, found: Candidates, reach: ArmReach, progress: Count | None = None) -> Candidates:
    """Check the arm for every candidate that the organs allow; progress counts the checked ones."""
    rows = np.flatnonzero(found.safe)
    requests = reach_requests(case, found, rows, reach.T_base_ct)
    answers = assess_reach_all(reach.checker, requests, progress)
    verdict = {field.name: getattr(found.verdict, field.name).copy() for field in fields(found.verdict)}
    reachable, margin, q_insertion = (getattr(found.arm, field.name).copy() for field in fields(found.arm))
    for row, request, answer in zip(rows, requests, answers, strict=True):
        reachable[row] = int(answer.reachable)
        margin[row] = answer.margin
        if answer.reachable:
            q_insertion[row] = answer.insertion_q[-1]
        else:
            verdict["reason"][row], verdict["detail"][row] = answer.reason.value, answer.detail
            verdict["structure"][row] = "" if answer.contact is None else "/".join(answer.contact)
            inserted = answer.depth_mm  # the tip's distance from the target is what is left of the standoff
            verdict["depth"][row] = np.nan if inserted is None else request.standoff_mm - inserted
    return replace(
        found, verdict=Verdict(**verdict), arm=ArmColumns(reachable, margin, q_insertion), arm_note=ARM_CHECKED
    )


def reach_request(case: Case, candidates: Candidates, row: int, T_base_ct: Floats) -> ReachRequest:
    """What the arm has to reach for one candidate."""
    return reach_requests(case, candidates, np.array([row]), T_base_ct)[0]


def reach_requests(case: Case, candidates: Candidates, rows: Ints, T_base_ct: Floats) -> list[ReachRequest]:
    """What the arm has to reach for some candidates."""
    R, target = T_base_ct[:3, :3], T_base_ct[:3, :3] @ case.target_ct + T_base_ct[:3, 3]
    lengths = standoffs(case.needle, candidates.path.length[rows], candidates.path.skin_angle[rows]).tolist()
    outward = [R @ candidates.outward_ct[row] for row in rows]
    return [ReachRequest(target, *of_row) for of_row in zip(outward, repeat(case.needle.length_mm), lengths)]
