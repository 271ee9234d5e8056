"""Tables of a ``*.collision.toml`` file as tests of pytest, one a table, and how each is checked."""

import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision_cases import checks_file, session as runs
from puncture_twin.planning.collision_cases.session import Difference, Finding, NewNumber, Session, session_of, updating
from puncture_twin.planning.plan.plan_check import check_plan
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.planning.search.candidates import Candidates, nearest_row
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation, reason_text

DIGIT, LEAST_DIGIT_MM, CHANCE_DIGIT, DIGIT_SQUARE_DEG = 0.1, 0.01, 0.01, 1.0
"""Steps of rewritten numbers: a fraction of a tolerance, which keeps the rest; of a least clearance, mm; of a chance
(relative); and of an area."""
MOST_SHOWN = 6
"""Windows that a message lists at most."""


def direction_finding(check: checks_file.CheckSection, explanation: Explanation) -> Finding:
    """Differences of one direction from what is expected."""
    differences = (
        *_verdict(check, explanation),
        *_clearances(check, explanation),
        *_least(check, explanation),
        *_touch(check, explanation),
    )
    if not differences:
        return Finding()
    case, arm = shlex.quote(str(explanation.case.path)), "--arm" if check.arm else "--no-arm"
    command = f"run-twin check {case} --theta {check.theta_deg:g} --beta {check.beta_deg:g} {arm} --all"
    return Finding(differences, (*explanation.head(), *explanation.structure_lines()), f"full explanation: {command}")


def _verdict(check: checks_file.CheckSection, explanation: Explanation) -> Iterator[Difference]:
    row = explanation.candidates.verdict
    stated = (
        ("verdict", check.verdict, explanation.verdict),
        ("reason", None if check.reason is None else check.reason.value, str(row.reason[0])),
        ("structure", check.structure, str(row.structure[0])),
    )
    for what, want, got in stated:
        if want is not None and want != got:
            yield Difference(f"{what}: expected {want!r}, found {got!r}")


def _clearances(check: checks_file.CheckSection, explanation: Explanation) -> Iterator[Difference]:
    clearances = explanation.clearances()
    for name, want in check.clearance_mm.items():
        if name not in clearances:
            yield Difference(f"clearance of {name!r}: no such structure; available: {', '.join(clearances)}")
        elif not abs(clearances[name] - want) <= check.tolerance_mm:
            got = clearances[name]
            line = f"clearance of {name}: expected {want:g} ± {check.tolerance_mm:g} mm, found {got:.4f} mm"
            yield Difference(line, _number(NewNumber(("clearance_mm", name), got, DIGIT * check.tolerance_mm)))


def _least(check: checks_file.CheckSection, explanation: Explanation) -> Iterator[Difference]:
    want, got = check.min_clearance_mm, float(explanation.candidates.least_clearance[0])
    if want is not None and not got >= want:
        line = f"min_clearance_mm: expected at least {want:g} mm, found {got:.4f} mm, {explanation.nearest_demanding()}"
        yield Difference(line, _number(NewNumber(("min_clearance_mm",), got, LEAST_DIGIT_MM, ROUND_FLOOR)))


def _touch(check: checks_file.CheckSection, explanation: Explanation) -> Iterator[Difference]:
    want, chances = check.max_touch, explanation.candidates.chances
    if want is None:
        return
    if explanation.case.errors is None:
        yield Difference("max_touch: the case declares no [errors], so the chance to touch is not known")
    elif chances is None or not np.isfinite(chances.touch_any[0]):
        need = "a direction that is safe for the organs and the arm" if check.arm else "arm = true"
        yield Difference(f"max_touch: the chance to touch is not known; it needs {need}")
    elif not chances.touch_any[0] <= want:
        got = float(chances.touch_any[0])
        line = f"max_touch: expected at most {want:g}, found {got:.3g}"
        yield Difference(line, _number(NewNumber(("max_touch",), got, CHANCE_DIGIT * got, ROUND_CEILING)))


def _number(new: NewNumber) -> NewNumber | None:
    return new if np.isfinite(new.value) else None


def window_finding(window: checks_file.WindowSection, direction: Candidates, search: Candidates) -> Finding:
    """Differences of one window from what is expected."""
    differs, windows = _window_difference(window, direction, search), search.windows.windows
    listed = [f"windows: {len(windows)}"]
    for one in windows[:MOST_SHOWN]:
        listed.append(f"  {one.number}: {one.square_deg:.1f} square degrees, best at {_angles(search, one.best)}")
    return Finding() if differs is None else Finding((differs,), tuple(listed))


def _window_difference(
    window: checks_file.WindowSection, direction: Candidates, search: Candidates
) -> Difference | None:
    if not direction.safe[0]:
        return Difference(f"the direction is rejected: {reason_text(direction, 0)}")
    row = nearest_row(search, direction.outward_ct[0])
    if row is None:
        return Difference("the direction is safe but outside the grid of the case")
    if not search.safe[row]:
        return Difference(f"the nearest direction of the grid, {_angles(search, row)}: {reason_text(search, row)}")
    number = int(search.windows.of_row[row])
    want, got = window.min_square_deg, search.windows.windows[number - 1].square_deg
    line = f"its window {number}: expected at least {want:g} square degrees, found {got:.1f}"
    number_of = NewNumber(("min_square_deg",), got, DIGIT_SQUARE_DEG, ROUND_FLOOR)
    return None if got >= want else Difference(line, number_of)


def _angles(candidates: Candidates, row: int) -> str:
    at = candidates.at(row)
    return f"theta {at['theta_deg']:g} deg, beta {at['beta_deg']:g} deg"


ONLY_NUMBERS = f"{runs.UPDATE} rewrites only numbers: change verdict, reason, structure and plans by hand"


class CollisionMismatchError(AssertionError):
    """A result that differs from what the file expects."""


@dataclass(frozen=True)
class Table:
    """One table of expectations: its kind, number among those (from 0 on) and line (from 1 on), where that is known."""

    kind: str
    at: int
    line: int | None
    case: Path
    expected: checks_file.Expectation
    data: bytes


class CollisionFile(pytest.File):
    """A file of expectations."""

    def collect(self) -> Iterator[pytest.Item]:
        """One test per table."""
        try:
            tables = list(_tables(*checks_file.read_checks(self.path), self.path.parent))
        except InputError as error:
            raise self.CollectError(str(error)) from error
        names = unique_names(table.expected.name or usual_name(table.expected) for table in tables)
        for name, table in zip(names, tables, strict=True):
            item = CollisionItem.from_parent(self, name=name, table=table)
            try:
                for mark in table.expected.marks:
                    item.add_marker(mark)
            except pytest.fail.Exception as error:  # --strict-markers
                raise self.CollectError(f"{self.path}:{table.line or 1}: marks: {error}") from error
            yield item


def _tables(content: checks_file.ChecksFile, data: bytes, folder: Path) -> Iterator[Table]:
    text = data.decode("utf-8")
    for kind, expectations in content.tables().items():
        lines = dict(enumerate(checks_file.table_lines(text, kind)))
        for at, expected in enumerate(expectations):
            yield Table(kind, at, lines.get(at), folder / str(expected.case or content.case), expected, data)


class CollisionItem(pytest.Item):
    """One expectation as a test."""

    def __init__(self, *, table: Table, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._table = table

    def runtest(self) -> None:
        """Check, and fail with what differs, or keep the numbers that are to be rewritten."""
        session, table = session_of(self.config), self._table
        if table.kind != "plan":
            context = session.context(table.case, arm=bool(getattr(table.expected, "arm", False)))
            self.user_properties += [("case", str(table.case)), (runs.ARM_PROPERTY, context.arm_note)]
        finding = _finding_of(session, table, self.path.parent)
        numbers = [one.number for one in finding.differences if one.number is not None]
        if len(numbers) < len(finding.differences) or (numbers and not updating(self.config)):
            raise CollisionMismatchError(finding.text(table.expected.why))
        for number in numbers:
            session.change(self.path, table.data, runs.Change(table.kind, table.at, self.name, number))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """The differences, in a few lines."""
        if isinstance(excinfo.value, InputError):
            return Finding((Difference(str(excinfo.value)),)).text(self._table.expected.why)
        if isinstance(excinfo.value, CollisionMismatchError):
            return f"{excinfo.value}\n{ONLY_NUMBERS}" if updating(self.config) else str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Location of the test."""
        line = self._table.line
        return self.path, None if line is None else line - 1, f"{self.path.name}: {self.name}"


def check_in_python(config: pytest.Config, case: Path, keys: Mapping[str, Any]) -> Explanation:
    """Check a direction by the keys of a ``[[check]]`` table; what differs is raised."""
    check = checks_file.CheckSection(**keys)
    explanation = _explained(session_of(config), case, check)
    finding = direction_finding(check, explanation)
    if finding.differences:
        raise CollisionMismatchError(finding.text(check.why))
    return explanation


def _explained(session: Session, case: Path, check: checks_file.CheckSection) -> Explanation:
    context = session.context(case, arm=check.arm)
    return context.explain(float(np.radians(check.theta_deg)), float(np.radians(check.beta_deg)))


def _finding_of(session: Session, table: Table, folder: Path) -> Finding:
    expected = table.expected
    if isinstance(expected, checks_file.CheckSection):
        return direction_finding(expected, _explained(session, table.case, expected))
    if isinstance(expected, checks_file.WindowSection):
        context = session.context(table.case, arm=expected.arm)
        direction = context.check(float(np.radians(expected.theta_deg)), float(np.radians(expected.beta_deg)))
        return window_finding(expected, direction, session.search(table.case, arm=expected.arm))
    assert isinstance(expected, checks_file.PlanSection)
    return plan_finding(folder / expected.file, session.context(table.case, arm=True))


def usual_name(expected: checks_file.Expectation) -> str:
    """Name of a test without its own, by what it expects; independent of the place in the file."""
    if isinstance(expected, checks_file.PlanSection):
        return "plan-" + "-".join(Path(expected.file).parts[-2:])
    assert isinstance(expected, checks_file.CheckSection | checks_file.WindowSection)
    at = f"theta{expected.theta_deg:g}-beta{expected.beta_deg:g}"
    return f"{at}-{expected.verdict}" if isinstance(expected, checks_file.CheckSection) else f"window-{at}"


def unique_names(wanted: Iterable[str]) -> list[str]:
    """Each name as it is wanted; one that is taken already gets the next free number, from 2 on."""
    names: dict[str, None] = {}
    for name in wanted:
        free, number = name, 1
        while free in names:
            number += 1
            free = f"{name}-{number}"
        names[free] = None
    return list(names)


def plan_finding(path: Path, context: CaseContext) -> Finding:
    """Differences of a plan: inputs, its direction's verdict, contacts of its motion, its numbers."""
    try:
        check_plan(read_plan(path), context, path)
    except InputError as error:
        differs = Difference(f"the plan is not valid any more: {error.what}")
        return Finding((differs,), (f"{error.where}: {error.allowed}",))
    return Finding()
