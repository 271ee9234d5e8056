"""The pictures and the page of a run."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import read_inputs
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.checks.places import touchable_points
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation
from puncture_twin.twin.jobs.patient.budget import budget_facts
from puncture_twin.twin.jobs.patient.run import FILM, PAGE, ROOMS, SLICES, Run, registration_summary
from puncture_twin.twin.report.error_pictures import draw_budget
from puncture_twin.twin.report.map.map_picture import draw_map
from puncture_twin.twin.report.map.map_raster import MapRaster, map_raster
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page.page import Shown, Uncertainty, write_page
from puncture_twin.twin.report.scene.scene_picture import draw_scene
from puncture_twin.twin.report.slices.panel import Subject
from puncture_twin.twin.report.slices.sheet import draw_slices, write_sheet


class Drawn(NamedTuple):
    """The pictures of a search and its plan: their files, and what the page shows of them too."""

    files: tuple[Path, ...]
    subject: Subject | None
    raster: MapRaster


def with_pictures(run: Run, out: Path) -> Run:
    """Draw the map, the scene, the slices and the page of what is known."""
    return with_page(run, out, draw_pictures(run, out))


def draw_pictures(run: Run, out: Path) -> Drawn:
    """Draw the map, the scene and the slices, which show what was searched and planned."""
    context, found = run.context, run.candidates
    case, anatomy, stages = context.case, context.anatomy, context.stages
    with stages.time("map"):
        raster = map_raster(found, map_view(case, found))
        draw_map(found, case, out / "map.png", run.pick, raster, anatomy.scan)
    with stages.time("scene"):
        T_base_ct = _checked_base(run)
        draw_scene(case, anatomy, found, run.plan, out / "scene.png", run.pick, T_base_ct, failed=bool(run.refusal))
    with stages.time("slices"):
        pick = run.pick or found.best
        subject = None if pick is None else _subject(context, pick, run.plan)
        if subject is not None:
            write_sheet(draw_slices(subject), out / SLICES)
    sheet = () if subject is None else (out / SLICES,)
    return Drawn((*sheet, out / "map.png", out / "scene.png"), subject, raster)


def with_page(run: Run, out: Path, drawn: Drawn) -> Run:
    """The run with its pictures, and with the page of all that is known."""
    context, found = run.context, run.candidates
    case, anatomy, stages = context.case, context.anatomy, context.stages
    shown = _registration(context)
    film = next((path.name for path in run.files if path.stem == Path(FILM).stem and path.suffix != ".json"), None)
    with stages.time("page"):
        page = Shown(
            case,
            anatomy,
            found,
            run.plan,
            run.rehearsal,
            shown,
            film=film,
            uncertainty=_uncertainty(run),
            pick=run.pick,
            subject=drawn.subject,
            T_base_ct=None if run.refusal else _checked_base(run),
            regions_ct=context.regions_ct(found.arm.q_insertion),
            facts=run.facts,
            refusal=run.refusal,
            raster=drawn.raster,
            notes=run.plan_notes,
            failures=run.failures,
        )
        write_page(page, out / PAGE)
    return run.with_files(*drawn.files, out / PAGE)


def _checked_base(run: Run) -> Floats | None:
    """Where the patient is for an arm that was checked; None where it was not."""
    placement = run.context.placement
    return placement.T_base_ct if placement is not None and run.candidates.arm_checked else None


def _registration(context: CaseContext) -> dict[str, Any] | None:
    """As ``register --json`` has it; None without markers."""
    placement = context.placement
    if placement is None or placement.registration is None:
        return None
    return {**registration_summary(placement.registration), "expected_tre_target_mm": placement.target_error_mm}


def write_budget_picture(report: Mapping[str, Any], path: Path) -> Path:
    """Write the error budget of a registration's report, as an entry of its folder's set.

    Raises:
        InputError: Not a PNG's name, no budget to draw, or a folder or file that cannot be written.
    """
    _check_png(path)
    budget = report.get("budget")
    if budget is None:
        refuse("no error budget to draw", "--picture", "a case with [errors] and an arm", "no_error_budget")
    inputs = read_inputs(report["inputs"])
    with writing(path.parent, f"register {path.name}", inputs=inputs, names=(path.name,), note=lambda _: None) as draft:
        draw_budget(budget, draft.folder / path.name)
    return path


def write_check_picture(context: CaseContext, explained: Explanation, path: Path) -> Path:
    """Write the slices of one explained direction, as an entry of its folder's set; safe or not.

    Raises:
        InputError: Not a PNG's name, or a folder or file that cannot be written.
    """
    _check_png(path)
    inputs, note = context.case.inputs, context.watcher.note
    with writing(path.parent, f"check {path.name}", inputs=inputs, names=(path.name,), note=note) as draft:
        write_sheet(draw_slices(_subject(context, Pick(explained.candidates, 0))), draft.folder / path.name)
    return path


def _subject(context: CaseContext, pick: Pick, plan: Plan | None = None) -> Subject:
    """A direction, with the region of its tip as planned or as the search reaches it."""
    q = pick.candidates.arm.q_insertion[pick.row] if plan is None else plan.insertion.q[-1]
    regions = context.regions_ct(q[None])
    known = regions is not None and np.isfinite(regions).all()
    return Subject(context.case, context.anatomy, pick, regions[0] if known and regions is not None else None)


def _uncertainty(run: Run) -> Uncertainty | None:
    """What the page says of chances: of the plan as it is moved, or without one of the best direction."""
    context, found = run.context, run.candidates
    if context.case.errors is None:
        return None
    picture = next((path for path in run.files if path.name == ROOMS), None)
    rooms = None if run.distribution is None else run.distribution.summary()
    if run.plan is not None:
        q = run.plan.insertion.q[-1]
        return Uncertainty(context.breakdown_at(run.plan.outward_ct, q), rooms, picture, _budget(context, q))
    if not len(found.ranked):
        return Uncertainty(None, rooms, picture)
    row = found.ranked[0]
    breakdown = context.explain(found.theta[row], found.beta[row]).breakdown
    return Uncertainty(breakdown, rooms, picture, _budget(context, found.arm.q_insertion[row]))


def _budget(context: CaseContext, q_insertion: Floats) -> Mapping[str, Any] | None:
    """Of one insertion; None where markers or the arm do not say."""
    registration = context.placement.registration if context.placement is not None else None
    if registration is None or not np.isfinite(q_insertion).all():
        return None
    case, anatomy = context.case, context.anatomy
    touchable = touchable_points(case, anatomy.skin.mesh, registration.T_base_ct)
    with context.stages.time("budget"):
        return budget_facts(case, registration, touchable, lambda: anatomy, q_insertion)


def _check_png(path: Path) -> None:
    if path.suffix.lower() != ".png":
        refuse(f"'{path.name}' is not the name of a PNG file", "--picture", "FILE.png", "bad_file_name")
    if not path.parent.is_dir():
        refuse("there is no such folder", path.parent, "an existing folder", "not_a_folder")
