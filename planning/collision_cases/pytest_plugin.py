"""The plugin of pytest: collects ``*.collision.toml``, and gives the fixture ``collision_check``.

Loading it costs milliseconds: what reads and checks cases is imported with the first such file or use of the fixture.
The files' keys are documented in docs/how-to/collision-cases.md.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from puncture_twin.planning.collision_cases.session import UPDATE, arm_notes, session_of, updating, write_changes

if TYPE_CHECKING:
    from puncture_twin.planning.search.explain import Explanation

SUFFIX = ".collision.toml"


def pytest_addoption(parser: pytest.Parser) -> None:
    """The flag that rewrites expected numbers."""
    text = "rewrite the numbers expected in *.collision.toml files; never a verdict"
    parser.getgroup("collision").addoption(UPDATE, action="store_true", help=text)


def pytest_configure(config: pytest.Config) -> None:
    """Refuse to rewrite files from several processes."""
    updating(config)


def pytest_collect_file(file_path: Path, parent: pytest.Collector) -> pytest.Collector | None:
    """Collect ``*.collision.toml`` files."""
    if not file_path.name.endswith(SUFFIX):
        return None
    from puncture_twin.planning.collision_cases.collector import CollisionFile

    return CollisionFile.from_parent(parent, path=file_path)


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Rewrite the numbers that changed, each file at once."""
    if updating(session.config) and not write_changes(session.config):
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Say where no arm was checked, and every number that was rewritten."""
    notes = arm_notes(report for reports in terminalreporter.stats.values() for report in reports)
    if notes:
        terminalreporter.section("collision files: arm")
        for line in notes:
            terminalreporter.line(line)
    if updating(config):
        terminalreporter.section("collision files")
        for line in session_of(config).lines or ["no number was rewritten"]:
            terminalreporter.line(line)


@pytest.fixture(scope="session")
def collision_check(pytestconfig: pytest.Config) -> Callable[..., Explanation]:
    """``collision_check(case, theta_deg=, beta_deg=, verdict=, ...)``: the same in Python; returns the explanation.

    Takes the keys of a ``[[check]]`` table; ``case`` is a path.
    """
    from puncture_twin.planning.collision_cases.collector import check_in_python

    def run(case: Path | str, **keys: object) -> Explanation:
        return check_in_python(pytestconfig, Path(case), keys)

    return run
