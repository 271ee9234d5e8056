"""A plan, against its case again."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision_cases.finding import Difference, Finding
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.planning.plan.recheck import check_plan
from puncture_twin.planning.search.context import CaseContext


def plan_finding(path: Path, context: CaseContext) -> Finding:
    """Whether a plan holds: same inputs, its direction safe, its motion free of contact, its numbers those of the case.

    Args:
        path: The plan's file.
        context: Its case, with the arm.
    """
    try:
        check_plan(read_plan(path), context, path)
    except InputError as error:
        return Finding((Difference(f"the plan does not hold: {error.what}"),), (f"{error.where}: {error.allowed}",))
    return Finding()
