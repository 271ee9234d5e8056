"""Files of expectations as tests of pytest: one a table."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision_cases.checks_file import (
    CheckSection,
    ChecksFile,
    Expectation,
    PlanSection,
    WindowSection,
    read_checks,
)
from puncture_twin.planning.collision_cases.direction_finding import direction_finding
from puncture_twin.planning.collision_cases.finding import Difference, Finding
from puncture_twin.planning.collision_cases.pytest_run import ARM_PROPERTY, UPDATE, updating
from puncture_twin.planning.collision_cases.rewrite import Change
from puncture_twin.planning.collision_cases.session import Session, session_of
from puncture_twin.planning.collision_cases.table_lines import table_lines
from puncture_twin.planning.collision_cases.window_finding import window_finding
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.planning.plan.recheck import check_plan
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation

ONLY_NUMBERS = f"{UPDATE} rewrites numbers alone: verdict, reason, structure and plans are for a person to change"


class CollisionMismatchError(AssertionError):
    """Something is not what the file expects."""


@dataclass(frozen=True)
class Table:
    """One expectation of a file.

    Attributes:
        kind: ``check``, ``window`` or ``plan``.
        at: Its number among those, from 0 on.
        line: Where it begins, from 1 on; None where nothing tells.
        case: The case's file.
        expected: What it holds.
        data: The whole file's bytes.
    """

    kind: str
    at: int
    line: int | None
    case: Path
    expected: Expectation
    data: bytes


class CollisionFile(pytest.File):
    """A file of expectations."""

    def collect(self) -> Iterator[pytest.Item]:
        """One test per table."""
        try:
            tables = list(_tables(*read_checks(self.path), self.path.parent))
        except InputError as error:
            raise self.CollectError(str(error)) from error
        names = unique_names(table.expected.name or table.expected.usual_name for table in tables)
        for name, table in zip(names, tables, strict=True):
            item = CollisionItem.from_parent(self, name=name, table=table)
            self._mark(item, table)
            yield item

    def _mark(self, item: pytest.Item, table: Table) -> None:
        for mark in table.expected.marks:
            try:
                item.add_marker(mark)
            except pytest.fail.Exception as error:  # --strict-markers
                raise self.CollectError(f"{self.path}:{table.line or 1}: marks: {error}") from error


def _tables(content: ChecksFile, data: bytes, folder: Path) -> Iterator[Table]:
    text = data.decode("utf-8")
    for kind, expectations in content.tables().items():
        lines = dict(enumerate(table_lines(text, kind)))
        for at, expected in enumerate(expectations):
            yield Table(kind, at, lines.get(at), folder / str(expected.case or content.case), expected, data)


class CollisionItem(pytest.Item):
    """One expectation."""

    def __init__(self, *, table: Table, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._table = table

    def runtest(self) -> None:
        """Check, and fail with what differs, or keep the numbers that are to be rewritten."""
        session, table = session_of(self.config), self._table
        if table.kind != "plan":
            self.user_properties += arm_properties(session, table)
        found = FINDERS[table.kind](session, table, self.path.parent)
        if found.differences and not (updating(self.config) and self._kept(session, found)):
            raise CollisionMismatchError(found.text(table.expected.why))

    def _kept(self, session: Session, found: Finding) -> bool:
        """Keep what differs for the rewriting at the end, if all of it is numbers."""
        numbers = [one.number for one in found.differences if one.number is not None]
        if len(numbers) < len(found.differences):
            return False
        for number in numbers:
            session.change(self.path, self._table.data, Change(self._table.kind, self._table.at, self.name, number))
        return True

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """What differs, in a few lines."""
        if isinstance(excinfo.value, InputError):
            return Finding((Difference(str(excinfo.value)),)).text(self._table.expected.why)
        if isinstance(excinfo.value, CollisionMismatchError):
            return f"{excinfo.value}\n{ONLY_NUMBERS}" if updating(self.config) else str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, int | None, str]:
        """Where the test stands."""
        line = self._table.line
        return self.path, None if line is None else line - 1, f"{self.path.name}: {self.name}"


def arm_properties(session: Session, table: Table) -> list[tuple[str, object]]:
    """What a test's report says of the arm.

    Raises:
        InputError: The case cannot be read, or has no arm to be checked.
    """
    context = session.context(table.case, arm=bool(getattr(table.expected, "arm", False)))
    return [("case", str(table.case)), (ARM_PROPERTY, context.arm)]


def check_in_python(config: pytest.Config, case: Path, keys: Mapping[str, Any]) -> Explanation:
    """Check a direction by the keys of a ``[[check]]`` table.

    Raises:
        CollisionMismatchError: Something is not as expected.
    """
    check = CheckSection(**keys)
    found = _explained(session_of(config), case, check)
    finding = direction_finding(check, found)
    if finding.differences:
        raise CollisionMismatchError(finding.text(check.why))
    return found


def _explained(session: Session, case: Path, check: CheckSection) -> Explanation:
    context = session.context(case, arm=check.arm)
    return context.explain(float(np.radians(check.theta_deg)), float(np.radians(check.beta_deg)))


def _direction(session: Session, table: Table, folder: Path) -> Finding:
    assert isinstance(table.expected, CheckSection)
    return direction_finding(table.expected, _explained(session, table.case, table.expected))


def _window(session: Session, table: Table, folder: Path) -> Finding:
    expected = table.expected
    assert isinstance(expected, WindowSection)
    context = session.context(table.case, arm=expected.arm)
    direction = context.check(float(np.radians(expected.theta_deg)), float(np.radians(expected.beta_deg)))
    return window_finding(expected, direction, session.search(table.case, arm=expected.arm))


def _plan(session: Session, table: Table, folder: Path) -> Finding:
    assert isinstance(table.expected, PlanSection)
    return plan_finding(folder / table.expected.file, session.context(table.case, arm=True))


FINDERS: Mapping[str, Callable[[Session, Table, Path], Finding]] = {
    "check": _direction,
    "window": _window,
    "plan": _plan,
}
"""Kind of table to what checks it."""


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
