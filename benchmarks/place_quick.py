"""What `place` knows after some seconds, beside what it knows at its end: docs/concepts/placement.md.

    python -m benchmarks.place_quick [CASE] [--seconds 1,10,30]

Each line is one search in this process, one job: how long it took, how many placements were checked in every direction
by then, and what a check of its best placement in every direction gives. 1 second gives the first answer alone, which
is always given. The last line searches to the end. Behind each stands the worst factor by which the time left, as it
was printed, missed what happened. Seconds are of the clock: on a machine that does nothing else.
"""

import argparse
import re
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.shared import versions
from puncture_twin.meshes import folder
from puncture_twin.planning.base.progress import Silent
from puncture_twin.planning.case.settings import mount_pose
from puncture_twin.planning.place.search import placement_check
from puncture_twin.planning.search.context import prepare
from puncture_twin.planning.search.search import organ_candidates
from puncture_twin.twin.jobs.patient.place_job import place_case
from puncture_twin.twin.report.progress import Pace

LEFT = re.compile(r", (\d+) (s|min|h) left")
UNITS = {"s": 1.0, "min": 60.0, "h": 3600.0}
SHORT_S = 2.0
"""What is left then is not estimated any more."""


class Watched(Silent):
    """Keeps each estimate of the time left, with its time."""

    def __init__(self) -> None:
        self.pace, self.left = Pace(), list[tuple[float, float]]()

    def count(self, stage: str, done: int, total: int, failed: int = 0) -> None:
        """As a terminal would print it."""
        found = LEFT.search(self.pace.text(stage, done, total, failed))
        if found:
            self.left.append((time.perf_counter(), float(found[1]) * UNITS[found[2]]))

    def worst(self, end: float) -> float:
        """The worst factor between an estimate, rounded as it is, and what was left."""
        pairs = [(left + 0.5, end - at) for at, left in self.left if end - at > SHORT_S]
        return max((max(a / b, b / a) for a, b in pairs), default=1.0)


def line(path: Path, seconds: float | None, out: Path) -> str:
    """One search."""
    watched, began = Watched(), time.perf_counter()
    context = prepare(path, arm=False, watcher=watched)
    found = place_case(context, out, quick_s=seconds, began=began, pictures=False).search
    end = time.perf_counter()
    case, best = context.case, found.rated[0]
    candidates = organ_candidates(case, context.anatomy, context.engine, case.directions())
    check = placement_check(case, context.anatomy, candidates)
    pose = mount_pose(best.mount, case.space, case.path)
    reached = np.array([one.reachable for one in check.checked((pose, np.arange(len(check.wanted)))).answers])
    whole = sum(one.verdict.count == found.directions for one in found.rated)
    name = "to the end" if seconds is None else f"{seconds:g} s"
    fraction = 100.0 * float(check.wanted.weight[reached].sum())
    return (
        f"| {name} | {end - began:.1f} | {whole} of {len(found.rated)} | {fraction:.1f} | {reached.sum():,} of "
        f"{len(reached):,} | {watched.worst(end):.1f} |"
    )


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("case", nargs="?", type=Path, default=folder() / "abdomen")
    parser.add_argument("--seconds", default="1,10,30")
    chosen = parser.parse_args()
    print(versions("numpy", "python-fcl"))
    print("| asked | took, s | placements checked in full | best, % | directions | time left, worst factor |")
    print("|---|---|---|---|---|---|")
    with tempfile.TemporaryDirectory() as temporary:
        for number, text in enumerate([*chosen.seconds.split(","), ""]):
            print(line(chosen.case, float(text) if text else None, Path(temporary) / str(number)), flush=True)


if __name__ == "__main__":
    main()
