"""A plan executed in one room or in many: what is asked of the simulator, and what is written of its answer."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.jobs.patient.run import FILM, ROOMS, RoomCount, Run
from puncture_twin.twin.jobs.patient.summaries import rehearsal_summary
from puncture_twin.twin.jobs.rehearser import Rehearser
from puncture_twin.twin.jobs.second_process import Asked, Beside
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_trials
from puncture_twin.twin.rehearsal.plan_truth import error_scale, median_truth, plan_truth


@dataclass(frozen=True)
class Begun:
    """A run whose plan is being executed and filmed, here or beside: see `Rehearser`."""

    run: Run
    rehearsal: Asked
    film: Asked

    def ended(self, out: Path, with_page: Callable[[Run], Run] | None = None) -> Run:
        """The run with what was measured and the film, once they are there; the numbers and the rooms are written.

        Args:
            out: The folder of the files.
            with_page: Adds the page that shows them all to a run; while the film is made, which has the usual name
                but where no encoder can be started.

        Raises:
            InputError: See `rehearse`.
        """
        shown = self._rooms_drawn(out)
        rehearsal = _awaited(self.run, "rehearsal", self.rehearsal)
        document = {**rehearsal_summary(rehearsal), **shown, "inputs": inputs_document(self.run.inputs)}
        measured = replace(self.run, rehearsal=rehearsal).with_files(_write_json(document, out / "rehearsal.json"))
        rooms = (out / ROOMS,) if shown else ()
        run = measured.with_files(out / FILM, *rooms)
        run = run if with_page is None else with_page(run)
        film = _awaited(run, "film", self.film)
        if film == out / FILM:
            return run
        run = measured.with_files(film, *rooms)
        return run if with_page is None else with_page(run)

    def _rooms_drawn(self, out: Path) -> dict[str, Any]:
        """What the rehearsal's file says of many rooms, their picture being drawn; nothing where there are none."""
        from puncture_twin.twin.report.error_pictures import draw_rooms_picture

        found = self.run.distribution
        if found is None:
            return {}
        with self.run.context.stages.time("rooms.png"):
            draw_rooms_picture(found, out / ROOMS)
        return {"distribution": found.summary()}


def begin_rehearsal(run: Run, out: Path, rooms: RoomCount | None, beside: Beside) -> Begun:
    """Have the run's plan executed where the truth differs, of many rooms in the median one, and filmed.

    Raises:
        InputError: See `plan_truth`.
        NoAnswerError: See `plan_truth`.
    """
    assert run.plan is not None
    context, plan = run.context, run.plan
    run = run if rooms is None else replace(run, distribution=_distribution(run, rooms))
    found = run.distribution
    truth = plan_truth(context, plan) if found is None else median_truth(found)
    scale = error_scale(context, plan.insertion.q[-1], found)
    executed = beside.ask(Rehearser.rehearse, plan, truth, scale)
    return Begun(run, executed, beside.ask(Rehearser.film, out / FILM))


def _awaited(run: Run, stage: str, asked: Asked) -> Any:
    """The answer, its time booked where it was spent."""
    stages = run.context.stages
    if not asked.done() and stages.announce is not None:
        stages.announce(stage)
    value, seconds = asked.result()
    stages.seconds[stage] = stages.seconds.get(stage, 0.0) + seconds
    return value


def _distribution(run: Run, count: RoomCount) -> Distribution:
    assert run.plan is not None
    context = run.context
    with context.stages.time("rooms"):
        q = run.plan.insertion.q[-1]
        found = rehearse_trials(context, run.plan.outward_ct, q, count.rooms, context.case.rehearsal.seed)
    if not (count.physics and len(found)):
        return found
    from puncture_twin.twin.rehearsal.plan_truth import physics_trials

    with context.stages.time("physics"):
        again = partial(context.watcher.count, "rooms in the simulator")
        return replace(found, physics=physics_trials(context, run.plan, found, count.physics, again))


def _write_json(summary: dict[str, Any], path: Path) -> Path:
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(summary, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path
