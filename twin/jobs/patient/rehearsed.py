"""The stage that needs the simulator: a plan executed in one room or in many, the numbers and the film.

Imported only where something is rehearsed: search, plan and page do without PyBullet.
"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.twin.jobs.patient.names import FILM, ROOMS
from puncture_twin.twin.jobs.patient.run import RoomCount, Run
from puncture_twin.twin.jobs.patient.summaries import rehearsal_summary
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_rooms
from puncture_twin.twin.rehearsal.physics import physics_rooms
from puncture_twin.twin.rehearsal.plan_truth import median_truth, plan_truth, standing
from puncture_twin.twin.rehearsal.rehearsal import Rehearsal, rehearse
from puncture_twin.twin.report.rooms_picture import draw_rooms_picture
from puncture_twin.twin.report.scene.film import draw_film


def rehearsed(run: Run, out: Path, rooms: RoomCount | None) -> Run:
    """Execute the run's plan where the truth differs, of many rooms the median, write the numbers and the film."""
    assert run.plan is not None
    context, plan = run.context, run.plan
    run = run if rooms is None else replace(run, distribution=_distribution(run, rooms))
    rehearsal = _executed(run, plan)
    shown = {} if run.distribution is None else {"distribution": run.distribution.summary()}
    document = {**rehearsal_summary(rehearsal), **shown, "inputs": inputs_document(run.inputs)}
    run = replace(run, rehearsal=rehearsal).with_files(_write_json(document, out / "rehearsal.json"))
    with context.stages.time("film"):
        film = draw_film(
            rehearsal,
            plan,
            context.case,
            context.anatomy,
            out / FILM,
            progress=partial(context.watcher.count, "film"),
        )
    run = run.with_files(film)
    if run.distribution is None:
        return run
    with context.stages.time("rooms.png"):
        draw_rooms_picture(run.distribution, out / ROOMS)
    return run.with_files(out / ROOMS)


def _executed(run: Run, plan: Plan) -> Rehearsal:
    """One rehearsal in the simulator, and where its error stands among those of the rooms, or in the prediction."""
    context, found = run.context, run.distribution
    with context.stages.time("rehearsal"):
        truth = plan_truth(context, plan) if found is None else median_truth(found)
        done = rehearse(plan, context.case, context.anatomy, truth)
        return replace(done, standing=standing(context, plan.insertion.q[-1], done.tip_error_mm, found))


def _distribution(run: Run, count: RoomCount) -> Distribution:
    assert run.plan is not None
    context = run.context
    with context.stages.time("rooms"):
        q = run.plan.insertion.q[-1]
        found = rehearse_rooms(context, run.plan.outward_ct, q, count.rooms, context.case.rehearsal.seed)
    if not (count.physics and len(found)):
        return found
    with context.stages.time("physics"):
        again = partial(context.watcher.count, "rooms in the simulator")
        return replace(found, physics=physics_rooms(context, run.plan, found, count.physics, again))


def _write_json(summary: dict[str, Any], path: Path) -> Path:
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path
