"""Which two paths are compared: two choices of one case, or two plans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_document import MAX_PLAN_BYTES, parse_plan
from puncture_twin.planning.plan.recheck import check_plan
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.selection.choice import Choice, parse_choice
from puncture_twin.planning.search.selection.windows import find_windows, nearest_row
from puncture_twin.twin.jobs.choosing.comparison import Comparison, OnGrid, Side
from puncture_twin.twin.jobs.patient.answers import explain_choice
from puncture_twin.twin.jobs.patient.case_or_plan import is_plan

SAME_DIRECTION = 1e-9
"""Radians within which a direction is one of the grid: rounding of typed degrees."""

MOST_ROLES = 4
"""Of inputs that differ, so many are named."""

BEST_OF_ALL = Choice(rank=1)


def parse_two(
    theta_deg: Sequence[float],
    beta_deg: Sequence[float],
    rank: Sequence[int],
    window: Sequence[int],
    entry: Sequence[str],
) -> tuple[Choice, Choice]:
    """Two choices from options that may be repeated, in their order in the help; of one the best stands beside it.

    Raises:
        InputError: None or more than two, or one angle alone.
    """
    if len(theta_deg) != len(beta_deg):
        raise InputError("one angle alone gives no direction", where="--theta, --beta", allowed="both, as often")
    choices = [parse_choice(*pair, None, None, None) for pair in zip(theta_deg, beta_deg, strict=True)]
    choices += [parse_choice(None, None, one, None, None) for one in rank]
    choices += [parse_choice(None, None, None, one, None) for one in window]
    choices += [parse_choice(None, None, None, None, one) for one in entry]
    if len(choices) == 1:
        choices = [BEST_OF_ALL, *choices]
    if len(choices) == 2 and choices[0] == choices[1]:
        raise InputError("the same direction twice", where="compare", allowed="two, or one that is not the best")
    if len(choices) != 2:
        allowed = "two, such as --rank 1 --window 2, or one, which is compared with the best"
        raise InputError(f"{len(choices)} choices", where="compare", allowed=allowed)
    return choices[0], choices[1]


def two_plans(source: Path, other: Path | None, case: Path | None, chosen: bool) -> tuple[Path, Path] | None:
    """The two plans that are to be compared; None where it is two choices of a case.

    Raises:
        InputError: One plan alone, a plan beside a case, or a plan beside a choice.
    """
    allowed = "PLAN_A PLAN_B [--case CASE], or CASE with one choice or two"
    if not is_plan(source):
        if other is not None or case is not None:
            raise InputError("a case and another file", where="compare", allowed=allowed)
        return None
    if other is None or not is_plan(other) or chosen:
        raise InputError("a plan is compared with a plan", where=source, allowed=allowed)
    return source, other


def compare_choices(context: CaseContext, choices: tuple[Choice, Choice]) -> Comparison:
    """Two directions of a case, each checked, beside what the search says of them.

    Raises:
        InputError: A rank or window that there is not, or a point that is no skin entry.
        NoAnswerError: Nothing is safe, so that there are no ranks.
    """
    found = context.search()
    a, b = (_chosen_side(context, found, choice) for choice in choices)
    read = [one for side in (a, b) if side.explained is not None for one in side.explained.read]
    return Comparison(context.case.name, (*read, *context.case.inputs), a, b, tuple(context.anatomy.warnings))


def compare_plans(paths: tuple[Path, Path], context: CaseContext | None) -> Comparison:
    """Two plans; with their case each is checked again.

    Raises:
        InputError: A plan that cannot be used, or does not hold any more.
    """
    read = [_read(path) for path in paths]
    inputs = tuple(source for source, _ in read)
    plans = [plan for _, plan in read]
    if context is None:
        a, b = (_stated_side(path, plan) for path, plan in zip(paths, plans, strict=True))
        names = sorted({plan.case_name for plan in plans})
        read_by_both = (*inputs, *plans[0].inputs, *plans[1].inputs)
        return Comparison(" and ".join(names), read_by_both, a, b, _differing(*plans))
    found = context.search()
    a, b = (_planned_side(context, found, path, plan) for path, plan in zip(paths, plans, strict=True))
    return Comparison(context.case.name, (*inputs, *context.case.inputs), a, b, tuple(context.anatomy.warnings))


def _differing(a: Plan, b: Plan) -> tuple[str, ...]:
    """That two plans were made from different files: of another patient, or before and after a change."""
    ours, theirs = ({one.role: one.sha256 for one in plan.inputs} for plan in (a, b))
    roles = sorted(role for role in ours.keys() | theirs.keys() if ours.get(role) != theirs.get(role))
    if not roles:
        return ()
    more = f" and {len(roles) - MOST_ROLES} more" if len(roles) > MOST_ROLES else ""
    return (f"the plans were not made from the same files ({', '.join(roles[:MOST_ROLES])}{more}): is it one case?",)


def _read(path: Path) -> tuple[Input, Plan]:
    found = read_output(path, max_bytes=MAX_PLAN_BYTES)
    return found.input("plan"), parse_plan(found.data, path)


def _chosen_side(context: CaseContext, found: Candidates, choice: Choice) -> Side:
    explained = explain_choice(context, choice, found)
    row = explained.candidates
    grid = _on_grid(found, row.outward_ct[0], safe=explained.safe)
    return Side(choice.text(context.case.space), row.outward_ct[0], row.path.entry_ct[0], explained, grid)


def _stated_side(path: Path, plan: Plan) -> Side:
    return Side(f"{path}", plan.outward_ct, plan.entry_ct, plan=plan)


def _planned_side(context: CaseContext, found: Candidates, path: Path, plan: Plan) -> Side:
    """A plan that holds; its chances are those of the configuration in which it ends."""
    check_plan(plan, context, path, seed=context.case.rehearsal.seed)
    explained = context.explain(plan.theta, plan.beta)
    explained = replace(explained, doubt=context.doubt_at(plan.outward_ct, plan.insertion.q[-1]))
    grid = _on_grid(found, plan.outward_ct, safe=True)
    return replace(_stated_side(path, plan), explained=explained, grid=grid)


def _on_grid(found: Candidates, outward_ct: Floats, *, safe: bool) -> OnGrid:
    """What the search says of a direction, or of the one of its grid beside it."""
    row = nearest_row(found, outward_ct)
    if row is None or not (safe and found.safe[row]):
        return OnGrid(None, float("nan"), None)
    windows = find_windows(found)
    window = windows.windows[int(windows.of_row[row]) - 1]
    if np.linalg.norm(found.outward_ct[row] - outward_ct) > SAME_DIRECTION:
        return OnGrid(None, float("nan"), window)
    return OnGrid(int(found.ranking.rank[row]), float(found.safe_cone[row]), window)
