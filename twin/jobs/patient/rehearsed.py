"""Rehearsal of a plan in one trial or many: the stages in the simulator, and the files of their results."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from puncture_twin.planning.base.processes import process_pool, worker_count
from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.planning.budget.guidance import equipped, sight_of
from puncture_twin.twin.jobs.patient.run import FILM, TRIALS, Run, TrialCount, rehearsal_summary
from puncture_twin.twin.jobs.terminal import write_json
from puncture_twin.twin.rehearsal.distribution import Distribution, rehearse_trials
from puncture_twin.twin.rehearsal.plan_truth import error_rank, median_truth, plan_truth

if TYPE_CHECKING:
    from puncture_twin.planning.anatomy.anatomy import Anatomy
    from puncture_twin.planning.case.case import Case
    from puncture_twin.planning.plan.plan import Plan
    from puncture_twin.planning.search.context import CaseContext
    from puncture_twin.twin.plant.truth import Truth
    from puncture_twin.twin.rehearsal.result import Rehearsal


Wait = Callable[[], Any]  # gives what a stage makes, once
Begin = Callable[..., Wait]  # begins a stage with its arguments: in a process, or, by `partial`, when it is waited for


@contextmanager
def two_stages() -> Iterator[Begin]:
    """Begin stages in a process beside this one, if a core is free: a plan is filmed while its pictures are drawn."""
    if worker_count(2, 2) == 1:
        yield partial
        return
    with process_pool(1, 1) as pool:
        pool.submit(_load_simulator)
        yield lambda function, *arguments: pool.submit(function, *arguments).result


def _load_simulator() -> None:
    from puncture_twin.twin.rehearsal import rehearsal as _simulator
    from puncture_twin.twin.report.scene import film as _film

    del _simulator, _film


def _execute(plan: Plan, case: Case, anatomy: Anatomy, truth: Truth) -> Rehearsal:
    """Call `rehearse`; PyBullet is loaded in the process that calls this."""
    from puncture_twin.twin.rehearsal.rehearsal import rehearse

    return rehearse(plan, case, anatomy, truth)


def rehearse_once(context: CaseContext, plan: Plan, trials: TrialCount | None, seed: int | None) -> Rehearsal:
    """A plan rehearsed by a ground truth: the drawn one, or the median one of many trials."""
    distribution = None if trials is None else case_distribution(context, plan, trials, seed)
    truth = plan_truth(context, plan, seed) if distribution is None else median_truth(distribution)
    rehearsal = _execute(plan, context.case, context.anatomy, truth)
    rank = error_rank(context, plan.insertion.q[-1], distribution, rehearsal.tip_error_mm)
    return replace(rehearsal, standing=rank, distribution=distribution)


def _film(rehearsal: Rehearsal, plan: Plan, case: Case, anatomy: Anatomy, path: Path) -> Path:
    from puncture_twin.twin.report.scene.film import draw_film

    return draw_film(rehearsal, plan, case, anatomy, path)


@dataclass(frozen=True)
class PendingRehearsal:
    """A run whose plan is being executed: by whoever begins its stages."""

    run: Run
    begin: Begin
    rehearsal: Wait

    def ended(self, out: Path, with_page: Callable[[Run], Run] | None = None) -> Run:
        """The run with its rehearsal and film, once they are there; the numbers and the trials are written.

        `with_page` adds the page that shows them all to a run; while the film is made, which has the usual name but
        where no encoder can be started.
        """
        from puncture_twin.twin.report.error_pictures import draw_distribution

        run, time, trials = self.run, self.run.context.stages.time, self.run.distribution
        assert run.plan is not None
        if trials is not None:
            with time("rooms.png"):
                draw_distribution(trials, out / TRIALS)
        with time("rehearsal"):
            rehearsal: Rehearsal = self.rehearsal()
        rank = error_rank(run.context, run.plan.insertion.q[-1], trials, rehearsal.tip_error_mm)
        rehearsal = replace(rehearsal, standing=rank)
        film_at = self.begin(_film, rehearsal, run.plan, run.context.case, run.context.anatomy, out / FILM)
        shown, picture = ({}, ()) if trials is None else ({"distribution": trials.summary()}, (out / TRIALS,))
        document = {**rehearsal_summary(rehearsal), **shown, "inputs": inputs_document(run.inputs)}
        measured = replace(run, rehearsal=rehearsal).with_files(write_json(document, out / "rehearsal.json"))
        run = measured.with_files(out / FILM, *picture)
        run = run if with_page is None else with_page(run)
        with time("film"):
            film: Path = film_at()
        if film == out / FILM:
            return run
        run = measured.with_files(film, *picture)
        return run if with_page is None else with_page(run)


def begin_rehearsal(run: Run, trials: TrialCount | None, begin: Begin) -> PendingRehearsal:
    """Begin to rehearse the run's plan by a ground truth, the median one of many trials."""
    assert run.plan is not None
    context, plan = run.context, run.plan
    run = run if trials is None else replace(run, distribution=case_distribution(context, plan, trials))
    distribution = run.distribution
    truth = plan_truth(context, plan) if distribution is None else median_truth(distribution)
    return PendingRehearsal(run, begin, begin(_execute, plan, context.case, context.anatomy, truth))


def case_distribution(context: CaseContext, plan: Plan, trials: TrialCount, seed: int | None = None) -> Distribution:
    """A plan's tip errors over many trials, each with a ground truth of its own; the case's seed by default."""
    seed = context.case.rehearsal.seed if seed is None else seed
    with context.stages.time("rooms"):
        q = plan.insertion.q[-1]
        sight, (count, _, guidance, steps) = None, trials
        if guidance is not None:
            sight = sight_of(replace(context, case=equipped(context.case, guidance)[0]), plan, guidance)
        distribution = rehearse_trials(context, plan.outward_ct, q, count, seed, guidance, sight, steps)
    if distribution.stepwise is not None:
        moving_s = plan.approach.duration_s + plan.insertion.duration_s
        distribution = replace(distribution, stepwise=distribution.stepwise._replace(moving_s=moving_s))
    if not (trials.physics and len(distribution)):
        return distribution
    from puncture_twin.twin.rehearsal.plan_truth import physics_trials

    with context.stages.time("physics"):
        again = partial(context.watcher.count, "trials in the simulator")
        return replace(distribution, physics=physics_trials(context, plan, distribution, trials.physics, again))
