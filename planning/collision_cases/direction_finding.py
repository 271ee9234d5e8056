"""One direction, against a ``[[check]]`` table."""

from __future__ import annotations

import shlex
from collections.abc import Iterator
from decimal import ROUND_CEILING, ROUND_FLOOR

import numpy as np

from puncture_twin.planning.collision_cases.checks_file import CheckSection
from puncture_twin.planning.collision_cases.finding import Difference, Finding, NewNumber
from puncture_twin.planning.search.explain import Explanation

DIGIT = 0.1
"""Of a tolerance: a rewritten number keeps the rest of it."""

LEAST_DIGIT_MM, CHANCE_DIGIT = 0.01, 0.01
"""To which a rewritten least clearance (mm) and a rewritten chance (of itself) are rounded."""


def direction_finding(check: CheckSection, found: Explanation) -> Finding:
    """What of a direction is not as expected."""
    differences = (*_verdict(check, found), *_clearances(check, found), *_least(check, found), *_touch(check, found))
    if not differences:
        return Finding()
    case, arm = shlex.quote(str(found.case.path)), "--arm" if check.arm else "--no-arm"
    command = f"run-twin check {case} --theta {check.theta_deg:g} --beta {check.beta_deg:g} {arm} --all"
    return Finding(differences, (*found.head(), *found.structure_lines()), f"all of it: {command}")


def _verdict(check: CheckSection, found: Explanation) -> Iterator[Difference]:
    row = found.candidates.verdict
    stated = (
        ("verdict", check.verdict, found.verdict),
        ("reason", None if check.reason is None else check.reason.value, str(row.reason[0])),
        ("structure", check.structure, str(row.structure[0])),
    )
    for what, want, got in stated:
        if want is not None and want != got:
            yield Difference(f"{what}: expected {want!r}, found {got!r}")


def _clearances(check: CheckSection, found: Explanation) -> Iterator[Difference]:
    clearances = found.clearances()
    for name, want in check.clearance_mm.items():
        if name not in clearances:
            yield Difference(f"clearance of {name!r}: no such structure; there are {', '.join(clearances)}")
        elif not abs(clearances[name] - want) <= check.tolerance_mm:
            got = clearances[name]
            line = f"clearance of {name}: expected {want:g} ± {check.tolerance_mm:g} mm, found {got:.4f} mm"
            yield Difference(line, _number(NewNumber(("clearance_mm", name), got, DIGIT * check.tolerance_mm)))


def _least(check: CheckSection, found: Explanation) -> Iterator[Difference]:
    want, got = check.min_clearance_mm, float(found.candidates.least_clearance[0])
    if want is None or got >= want:
        return
    line = f"min_clearance_mm: expected at least {want:g} mm, found {got:.4f} mm, {found.nearest_demanding()}"
    yield Difference(line, _number(NewNumber(("min_clearance_mm",), got, LEAST_DIGIT_MM, ROUND_FLOOR)))


def _touch(check: CheckSection, found: Explanation) -> Iterator[Difference]:
    want, chances = check.max_touch, found.candidates.chances
    if want is None:
        return
    if found.case.errors is None:
        yield Difference("max_touch: the case declares no [errors], so that nothing says how likely a touch is")
    elif chances is None or not np.isfinite(chances.touch_any[0]):
        need = "a direction that organs and arm allow" if check.arm else "arm = true"
        yield Difference(f"max_touch: the chance to touch is not known; it takes {need}")
    elif not chances.touch_any[0] <= want:
        got = float(chances.touch_any[0])
        line = f"max_touch: expected at most {want:g}, found {got:.3g}"
        yield Difference(line, _number(NewNumber(("max_touch",), got, CHANCE_DIGIT * got, ROUND_CEILING)))


def _number(new: NewNumber) -> NewNumber | None:
    """None where there is no number to expect."""
    return new if np.isfinite(new.value) else None
