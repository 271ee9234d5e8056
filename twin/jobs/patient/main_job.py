"""The main job, stage by stage over one growing `Run`: search, certify, plan, table, pictures, rehearsal, page.

`search_case`, `plan_case`, `rehearse_case` and `rehearse_plan` are the lists of stages; each stage, below, takes a run
and returns it with what it found and wrote. A stage loads what it needs itself: a search without pictures waits for no
planner, simulator or plotter.
"""

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.errors import InputError, NoAnswerError, refuse, require_extra
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.output.output_set import Draft, withdraw
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.budget.guidance import check_ways, with_ways
from puncture_twin.planning.clearance.fcl_engine import CrossChecked
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_document import MAX_PLAN_BYTES, parse_plan, write_plan
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.choice import BEST, Choice, choose_stated, with_file_read
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.table import write_table
from puncture_twin.twin.jobs.patient.run import FILM, PAGE, PICTURES, TRIALS, Run, TrialCount, case_draft

CERTIFICATE = "certificate.json"
CERTIFY_DEG = 0.25  # smallest cell of a certificate where nobody says
NO_PLAN = "no plan: "  # before the reason, whoever gives it: the choice, or the planner
DEMO_TRIALS = 1000  # what a stranger sees first is a distribution, where the case declares what it may be off by


class CertifyOptions(NamedTuple):
    """Options of a certificate: the smallest cell, and how often a structure may be touched."""

    size_deg: float
    touch: float | None


def certify_options(wanted: bool, size_deg: float | None, touch: float | None) -> CertifyOptions | None:
    """Options of a requested certificate; None without one. Options of one that nobody asked for are refused."""
    for option, value in (("--certify-touch", touch), ("--certify-size", size_deg)):
        if value is not None and not wanted:
            refuse("options of a certificate without --certify", option, "with --certify", "conflicting_options")
    return CertifyOptions(CERTIFY_DEG if size_deg is None else size_deg, touch) if wanted else None


def search_case(
    context: CaseContext,
    out: Path,
    *,
    pictures: bool = True,
    checked: CrossChecked | None = None,
    certify: CertifyOptions | None = None,
) -> Run:
    """Search; write ``candidates.parquet`` and, if wanted, the certificate, the pictures and the page."""
    if certify is not None:
        from puncture_twin.planning.certify.certificate import question_of

        question_of(context.case, context.anatomy)
    names = ("candidates.parquet", *(PICTURES if pictures else ()), *(() if certify is None else (CERTIFICATE,)))
    with case_draft(context, out, "search", names) as draft:
        run = Run(context, context.search(), (), checked=checked)
        run = run if certify is None else _certified(run, certify, draft.folder)
        run = _with_table(run, draft.folder)
        run = _with_pictures(run, draft.folder) if pictures else run
    return replace(run, files=draft.final(run.files))


def plan_case(context: CaseContext, out: Path, choice: Choice = BEST) -> Run:
    """Search and plan the best or the chosen candidate. Without a plan the search's files are written all the same."""
    context.require_arm()
    choice = _stated(context, out, choice)
    with case_draft(context, out, "plan", ("candidates.parquet", "plan.json", *PICTURES), choice.read) as draft:
        run = Run(context, context.search(), (), read=choice.read)
        run = _planned(run, draft.folder, choice)
        run = _with_table(run, draft.folder)
        run = _with_pictures(run, draft.folder)
    return _answered(run, draft, out)


def rehearse_case(context: CaseContext, out: Path, trials: TrialCount | None = None, choice: Choice = BEST) -> Run:
    """Plan, rehearse the plan, in many trials too besides the one that is filmed, and write everything."""
    from puncture_twin.twin.jobs.patient.pictures import draw_pictures, with_page
    from puncture_twin.twin.jobs.patient.rehearsed import begin_rehearsal, two_stages

    context.require_arm()
    choice = _stated(context, out, choice)
    names = ("candidates.parquet", "plan.json", "rehearsal.json", FILM, TRIALS, *PICTURES)
    with case_draft(context, out, "plan", names, choice.read) as draft, two_stages() as begin:
        run = Run(context, context.search(), (), read=choice.read)
        run = _planned(run, draft.folder, choice)
        run = _with_table(run, draft.folder)
        planned = run.files
        pending = None if run.plan is None else begin_rehearsal(run, trials, begin)  # while the pictures are drawn
        paged = partial(with_page, out=draft.folder, drawn=draw_pictures(run, draft.folder))
        run = paged(run) if pending is None else pending.ended(draft.folder, paged)
        if run.rehearsal is not None:  # the page shows it: it goes with it
            shown = {draft.folder / name for name in PICTURES if name != PAGE}
            draft.split("rehearse", *(path for path in run.files if path not in {*planned, *shown}))
    return _answered(run, draft, out)


def rehearsed_case(source: Path, case: Path | None, choice: Choice) -> Path:
    """The case of what is rehearsed, as `case_of`; a plan without its case is refused."""
    if (path := case_of(source, case, choice)) is None:
        refuse("a plan needs its case", source, "rehearse plan.json --case CASE", "missing_option")
    return path


def demo_case(context: CaseContext, out: Path) -> Run:
    """`rehearse_case` in `DEMO_TRIALS` trials if errors are declared; without a simulator `plan_case`, and a note."""
    try:
        require_extra("twin", "demo")
    except InputError as missing:
        context.watcher.note(f"warning: planned, not rehearsed: {missing}")
        return plan_case(context, out)
    trials = None if context.chance is None else TrialCount(DEMO_TRIALS)
    return rehearse_case(context, out, trials)


def _stated(context: CaseContext, out: Path, choice: Choice) -> Choice:
    """The choice with its file read, its direction checked before the search of all others is made for nothing."""
    if choice.of_grid:
        return choice
    choice = with_file_read(context.case, choice)
    try:
        choose_stated(context, choice)
    except NoAnswerError as error:
        withdraw(out, "plan")
        raise NoAnswerError(f"{NO_PLAN}{error}", counts=error.counts, code=error.code) from error
    return choice


def _answered(run: Run, draft: Draft, out: Path) -> Run:
    if run.plan is None:
        what = f"{NO_PLAN}{run.refusal}; see {out / 'report.html'}"
        raise NoAnswerError(what, counts=run.candidates.counts(), code="no_plan")
    return replace(run, files=draft.final(run.files))


def rehearse_plan(context: CaseContext, plan_path: Path, out: Path, trials: TrialCount | None = None) -> Run:
    """Check a written plan again and rehearse it; the scene is left out where the plan's own stands beside it."""
    from puncture_twin.twin.jobs.patient.rehearsed import begin_rehearsal
    from puncture_twin.twin.report.scene.scene_parts import Scene
    from puncture_twin.twin.report.scene.scene_picture import draw_scene

    source, plan, candidates = checked_plan(context, plan_path)
    with case_draft(context, out, "rehearse", ("rehearsal.json", FILM, TRIALS), (source,), source) as draft:
        run = begin_rehearsal(Run(context, candidates, (), plan, read=(source,)), trials, partial).ended(draft.folder)
        if not draft.source_has("scene.png"):
            with context.stages.time("scene"):
                draw_scene(Scene(context.case, context.anatomy, candidates, plan), draft.folder / "scene.png")
            run = run.with_files(draft.folder / "scene.png")
    return replace(run, files=draft.final(run.files))


def checked_plan(context: CaseContext, path: Path) -> tuple[Input, Plan, Candidates]:
    """A plan as its case moves the arm, where it comes from, and its direction; one that does not hold is refused."""
    from puncture_twin.planning.plan.plan_check import check_plan, with_case_arm

    source, plan = read_noted_plan(path, context.watcher.note)
    with context.stages.time("plan"):
        candidates = check_plan(plan, context, path, seed=context.case.rehearsal.seed)
        check_ways(context, plan, path)
    return source, with_case_arm(plan, context.case), candidates


def read_noted_plan(path: Path, note: Callable[[str], None]) -> tuple[Input, Plan]:
    """A plan of a whole set, or with a warning from outside of any, and the hash of the bytes that it was read from."""
    output = read_output(path, max_bytes=MAX_PLAN_BYTES)
    plan = parse_plan(output.data, path)
    if output.note:
        note(f"warning: {output.note}")
    return output.input("plan"), plan


def report_case(run: Run, out: Path) -> Run:
    """Write the pictures and the page of what is known."""
    with case_draft(run.context, out, "report", PICTURES) as draft:
        run = _with_pictures(run, draft.folder)
    return replace(run, files=draft.final(run.files))


def _certified(run: Run, wanted: CertifyOptions, out: Path) -> Run:
    from puncture_twin.planning.certify.certificate import with_safe_cone, write_certificate
    from puncture_twin.planning.certify.subdivision import certify

    context = run.context
    with context.stages.time("certify"):
        error, size = context.pose_error, float(np.radians(wanted.size_deg))
        certificate = certify(context.case, context.anatomy, size=size, touch=wanted.touch, error=error)
    with context.stages.time("safe cones"):
        certified = with_safe_cone(context.case, run.candidates, certificate)
    write_certificate(certificate, out / CERTIFICATE)
    return replace(run, candidates=certified, certificate=certificate).with_files(out / CERTIFICATE)


def _planned(run: Run, out: Path, choice: Choice) -> Run:
    """Plan what is chosen; where an approach fails to a candidate of the grid, the grid says so."""
    from puncture_twin.planning.plan.planner import make_plan

    context = run.context
    try:
        with context.stages.time("plan"):
            plan, searched, row = make_plan(context, run.candidates, choice)
            plan = with_ways(context, plan)
    except NoAnswerError as error:
        return replace(run, refusal=str(error).removeprefix(NO_PLAN))
    write_plan(plan, out / "plan.json")
    run = replace(run, plan=plan, pick=Pick(searched, row), candidates=searched if choice.of_grid else run.candidates)
    return run.with_files(out / "plan.json")


def _with_table(run: Run, out: Path) -> Run:
    path = out / "candidates.parquet"
    with run.context.stages.time("table"):
        write_table(run.candidates, path)
    return run.with_files(path)


def _with_pictures(run: Run, out: Path) -> Run:
    from puncture_twin.twin.jobs.patient.pictures import with_pictures

    return with_pictures(run, out)


def is_plan(source: Path) -> bool:
    """Whether a file is a plan rather than a case: by its name."""
    return source.suffix == ".json"


def case_of(source: Path, case: Path | None, choice: Choice) -> Path | None:
    """The case of a command: its source, or what is named beside a plan; None of a plan without its case."""
    if is_plan(source):
        if choice != BEST:
            refuse("a plan already has its direction", source, "a case, to choose a direction", "conflicting_options")
        return case
    if case is not None:
        refuse("two cases were given", "--case", "only CASE, or plan.json --case CASE", "conflicting_options")
    return source
