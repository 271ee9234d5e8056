"""Many runs of one experiment: markers touched, and the needle inserted, in the simulator or in truths without it.

A reading of the simulator lies some hundredths of a millimetre from the joints that put the true tip on the true
marker, so a run and its drawn twin err alike; and drawn ones cost milliseconds.

A physical run is kept once it is done, under the hash of all that decided it: an interrupted command goes on there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.registration.registration import Registration
from puncture_twin.planning.search.choice import BEST
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.tour_motions import plan_puncture
from puncture_twin.twin.jobs.experiment.touch_job import (
    Tour,
    drawn_once,
    plan_tour,
    touch_once,
    true_at_target,
    true_touches,
)
from puncture_twin.twin.rehearsal.plan_truth import rehearse_touched
from puncture_twin.twin.rehearsal.result import Rehearsal

DRAWS = 400
"""Where one axis errs most their rms is known to 3.5 %."""


@dataclass(frozen=True)
class DrawnRuns:
    """Truths drawn alike.

    Attributes:
        alike_mm: The tip's rms error in the truths of the physical runs that ended, mm; NaN where none did.
        realised_mm: The same in all that were drawn.
    """

    alike_mm: float
    realised_mm: float
    draws: int

    def text(self, ended: int) -> str:
        """Beside so many physical runs."""
        spread = 100.0 / np.sqrt(2.0 * self.draws)
        return (
            f"  without physics, the same {plural(ended, 'trial')} give {self.alike_mm:.2f} mm, all {self.draws} "
            "trials "
            f"{self.realised_mm:.2f} (known to {spread:.1f} %)"
        )


def drawn_runs(context: CaseContext, tour: Tour, ended: Iterable[int]) -> DrawnRuns:
    """Draw the truths of many seeds."""
    error_mm = {seed: _error_mm(context, tour, seed) for seed in range(DRAWS)}
    alike = [error_mm[seed] if seed in error_mm else _error_mm(context, tour, seed) for seed in ended]
    return DrawnRuns(_rms(alike), _rms(error_mm.values()), DRAWS)


def _error_mm(context: CaseContext, tour: Tour, seed: int) -> float:
    use = drawn_once(context, tour, seed)
    return float("nan") if isinstance(use, str) else use.tip_error_mm


def _rms(errors_mm: Iterable[float]) -> float:
    """Of those that registered; NaN where none did."""
    found = np.array([one for one in errors_mm if not np.isnan(one)])
    return float(np.sqrt(np.mean(found**2))) if len(found) else float("nan")


FOLDER = "runs"


@dataclass(frozen=True)
class PhysicalRun:
    """One experiment.

    Attributes:
        tip_error_mm: The needle's tip from the true target; NaN where a touch or the puncture stopped.
        seconds_per_touch: Of the tour, home to home; NaN likewise.
        off_path_mm: Of the tip from its commanded path, at most while it went in; NaN likewise.
        refused: Why it stopped; empty where it did not.
    """

    seed: int
    tip_error_mm: float
    fre_mm: float
    seconds_per_touch: float
    off_path_mm: float
    refused: str = ""


@dataclass(frozen=True)
class PhysicalRuns:
    """All of them.

    Attributes:
        expected_mm: The tip's rms error that the declaration predicts for these touches.
        kept: So many were there already.
        drawn: Truths without physics, the same ones and many more.
    """

    expected_mm: float
    runs: tuple[PhysicalRun, ...]
    kept: int
    drawn: DrawnRuns

    @property
    def realised_mm(self) -> float:
        """Rms over the runs that ended."""
        ended = [run.tip_error_mm for run in self.runs if not run.refused]
        return float(np.sqrt(np.mean(np.square(ended)))) if ended else float("nan")

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        ended = [run for run in self.runs if not run.refused]
        return {
            "expected_mm": self.expected_mm,
            "realised_mm": self.realised_mm if ended else None,
            "seconds_per_touch": float(np.mean([run.seconds_per_touch for run in ended])) if ended else None,
            "drawn": {
                "realised_mm": self.drawn.realised_mm,
                "draws": self.drawn.draws,
                "realised_in_the_same_truths_mm": self.drawn.alike_mm if ended else None,
            },
            "refused": {run.seed: run.refused for run in self.runs if run.refused},
            "runs": [asdict(run) for run in ended],
        }

    def text(self) -> str:
        """For a person; where one axis errs most, an rms is known to one over the root of twice their number."""
        ended = [run for run in self.runs if not run.refused]
        if not ended:
            return f"none of {plural(len(self.runs), 'physical run')} ended: {self.runs[0].refused}"
        spread = 1.0 / np.sqrt(2.0 * len(ended))
        seconds = np.mean([run.seconds_per_touch for run in ended])
        kept = f", {self.kept} from an earlier run" if self.kept else ""
        lines = [
            f"{plural(len(ended), 'physical run')} ({seconds:.1f} s per touch{kept}): the tip misses the target by "
            f"{self.realised_mm:.2f} mm rms (known to {100 * spread:.0f} %), {self.expected_mm:.2f} predicted",
            f"  touched and inserted in the simulator, the tip at most {max(run.off_path_mm for run in ended):.3f} mm "
            "off its commanded path",
        ]
        lines.append(self.drawn.text(len(ended)))
        lines += [f"  seed {run.seed}: {run.refused}" for run in self.runs if run.refused]
        return "\n".join(lines)


def physical_runs(context: CaseContext, out: Path, runs: int) -> PhysicalRuns:
    """Run the experiment of a case's best candidate, each run with a truth of its own.

    Args:
        context: Of a case with declared errors, markers and an arm.
        out: Holds the folder of the runs that are kept.

    Raises:
        InputError: The case declares no errors, or has no markers.
        NoAnswerError: Nothing is safe, or too few markers can be touched.
    """
    tour = plan_tour(context, BEST, seed=0)
    key = _key(context, tour)
    found, kept = [], 0
    for number in range(runs):
        path = out / FOLDER / f"{number}.json"
        run = _read(path, key)
        kept += run is not None
        found.append(run or _kept(path, key, _run(context, tour, number)))
        context.watcher.count("runs", number + 1, runs)
    drawn = drawn_runs(context, tour, [run.seed for run in found if not run.refused])
    return PhysicalRuns(tour.plan.expected_mm, tuple(found), kept, drawn)


def _run(context: CaseContext, tour: Tour, seed: int) -> PhysicalRun:
    """One run; refused where a marker was not touched, for the prediction is that of all of them."""
    touched, use = touch_once(context, tour, seed)
    if touched.failed or isinstance(use, str):
        why = "; ".join(f"marker {name}: {reason}" for name, reason in touched.failed.items())
        return _refused(seed, why or str(use))
    try:
        inserted = _inserted(context, tour, seed, use.registration)
    except NoAnswerError as error:
        return _refused(seed, str(error))
    per_touch = touched.seconds / len(touched.readings)
    return PhysicalRun(seed, inserted.tip_error_mm, use.registration.fre_mm, per_touch, inserted.off_path_mm)


def _refused(seed: int, why: str) -> PhysicalRun:
    return PhysicalRun(seed, *4 * (float("nan"),), refused=why)


def _inserted(context: CaseContext, tour: Tour, seed: int, registration: Registration) -> Rehearsal:
    """The puncture planned by what was touched, and executed where everything truly is.

    Raises:
        NoAnswerError: There is no such plan, or the arm touched something.
    """
    with context.stages.time("puncture"):
        plan = plan_puncture(context, tour.outward_ct, tour.q_insertion, registration)
        truth, at_target = true_touches(context, tour, seed), true_at_target(context, seed)
        inserted = rehearse_touched(context, plan, truth, at_target)
    for contact in inserted.contacts:
        what = f"the arm stopped before the target: {contact.link} touches {contact.body}"
        raise NoAnswerError(what, code="motion_touches")
    return inserted


def _key(context: CaseContext, tour: Tour) -> str:
    """The hash of all that decides a run beside its seed."""
    stated = json.dumps([context.provenance(), inputs_document(context.case.inputs)], sort_keys=True, default=str)
    joints = np.concatenate([tour.q_insertion, *(touch.q_touch for touch in tour.plan.touches)])
    return hashlib.sha256(stated.encode() + joints.tobytes()).hexdigest()


def _read(path: Path, key: str) -> PhysicalRun | None:
    """A run that was kept, if it is whole and of the same experiment."""
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
        return PhysicalRun(**document["run"]) if document["key"] == key else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def _kept(path: Path, key: str, run: PhysicalRun) -> PhysicalRun:
    if not run.refused:
        with atomic(path) as temporary:
            temporary.write_text(json.dumps({"key": key, "run": asdict(run)}) + "\n", encoding="utf-8")
    return run
