"""The papers whose numbers this project prints beside its own, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from puncture_twin.meshes import folder
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.twin.experiment.chen2019 import (
    AS_FOUND,
    AS_STATED,
    REJECTED,
    DrawnRank,
    Experiment,
    SkewFinding,
    find_skew,
    paper_strains,
    run_draws,
)
from puncture_twin.twin.jobs.papers import axp_ybq, chen2019, liu2007
from puncture_twin.twin.jobs.papers.chen2019 import reproduction_summary, reproduction_text
from puncture_twin.twin.jobs.terminal import Answer
from puncture_twin.twin.report.present import Field, Section, Table, grid, text

DRAWS, SEED = 1000, 2019


@dataclass(frozen=True)
class ExperimentReport:
    """Two declarations compared with the paper, and the skew that tells them apart."""

    seed: int
    stated: Experiment
    found: Experiment
    strains: dict[str, float]
    skew: SkewFinding

    @property
    def agrees(self) -> bool:
        """Whether the stated errors are rejected, and the found ones explain every number."""
        return self.stated.rejected and self.found.agrees


def reproduce_experiment(draws: int = DRAWS) -> ExperimentReport:
    """Draw the experiment under both declarations."""
    stated, found = (run_draws(one, draws, np.random.default_rng(SEED)) for one in (AS_STATED, AS_FOUND))
    return ExperimentReport(SEED, stated, found, dict(paper_strains()), find_skew())


def experiment_summary(report: ExperimentReport) -> dict[str, Any]:
    """Plain values for ``--json``, mm and degrees."""
    return {
        "seed": report.seed,
        "draws": report.stated.draws,
        "declarations": [_declaration(one) for one in (report.stated, report.found)],
        "strain_share": report.strains,
        "skew_deg": float(np.degrees(report.skew.angle)),
        "lesions": [
            {"what": one.name, "as_read_mm": one.as_read, "square_mm": one.square} for one in report.skew.lesions
        ],
        "holds": report.agrees,
    }


def _declaration(one: Experiment) -> dict[str, Any]:
    declared = {
        "slice_mm": one.declaration.slice_mm,
        "pixel_mm": one.declaration.pixel_mm,
        "reading_mm": one.declaration.reading_mm,
        "skew_deg": float(np.degrees(one.declaration.skew)),
        "touch_mm": one.declaration.touch_mm,
    }
    return {
        "name": one.declaration.name,
        **declared,
        "printed": [vars(row) for row in one.printed],
        "joint": [vars(row) for row in one.joint],
        "probability": one.probability,
        "rejected": one.rejected,
        "agrees": one.agrees,
        "best_strain_fraction_of_draws": one.best_strain,
    }


def experiment_text(report: ExperimentReport) -> str:
    """The finding first, then the numbers behind it."""
    stated, found, strains = report.stated, report.found, report.strains
    others = max(value for name, value in strains.items() if name != "y against z")
    verdicts = [
        f"stated: p {stated.probability:.1g}, {'REJECTED' if stated.rejected else 'not rejected'} "
        f"(below {REJECTED:g}): slices of 5 mm cannot give the smallest residuals along the bed.",
        f"found: p {found.probability:.2g}; every number within its range: {'yes' if found.agrees else 'NO'} "
        "(fitted to these points: consistent, but no proof)",
        f"a skew of the CT's y against z alone takes {100 * strains['y against z']:.0f} % of the squared residuals, "
        f"no other strain more than {100 * others:.0f} %; under the stated errors some strain takes as much in "
        f"{100 * stated.best_strain:.1f} % of draws",
    ]
    skew = (
        f"from the markers of setup 2 alone, no lesion among them, it is {np.degrees(report.skew.angle):.2f} degrees; "
        "corrected for it, the lesions are missed by"
    )
    open_ = (
        "its cause is unknown: a carton out of square, skewed measuring lines, or a bias of the touches at its sides"
    )
    touches = "'about 40 % more efficient' counts touches (3 instead of 5); the paper states no time to check it"
    title = f"the experiment of Chen 2019, simulated {stated.draws} times with two declarations (seed {report.seed})"
    return text([
        Section(title, [_declared(stated), _declared(found)]),
        Section("percentile of the paper's number among the simulated ones", [_ranks(stated.printed, found.printed)]),
        Section("all points of both setups together, squares in mm^2 (x lies along the bed)",
                [_ranks(stated.joint, found.joint), *verdicts]),
        Section(skew, [f"{one.name}: {one.as_read:.2f} -> {one.square:.2f} mm" for one in report.skew.lesions]),
        Section(open_, []), Section(touches, []),
    ])  # fmt: skip


def _ranks(stated: Sequence[DrawnRank], found: Sequence[DrawnRank]) -> Table:
    """The statistic's size depends on the declaration for chi-squared alone."""
    fields = (
        Field("number of the paper", lambda two: two[0].name),
        Field("paper", lambda two: " and ".join(dict.fromkeys(f"{one.paper:.2f}" for one in two))),
        Field("stated", lambda two: two[0].percentile, 1),
        Field("found", lambda two: two[1].percentile, 1),
    )
    return grid(fields, zip(stated, found, strict=True))


def _declared(one: Experiment) -> str:
    d = one.declaration
    parts = [
        f"slices {d.slice_mm:g} mm, pixels {d.pixel_mm:g} mm" if d.slice_mm else "",
        f"readings {d.reading_mm:g} mm" if d.reading_mm else "",
        f"planes skewed by {np.degrees(d.skew):g} degrees" if d.skew else "",
        f"touches {d.touch_mm:g} mm",
    ]
    return f"{d.name}: {', '.join(part for part in parts if part)}"


Reproduce = Callable[[Path, int | None], Answer]
"""Takes the folder for pictures and pages, and the number of seeds (None: the paper's own default)."""


def _chen2019(out_dir: Path, seeds: int | None) -> Answer:
    del out_dir, seeds  # arithmetic on printed tables: nothing is drawn, in either sense
    result = chen2019.reproduce()
    summary = reproduction_summary(result)
    return Answer(result.passed, summary, reproduction_text(summary))


def chen2019_experiment(out_dir: Path, draws: int | None, runs: int, watcher: Watcher) -> Answer:
    """The experiment of Chen 2019 drawn anew, and so many physical runs of its second setup.

    Raises:
        InputError: A folder that cannot be written to.
    """
    report = reproduce_experiment(DRAWS if draws is None else draws)
    result = Answer(report.agrees, experiment_summary(report), experiment_text(report))
    if not runs:
        return result
    from puncture_twin.planning.search.context import prepare
    from puncture_twin.twin.jobs.experiment.physical_runs import physical_runs

    done = physical_runs(prepare(folder() / SETUP_2, watcher=watcher), out_dir, runs)
    summary = {**result.summary, "physical": done.summary()}
    return Answer(result.passed, summary, f"{result.text}\n{done.text()}")


def reproduced(
    paper: str, out_dir: Path, seeds: int | None, watcher: Watcher, *, experiment: bool, runs: int
) -> Answer:
    """A paper's numbers beside ours, or its experiment drawn anew.

    Raises:
        InputError: A paper that is not known, or has no such experiment; a folder that cannot be written to.
    """
    if paper not in PAPERS:
        refuse(f"paper '{paper}' is not known", "reproduce", ", ".join(PAPERS), "unknown_choice")
    if experiment and paper != "chen2019":
        refuse(f"{paper} has no experiment", "--experiment", "reproduce chen2019", "unknown_choice")
    if runs and not experiment:
        refuse("--runs needs --experiment", "--runs", "reproduce chen2019 --experiment", "conflicting_options")
    return chen2019_experiment(out_dir, seeds, runs, watcher) if experiment else PAPERS[paper](out_dir, seeds)


SETUP_2 = "carton/case_m_setup2.toml"
"""The embedded case of the paper's second setup, five markers."""


def _axp_ybq(out_dir: Path, seeds: int | None) -> Answer:
    result = axp_ybq.reproduce(out_dir, seeds)
    summary = axp_ybq.reproduction_summary(result)
    return Answer(result.passed, summary, axp_ybq.reproduction_text(summary))


PAPERS: Mapping[str, Reproduce] = MappingProxyType(
    {"chen2019": _chen2019, "liu2007": liu2007.reproduce, "axp-ybq": _axp_ybq}
)
"""Name on the command line to what reproduces it."""
