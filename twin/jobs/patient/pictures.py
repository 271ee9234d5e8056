"""The pictures and the page of a run; the picture of a needle that was confirmed."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from scipy import ndimage

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.output.output_set import writing
from puncture_twin.planning.base.provenance import read_inputs
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.registration.checks.markers import touchable_points
from puncture_twin.planning.search.candidates import Pick
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.search.explain import Explanation
from puncture_twin.twin.jobs.patient.budget import budget_facts
from puncture_twin.twin.jobs.patient.run import FILM, PAGE, SLICES, TRIALS, Run, case_draft, registration_summary
from puncture_twin.twin.report.error_pictures import budget_figure
from puncture_twin.twin.report.figures import halo, write_png
from puncture_twin.twin.report.map.map_picture import draw_map
from puncture_twin.twin.report.map.map_raster import MapRaster, map_raster
from puncture_twin.twin.report.map_view import map_view
from puncture_twin.twin.report.page.page import Shown, Uncertainty, write_page
from puncture_twin.twin.report.palette import SKIN, organ_colours
from puncture_twin.twin.report.scene.scene_parts import Scene
from puncture_twin.twin.report.scene.scene_picture import draw_scene
from puncture_twin.twin.report.slices.panel import Subject
from puncture_twin.twin.report.slices.planes import Plane, letters, needle_planes, outline
from puncture_twin.twin.report.slices.sheet import draw_slices, write_sheet

EDGES = {(0.06, 0.56): (-1, 0), (0.94, 0.56): (1, 0), (0.5, 0.03): (0, -1), (0.5, 0.97): (0, 1)}
"""Places of the patient's directions on a panel, as fractions of it, and along which of its axes."""
SLICE_PIXELS, INCHES, DPI = 320, 9.0, 100
WINDOW_HU = (-160.0, 240.0)


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
    context, candidates = run.context, run.candidates
    case, anatomy, stages = context.case, context.anatomy, context.stages
    with stages.time("map"):
        raster = map_raster(candidates, map_view(case, candidates))
        draw_map(candidates, case, out / "map.png", run.pick, raster=raster, scan=anatomy.scan)
    with stages.time("scene"):
        base = _checked_base(run)
        scene = Scene(case, anatomy, candidates, run.plan, pick=run.pick, T_base_ct=base, refusal=run.refusal)
        draw_scene(scene, out / "scene.png")
    with stages.time("slices"):
        pick = run.pick or candidates.best
        subject = None if pick is None else _subject(context, pick, run.plan)
        if subject is not None:
            write_sheet(draw_slices(subject), out / SLICES)
    sheet = () if subject is None else (out / SLICES,)
    return Drawn((*sheet, out / "map.png", out / "scene.png"), subject, raster)


def with_page(run: Run, out: Path, drawn: Drawn) -> Run:
    """The run with its pictures, and with the page of all that is known."""
    context, candidates = run.context, run.candidates
    case, anatomy, stages = context.case, context.anatomy, context.stages
    placement, shown = context.placement, None
    if placement is not None and placement.registration is not None:
        registered = registration_summary(placement.registration)
        shown = {**registered, "expected_tre_target_mm": placement.target_error_mm}
    film = next((path.name for path in run.files if path.stem == Path(FILM).stem and path.suffix != ".json"), None)
    with stages.time("page"):
        page = Shown(
            case,
            anatomy,
            candidates,
            run.plan,
            run.rehearsal,
            shown,
            film=film,
            uncertainty=_uncertainty(run),
            pick=run.pick,
            subject=drawn.subject,
            T_base_ct=None if run.refusal else _checked_base(run),
            regions_ct=context.regions_ct(candidates.arm.q_insertion),
            facts=run.facts,
            refusal=run.refusal,
            raster=drawn.raster,
            notes=run.plan_notes,
            failures=run.failures,
        )
        write_page(page, out / PAGE)
    return run.with_files(*drawn.files, out / PAGE)


def _checked_base(run: Run) -> Floats | None:
    """T_base_ct of an arm that was checked; None where it was not."""
    placement = run.context.placement
    return placement.T_base_ct if placement is not None and run.candidates.arm_checked else None


def write_budget_picture(report: Mapping[str, Any], path: Path) -> Path:
    """Write the error budget of a registration's report, as an entry of its folder's set."""
    _check_png(path)
    budget = report.get("budget")
    if budget is None:
        refuse("no error budget to draw", "--picture", "a case with [errors] and an arm", "no_error_budget")
    inputs = read_inputs(report["inputs"])
    with writing(path.parent, f"register {path.name}", inputs=inputs, names=(path.name,), note=lambda _: None) as draft:
        write_png(budget_figure(budget), draft.folder / path.name)
    return path


def write_check_picture(context: CaseContext, explained: Explanation, path: Path) -> Path:
    """Write the slices of one explained direction, as an entry of its folder's set; safe or not."""
    _check_png(path)
    with case_draft(context, path.parent, f"check {path.name}", (path.name,)) as draft:
        write_sheet(draw_slices(_subject(context, Pick(explained.candidates, 0))), draft.folder / path.name)
    return path


def _subject(context: CaseContext, pick: Pick, plan: Plan | None = None) -> Subject:
    """A direction, with the region of its tip as planned or as the search reaches it."""
    q = pick.candidates.arm.q_insertion[pick.row] if plan is None else plan.insertion.q[-1]
    regions = context.regions_ct(q[None])
    known = regions is not None and np.isfinite(regions).all()
    return Subject(context.case, context.anatomy, pick, regions[0] if known and regions is not None else None)


def _uncertainty(run: Run) -> Uncertainty | None:
    """Chances on the page: of the plan as the arm executes it, or without one of the best direction."""
    context, candidates = run.context, run.candidates
    if context.case.errors is None:
        return None
    picture = next((path for path in run.files if path.name == TRIALS), None)
    trials = None if run.distribution is None else run.distribution.summary()
    if run.plan is not None:
        q = run.plan.insertion.q[-1]
        return Uncertainty(context.breakdown_at(run.plan.outward_ct, q), trials, picture, _budget(context, q))
    if not len(candidates.ranked):
        return Uncertainty(None, trials, picture)
    row = candidates.ranked[0]
    breakdown = context.explain(candidates.theta[row], candidates.beta[row]).breakdown
    return Uncertainty(breakdown, trials, picture, _budget(context, candidates.arm.q_insertion[row]))


def _budget(context: CaseContext, q_insertion: Floats) -> Mapping[str, Any] | None:
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


def draw_confirmed(done: Any, path: Path) -> Path:
    """Draw the control scan in the axial plane of the tip, along the real needle twice, and across it at its tip."""
    figure = Figure(figsize=(INCHES, INCHES), dpi=DPI)
    planes = needle_planes(done.needle.tip_ct, -done.needle.forward_ct, done.line.inserted_mm)
    for axes, plane in zip(figure.subplots(2, 2).ravel(), planes, strict=True):
        _draw_scan(axes, done, plane)
        _draw_lines(axes, done, plane)
        _draw_frame(axes, done, plane)
    figure.tight_layout(rect=(0, 0.03, 1, 1))
    handles, named = figure.axes[0].get_legend_handles_labels()
    figure.legend(handles, named, loc="lower left", ncols=4, fontsize=8, facecolor="0.35", labelcolor="white")
    figure.text(0.99, 0.012, "research software, not a medical device", fontsize=8, color="0.4", ha="right")
    write_png(figure, path)
    return path


def _draw_scan(axes: Axes, done: Any, plane: Plane) -> None:
    """The scan in a plane, with the outlines of the planning CT's structures carried to it."""
    index = apply(np.linalg.inv(done.volume.T_ct_index) @ done.tie.T_scan_ct, plane.points_ct(SLICE_PIXELS)).T
    shown = ndimage.map_coordinates(done.volume.values, index, np.float64, order=1, cval=-1024.0)
    (x, y), half, (low, high) = plane.centre, plane.half_mm, WINDOW_HU
    extent = (x - half, x + half, y - half, y + half)
    axes.imshow(shown.reshape(SLICE_PIXELS, SLICE_PIXELS), cmap="gray", vmin=low, vmax=high, extent=extent)
    anatomy = done.context.anatomy
    colours = organ_colours(tuple(one.name for one in anatomy.structures))
    meshes = [*((one.mesh, colours[one.name]) for one in anatomy.structures), (anatomy.skin.mesh, SKIN)]
    for mesh, colour in meshes:
        axes.add_collection(LineCollection(list(outline(mesh, plane)), colors=css(colour), linewidths=0.8))
    axes.set(xlim=extent[:2], ylim=extent[2:])


def _draw_lines(axes: Axes, done: Any, plane: Plane) -> None:
    rim, needle = halo(3, "black"), done.needle
    axes.plot(*plane.place(needle.path_ct).T, color="cyan", linewidth=0.8, label="needle as read")
    axes.plot(*plane.place(needle.tip_ct), "x", color="cyan", path_effects=rim, label="its tip")
    if done.plan is not None:
        ends = np.stack([done.plan.target_ct, done.plan.entry_ct])
        axes.plot(*plane.place(ends).T, "--", color="magenta", linewidth=0.8, label="planned line")
    target = plane.place(done.context.case.target_ct)
    axes.plot(*target, "+", color="#38d39f", markersize=12, path_effects=rim, label="target")


def _draw_frame(axes: Axes, done: Any, plane: Plane) -> None:
    axes.set_title(plane.name.replace("target", "tip"), fontsize=9)
    axes.set_xlabel("mm", fontsize=7, labelpad=1)
    axes.tick_params(labelsize=7)
    for at, toward in EDGES.items():
        letter = letters(done.context.case.space, toward[0] * plane.right + toward[1] * plane.up)
        look: dict[str, Any] = {"color": "white", "ha": "center", "va": "center", "weight": "bold"}
        axes.text(*at, letter, transform=axes.transAxes, path_effects=halo(3, "black"), **look)
