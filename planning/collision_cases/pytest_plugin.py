"""Collision cases as ordinary pytest cases: ``*.collision.toml`` files, and the fixture ``collision_check``.

A file holds one or many::

    case = "liver/case.toml"          # for all that follow; relative to this file

    [[check]]
    theta_deg = 20
    beta_deg = 135
    verdict = "rejected"              # safe | rejected
    reason = "too_close"              # optional
    structure = "rib_right"           # optional: the structure that the reason names
    clearance_mm = { aorta = 41.2 }   # optional, within tolerance_mm
    tolerance_mm = 0.1                # optional, 0.01 if left out
    arm = false                       # optional: check the organs alone (the default); true fails without a base
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pydantic import Field

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.toml_file import read_toml
from puncture_twin.planning.case.toml_types import Degrees180, Degrees360, NotNegative, Number, Section
from puncture_twin.planning.search.context import CaseContext, prepare
from puncture_twin.planning.search.explain import Explanation

SUFFIX = ".collision.toml"
PREPARED = pytest.StashKey[dict[tuple[Path, bool], CaseContext]]()
DEFAULT_TOLERANCE_MM = 0.01
"""A tenth of the 0.1 mm to which a robot repeats itself."""


class CheckSection(Section):
    """One expectation."""

    theta_deg: Degrees180
    beta_deg: Degrees360
    verdict: str = Field(pattern="^(safe|rejected)$")
    case: str | None = None
    reason: Reason | None = None
    structure: str | None = None
    clearance_mm: dict[str, Number] = Field(default_factory=dict)
    tolerance_mm: NotNegative = DEFAULT_TOLERANCE_MM
    arm: bool = False
    why: str = ""


class ChecksFile(Section):
    """The whole file."""

    case: str | None = None
    check: tuple[CheckSection, ...] = Field(min_length=1)


class CollisionMismatchError(AssertionError):
    """A candidate is not what the file expects."""


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect ``*.collision.toml`` files."""
    if file_path.name.endswith(SUFFIX):
        return CollisionFile.from_parent(parent, path=file_path)
    return None


class CollisionFile(pytest.File):
    """A file of expectations."""

    def collect(self) -> Iterator[pytest.Item]:
        """One test per ``[[check]]``."""
        content = read_checks(self.path)
        for number, check in enumerate(content.check, start=1):
            name = f"{number}-theta{check.theta_deg:g}-beta{check.beta_deg:g}-{check.verdict}"
            yield CollisionItem.from_parent(self, name=name, check=check, default=content.case)


class CollisionItem(pytest.Item):
    """One expectation."""

    def __init__(self, *, check: CheckSection, default: str | None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._check = check
        self._default = default

    def runtest(self) -> None:
        """Judge the candidate and compare."""
        name = self._check.case or self._default
        if name is None:
            raise InputError("no case", where=self.path, allowed="case = FILE, for the file or for the check")
        compare(self._check, _explained(self.config, self.path.parent / name, self._check))

    def repr_failure(self, excinfo: pytest.ExceptionInfo[BaseException], style: Any = None) -> Any:
        """What ``check`` prints, after what differs."""
        if isinstance(excinfo.value, CollisionMismatchError | InputError):
            return str(excinfo.value)
        return super().repr_failure(excinfo, style)

    def reportinfo(self) -> tuple[Path, None, str]:
        """Where the test stands."""
        return self.path, None, f"{self.path.name}: {self.name}"


def read_checks(path: Path) -> ChecksFile:
    """Read and validate a file of expectations.

    Raises:
        InputError: Not TOML, or not this schema.
    """
    return read_toml(path, ChecksFile, allowed="[[check]] tables", keys="docs/how-to/collision-cases.md")


def compare(check: CheckSection, found: Explanation) -> None:
    """Raise what differs, followed by what ``check`` prints.

    Raises:
        CollisionMismatchError: Verdict, reason, structure or a clearance is not the expected one.
    """
    row = found.candidates
    wanted: list[tuple[str, Any, Any]] = [("verdict", check.verdict, found.verdict)]
    if check.reason is not None:
        wanted.append(("reason", check.reason.value, str(row.verdict.reason[0])))
    if check.structure is not None:
        wanted.append(("structure", check.structure, str(row.verdict.structure[0])))
    wrong = [f"{what}: expected {want!r}, found {got!r}" for what, want, got in wanted if want != got]
    clearances = found.clearances()
    for name, want in check.clearance_mm.items():
        if name not in clearances:
            wrong.append(f"clearance of {name!r}: no such structure; there are {', '.join(clearances)}")
        elif not abs(clearances[name] - want) <= check.tolerance_mm:
            got = clearances[name]
            wrong.append(f"clearance of {name}: expected {want:g} ± {check.tolerance_mm:g} mm, found {got:.4f} mm")
    if wrong:
        raise CollisionMismatchError("\n".join([*wrong, "", found.text()]))


def pytest_configure(config: pytest.Config) -> None:
    """Cases are read once per session: meshes and trees cost more than any check."""
    config.stash[PREPARED] = {}


def _explained(config: pytest.Config, path: Path, check: CheckSection) -> Explanation:
    cases, key = config.stash[PREPARED], (path.resolve(), check.arm)
    if key not in cases:
        cases[key] = prepare(path, arm=check.arm)  # True refuses a case that does not say where the base is
    return cases[key].explain(float(np.radians(check.theta_deg)), float(np.radians(check.beta_deg)))


@pytest.fixture(scope="session")
def collision_check(pytestconfig: pytest.Config) -> Callable[..., Explanation]:
    """``collision_check(case, theta_deg=, beta_deg=, verdict=, ...)``: the same in Python; returns the explanation.

    Takes the keys of a ``[[check]]`` table; ``case`` is a path.
    """

    def run(case: Path | str, **keys: Any) -> Explanation:
        check = CheckSection(**keys)
        found = _explained(pytestconfig, Path(case), check)
        compare(check, found)
        return found

    return run
