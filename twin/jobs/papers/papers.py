"""The papers whose numbers this project prints beside its own, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from puncture_twin.meshes import folder
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.twin.jobs.papers import axp_ybq, chen2019
from puncture_twin.twin.jobs.papers.chen2019 import reproduction_summary, reproduction_text
from puncture_twin.twin.jobs.papers.chen2019_experiment import (
    DRAWS,
    experiment_summary,
    experiment_text,
    reproduce_experiment,
)
from puncture_twin.twin.jobs.servo.job import reproduce_paper


class PaperResult(NamedTuple):
    """A paper's numbers beside ours."""

    passed: bool
    """Whether every number that should hold does."""
    summary: dict[str, Any]
    """Plain values, for ``--json``."""
    text: str
    """For a person."""


Reproduce = Callable[[Path, int | None], PaperResult]
"""Takes the folder for pictures and pages, and the number of seeds (None: the paper's own default)."""


def _chen2019(out_dir: Path, seeds: int | None) -> PaperResult:
    del out_dir, seeds  # arithmetic on printed tables: nothing is drawn, in either sense
    result = chen2019.reproduce()
    return PaperResult(result.passed, reproduction_summary(result), reproduction_text(result))


def chen2019_experiment(out_dir: Path, draws: int | None, runs: int, watcher: Watcher) -> PaperResult:
    """The experiment of Chen 2019 drawn anew, and so many physical runs of its second setup.

    Raises:
        InputError: A folder that cannot be written to.
    """
    report = reproduce_experiment(DRAWS if draws is None else draws)
    result = PaperResult(report.agrees, experiment_summary(report), experiment_text(report))
    if not runs:
        return result
    from puncture_twin.planning.search.context import prepare
    from puncture_twin.twin.jobs.experiment.physical_runs import physical_runs

    done = physical_runs(prepare(folder() / SETUP_2, watcher=watcher), out_dir, runs)
    summary = {**result.summary, "physical": done.summary()}
    return PaperResult(result.passed, summary, f"{result.text}\n{done.text()}")


SETUP_2 = "carton/case_m_setup2.toml"
"""The embedded case of the paper's second setup, five markers."""


def _axp_ybq(out_dir: Path, seeds: int | None) -> PaperResult:
    result = axp_ybq.reproduce(out_dir, seeds)
    return PaperResult(result.passed, axp_ybq.reproduction_summary(result), axp_ybq.reproduction_text(result))


def _liu2007(out_dir: Path, seeds: int | None) -> PaperResult:
    return PaperResult(*reproduce_paper(out_dir, seeds))


PAPERS: Mapping[str, Reproduce] = MappingProxyType({"chen2019": _chen2019, "liu2007": _liu2007, "axp-ybq": _axp_ybq})
"""Name on the command line to what reproduces it."""
