"""The papers whose numbers this project prints beside its own, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from puncture_twin.twin.jobs.papers import axp_ybq, chen2019
from puncture_twin.twin.jobs.papers.chen2019_experiment import (
    DRAWS,
    experiment_summary,
    experiment_text,
    reproduce_experiment,
)
from puncture_twin.twin.jobs.papers.chen2019_text import reproduction_summary, reproduction_text
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


def chen2019_experiment(draws: int | None) -> PaperResult:
    """The experiment of Chen 2019 drawn anew: whether its stated errors can be its own."""
    report = reproduce_experiment(DRAWS if draws is None else draws)
    return PaperResult(report.agrees, experiment_summary(report), experiment_text(report))


def _axp_ybq(out_dir: Path, seeds: int | None) -> PaperResult:
    result = axp_ybq.reproduce(out_dir, seeds)
    return PaperResult(result.passed, axp_ybq.reproduction_summary(result), axp_ybq.reproduction_text(result))


def _liu2007(out_dir: Path, seeds: int | None) -> PaperResult:
    return PaperResult(*reproduce_paper(out_dir, seeds))


PAPERS: Mapping[str, Reproduce] = MappingProxyType({"chen2019": _chen2019, "liu2007": _liu2007, "axp-ybq": _axp_ybq})
"""Name on the command line to what reproduces it."""
