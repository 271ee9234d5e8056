"""Many runs of one experiment: markers touched, and the needle inserted, in the simulator or in truths without it.

A reading of the simulator lies some hundredths of a millimetre from the joints that put the true tip on the true
marker, so a run and its drawn twin err alike; and drawn ones cost milliseconds.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import rms
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.strict_json import or_null
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
from puncture_twin.twin.report.present import Section, text

DRAWS = 400
"""Where one axis errs most their rms is known to 3.5 %."""


def physical_runs(context: CaseContext, runs: int) -> dict[str, Any]:
    """Run the experiment of a case's best candidate, each run with a truth of its own.

    Args:
        context: Of a case with declared errors, markers and an arm.

    Returns:
        Plain values: the tip's rms error that the declaration predicts for these touches and that of the runs that
        ended, each of these, why others were refused, and the errors of truths without physics, the same and many.

    Raises:
        InputError: The case declares no errors, or has no markers.
        NoAnswerError: Nothing is safe, or too few markers can be touched.
    """
    tour, ended, refused = plan_tour(context, BEST, seed=0), [], {}
    for seed in range(runs):
        try:
            ended.append(physical_run(context, tour, seed))
        except NoAnswerError as error:
            refused[seed] = str(error)
        context.watcher.count("runs", seed + 1, runs)
    drawn = {seed: drawn_error_mm(context, tour, seed) for seed in range(max(DRAWS, runs))}
    alike = [drawn[one["seed"]] for one in ended if np.isfinite(drawn[one["seed"]])]
    return {
        "expected_mm": tour.plan.expected_mm,
        "realised_mm": or_null(rms([one["tip_error_mm"] for one in ended])),
        "seconds_per_touch": float(np.mean([one["seconds_per_touch"] for one in ended])) if ended else None,
        "drawn": {
            "realised_mm": rms([drawn[seed] for seed in range(DRAWS) if np.isfinite(drawn[seed])]),
            "draws": DRAWS,
            "realised_in_the_same_truths_mm": or_null(rms(alike)),
        },
        "refused": refused,
        "runs": ended,
    }


def physical_run(context: CaseContext, tour: Tour, seed: int) -> dict[str, Any]:
    """One run."""
    touched, use = touch_once(context, tour, seed)
    if touched.failed or isinstance(use, str):
        why = "; ".join(f"marker {name}: {reason}" for name, reason in touched.failed.items())
        raise NoAnswerError(why or str(use), code="no_touch")
    inserted = _inserted(context, tour, seed, use.registration)
    return {
        "seed": seed,
        "tip_error_mm": inserted.tip_error_mm,
        "fre_mm": use.registration.fre_mm,
        "seconds_per_touch": touched.seconds / len(touched.readings),
        "off_path_mm": inserted.off_path_mm,
        "refused": "",
    }


def _inserted(context: CaseContext, tour: Tour, seed: int, registration: Registration) -> Rehearsal:
    """The puncture planned by what was touched, and executed where everything truly is."""
    with context.stages.time("puncture"):
        plan = plan_puncture(context, tour.outward_ct, tour.q_insertion, registration)
        truth, at_target = true_touches(context, tour, seed), true_at_target(context, seed)
        inserted = rehearse_touched(context, plan, truth, at_target)
    for contact in inserted.contacts:
        what = f"the arm stopped before the target: {contact.link} touches {contact.body}"
        raise NoAnswerError(what, code="motion_touches")
    return inserted


def drawn_error_mm(context: CaseContext, tour: Tour, seed: int) -> float:
    """The tip's error in one truth without physics; NaN where the touches do not register."""
    use = drawn_once(context, tour, seed)
    return float("nan") if isinstance(use, str) else use.tip_error_mm


def physical_text(facts: Mapping[str, Any]) -> str:
    """For a person; where one axis errs most, an rms is known to one over the root of twice their number."""
    ended, drawn = facts["runs"], facts["drawn"]
    refused = [f"seed {seed}: {why}" for seed, why in facts["refused"].items()]
    if not ended:
        return text([Section(f"none of {plural(len(refused), 'physical run')} ended", refused)])
    known, draws = (100.0 / np.sqrt(2.0 * count) for count in (len(ended), drawn["draws"]))
    head = (
        f"{plural(len(ended), 'physical run')} ({facts['seconds_per_touch']:.1f} s per touch): the tip misses the "
        f"target by {facts['realised_mm']:.2f} mm rms (known to {known:.0f} %), {facts['expected_mm']:.2f} predicted"
    )
    off_mm = max(run["off_path_mm"] for run in ended)
    said = [
        f"touched and inserted in the simulator, the tip at most {off_mm:.3f} mm off its commanded path",
        f"without physics, the same {plural(len(ended), 'trial')} give {drawn['realised_in_the_same_truths_mm']:.2f} "
        f"mm, all {drawn['draws']} trials {drawn['realised_mm']:.2f} (known to {draws:.1f} %)",
    ]
    return text([Section(head, [*said, *refused])])
