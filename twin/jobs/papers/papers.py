"""The papers whose numbers this project prints beside its own, by name."""

from collections.abc import Callable, Mapping
from pathlib import Path

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.progress import Watcher
from puncture_twin.twin.jobs.papers import axp_ybq, chen2019, liu2007
from puncture_twin.twin.jobs.terminal import Answer

PAPERS: Mapping[str, Callable[[Path, int | None], Answer]] = {
    "chen2019": lambda out_dir, seeds: chen2019.reproduce(),  # arithmetic on printed tables: nothing is drawn
    "liu2007": liu2007.reproduce,
    "axp-ybq": lambda out_dir, seeds: axp_ybq.reproduce(seeds),
}
"""Name on the command line to what takes the folder for pictures and pages, and how many seeds (None: its own)."""


def reproduced(
    paper: str, out_dir: Path, seeds: int | None, watcher: Watcher, *, experiment: bool, runs: int
) -> Answer:
    """A paper's numbers beside ours, or its experiment drawn anew."""
    if paper not in PAPERS:
        refuse(f"paper '{paper}' is not known", "reproduce", ", ".join(PAPERS), "unknown_choice")
    if experiment and paper != "chen2019":
        refuse(f"{paper} has no experiment", "--experiment", "reproduce chen2019", "unknown_choice")
    if runs and not experiment:
        refuse("--runs needs --experiment", "--runs", "reproduce chen2019 --experiment", "conflicting_options")
    return chen2019.experiment(seeds, runs, watcher) if experiment else PAPERS[paper](out_dir, seeds)
