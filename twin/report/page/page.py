"""``report.html``: everything about a run on one page that needs no network."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import Severity
from puncture_twin.planning.base.text import plural
from puncture_twin.planning.formats.dicom.storage import is_dicom_file
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.candidates import Candidates, Pick
from puncture_twin.planning.search.uncertainty_breakdown import UncertaintyBreakdown, chance_text
from puncture_twin.twin.report import numbers, patient, present
from puncture_twin.twin.report.error_pictures import budget_figure, rehearsal_png
from puncture_twin.twin.report.figures import png
from puncture_twin.twin.report.map.map_raster import MapRaster
from puncture_twin.twin.report.map_view import grid_step
from puncture_twin.twin.report.page.page_data import arm_data, map_data, picked_row, scene_figure
from puncture_twin.twin.report.page.page_slices import slices_data
from puncture_twin.twin.report.page.template import base64_text, plotly_script, script_json, write_html
from puncture_twin.twin.report.present import Card
from puncture_twin.twin.report.scene.scene_parts import Scene
from puncture_twin.twin.report.slices.panel import TONES, Subject

EPOCH = "SOURCE_DATE_EPOCH"  # seconds since 1970 that stand for "now", for the same bytes on every day


class Uncertainty(NamedTuple):
    """Chances on a page; `breakdown` and `budget` are of the chosen direction, `trials` sums up a `Distribution`."""

    breakdown: UncertaintyBreakdown | None
    trials: Mapping[str, Any] | None = None
    picture: Path | None = None
    budget: Mapping[str, Any] | None = None


@dataclass(frozen=True, eq=False)
class Shown(Scene):
    """Content of the page of a run."""

    rehearsal: Any | None = None
    registration: Mapping[str, Any] | None = None
    film: str | None = None  # name of the rehearsal's film, which lies beside the page and is linked
    uncertainty: Uncertainty | None = None  # None where the case declares no errors
    subject: Subject | None = None  # what the slices show first
    regions_ct: Floats | None = None  # shape (n, 3, 3), mm^2: of the tip, as `CaseContext.regions_ct`
    facts: EntryFacts | None = None  # how the planned or shown path is found at the patient
    raster: MapRaster | None = None
    notes: Sequence[str] = ()  # what else must be known of the plan; `failures` say why the rehearsal's answer is no
    failures: Sequence[str] = ()


def write_page(shown: Shown, path: Path) -> None:
    """Write the page; it appears whole or not at all."""
    case, candidates, plan, done = shown.case, shown.candidates, shown.plan, shown.rehearsal
    at_patient, away = () if shown.facts is None else shown.facts.rows(), numbers.demanding(shown.anatomy)
    declared, scan = shown.uncertainty is not None, shown.anatomy.scan
    point = ", ".join(f"{mm:.1f}" for mm in to_lps(np.asarray(case.target_ct)[None], case.space)[0])
    study, warned = scan_date(case), (*(one.sentence for one in candidates.findings), *shown.anatomy.warnings)
    noted = tuple(one.sentence for one in shown.anatomy.findings if one.severity is Severity.NOTE)
    rehearsed: list[present.Block] = []
    if done is not None:
        alt = "True tip to true target, and true needle to true structures, over time"
        curves = present.picture(rehearsal_png(done, away), alt)
        rehearsed = [*patient.rehearsal(done, away, shown.film, shown.failures), curves]
    data, ct, surfaces = _script_data(shown)
    write_html(
        "report.html",
        path,
        title=f"{case.name}: puncture of {numbers.target_text(case)}",
        stands=f"Case {case.name}; target {numbers.target_text(case)} at ({point}) mm {case.space};",
        dates=dates_text(study),
        needle=numbers.needle_text(case),
        tones=() if scan is None else tuple(TONES),
        methods=methods_text(case, shown.anatomy, candidates),
        notice=numbers.TRUTH_IS_BELIEF if done is not None and done.truth_is_belief else "",
        refused="" if candidates.safe.any() else _all_rejected(candidates),
        cards=_cards(shown),
        counts=present.blocks_html(patient.counts(candidates)),
        best=present.blocks_html(patient.windows(candidates, scan)),
        plan=present.blocks_html(patient.plan(plan, at_patient, shown.refusal, declared=declared, notes=shown.notes)),
        planned="Plan" if plan is not None or shown.refusal else "The best path at the patient",
        registration=present.blocks_html(patient.registration(shown.registration)) if shown.registration else "",
        rehearsal=present.blocks_html(rehearsed) if rehearsed else "",
        study=study,
        warnings=present.blocks_html(
            [present.Warn(warned) if warned else Markup("<p>None.</p>"), present.Warn(noted, f"Notes ({len(noted)})")]
        ),
        inputs=present.inputs_table(case.inputs),
        origin=present.origin_section(case.rehearsal.seed if plan is None else plan.seed),
        data=script_json(data),
        ct=base64_text(ct),
        surfaces=base64_text(surfaces),
        plotly=plotly_script(),
        **_uncertain_sections(shown.uncertainty, shown.registration),
    )


def _script_data(shown: Shown) -> tuple[dict[str, Any], bytes, bytes]:
    """Data of the page's script, and the bytes of its slices: the CT, and the surfaces that they cut."""
    case, candidates, pick = shown.case, shown.candidates, shown.chosen
    subject = shown.subject or Subject(case, shown.anatomy, pick or Pick(candidates, 0))
    slices, ct, surfaces = slices_data(subject, candidates, picked_row(candidates, pick), shown.regions_ct)
    data = {
        "map": map_data(case, candidates, pick, shown.raster),
        "scene": scene_figure(shown),
        "arm": arm_data(shown),
        "slices": slices,
        "target": [float(v) for v in case.target_ct],
        "probe_mm": float(case.needle.length_mm),
    }
    return data, ct, surfaces


def _all_rejected(candidates: Candidates) -> str:
    counts = ", ".join(f"{k.replace('_', ' ')}: {v:,}" for k, v in candidates.counts().items())
    return f"{plural(len(candidates), 'direction')} searched, all rejected ({counts})."


def _uncertain_sections(uncertainty: Uncertainty | None, registration: Mapping[str, Any] | None) -> dict[str, Any]:
    if uncertainty is None:
        return {"chances": None, "budget": None, "rooms": None}
    facts, tips = uncertainty.budget, uncertainty.picture
    costs = "Error sources, and the effect of single changes"
    budget = patient.budget(facts)
    budget[1:1] = [] if facts is None else [present.picture(png(budget_figure(facts)), costs)]
    trials = patient.trials(uncertainty.trials)
    if trials and tips is not None:
        trials.append(present.picture(tips, "Tips of all trials in the frame of the needle"))
    return {
        "chances": present.blocks_html(patient.chances(uncertainty.breakdown, registration)),
        "budget": present.blocks_html(budget) if budget else None,
        "rooms": present.blocks_html(trials),
    }


def _cards(shown: Shown) -> list[Card]:
    candidates, rehearsal, refusal = shown.candidates, shown.rehearsal, shown.refusal
    if not candidates.safe.any():
        return []
    breakdown = None if shown.uncertainty is None else shown.uncertainty.breakdown
    cards = []
    if breakdown is not None and shown.chosen is not None:
        touched, rms = chance_text(breakdown.p_touch_any), present.number(breakdown.budget.rms_mm, 2, "mm")
        detail = (
            f"{_angles(*shown.chosen)}; touches a structure to avoid {touched}; expected tip error {rms} (rms); "
            f"not modelled: {breakdown.not_modelled}"
        )
        cards.append(Card("chance to hit", chance_text(breakdown.p_hit), detail))
    cards.append(_window_card(candidates))
    if shown.chosen is not None:
        (searched, row), scan = shown.chosen, shown.anatomy.scan
        path = numbers.length_text(float(searched.path.length[row]), scan)
        detail = f"{path} in the body; {numbers.nearest_text(searched, row, scan)}"
        name = "best direction" if shown.chosen == candidates.best else "chosen direction"
        cards.append(Card(name, _angles(searched, row), detail))
    if not candidates.arm_checked:
        cards.append(Card("arm", "not checked", candidates.arm_note.removeprefix("not checked: ")))
    if shown.plan is None:
        failed = Card("plan", "failed", refusal, bad=True)
        cards.append(failed if refusal else Card("plan", "not requested", patient.NOT_REQUESTED))
    if rehearsal is not None:
        contacts = len(rehearsal.contacts)
        detail = plural(contacts, "contact") if contacts else "no contact"
        expected = f"expected (rms) {numbers.expected_text(rehearsal.predicted_error_mm)}; {detail}"
        if rehearsal.standing is not None:
            expected = f"{rehearsal.standing.text}; {expected}"
        cards.append(Card("rehearsed tip error", present.number(rehearsal.tip_error_mm, 2, "mm"), expected))
    return cards


def _window_card(candidates: Candidates) -> Card:
    """The card of the largest window on the skin, and the fraction of all directions that is safe."""
    windows = candidates.windows
    largest = windows.largest
    area, width = ("", "") if largest is None else (f"{largest.entry_cm2:.1f} cm²", f"{largest.wide_deg:.0f}° wide")
    solid = present.percent(next(line.solid_angle for line in numbers.reason_counts(candidates) if line.code == "safe"))
    return Card(
        "safe directions" if candidates.arm_checked else f"directions {candidates.safe_text}",
        area,
        f"the largest window on the skin, {width}; in {plural(len(windows), 'window')} {solid} of the solid angle",
    )


def _angles(candidates: Candidates, row: int) -> str:
    return f"θ {np.degrees(candidates.theta[row]):.4g}°, β {np.degrees(candidates.beta[row]):.4g}°"


def methods_text(case: Any, anatomy: Any, candidates: Candidates) -> str:
    """Text of the methods: what was checked, by what, and what was not."""
    theta, step = np.degrees(candidates.theta), np.degrees(grid_step(candidates))
    checked = sum(1 for one in anatomy.checked if str(one.role) in {"avoid", "unknown"})
    arm = "The arm was not checked."
    chances = "No chances were computed: they need declared errors, markers, and the arm."
    if candidates.arm_checked:
        arm = f"For each remaining direction it was checked whether a {case.robot.model.name.upper()} reaches it and "
        arm += "inserts the needle without contact."
    if candidates.chances is not None and np.isfinite(candidates.chances.hit).any():
        chances = "Chances to hit and to touch were propagated from the declared errors of markers, touches and arm."
    moving = "Breathing, needle bending and tissue motion were not modelled."
    if case.breathing is not None or case.bending is not None:
        breath, needle = "Breathing was not modelled.", "Needle bending was not modelled."
        if (one := case.breathing) is not None:
            breath = (
                f"Breathing was taken as a motion of {one.amplitude_mm:g} mm along one line after Lujan et al. 1999 "
                f"(exponent {one.exponent}, {len(one.positions)} positions), each structure with a weight of its own: "
                f"a safe direction is safe {one.window_text}; a needle in place moves with the organ and bends."
            )
        if case.bending is not None:
            needle = (
                "The needle was taken as a beam in an elastic foundation whose bevel cuts "
                f"{np.degrees(case.bending.alpha):g}° off its direction (Webster et al. 2006); its greatest deflection "
                "to any side was kept as clearance."
            )
        moving = f"{breath} {needle} The deformation of tissue was not modelled."
    program = f"{present.PROJECT} {version(present.PROJECT)}"
    return (
        f"Straight needle paths to the target were searched with {program} over {len(candidates):,} entry directions, "
        f"θ {theta.min():g}° to {theta.max():g}° and every azimuth β of the case, in steps of {step:g}° (angles as in "
        f"Chen et al. 2019, Eq. 10-15; {numbers.needle_text(case)}). For each direction the distance between the "
        f"needle and each of {checked} structures to keep away from was computed exactly on their triangle meshes and "
        "compared with the structure's margin; a direction through a region that the images or labels do not show was "
        f"rejected as unknown. {arm} {chances} Every input is listed below with its SHA-256. {moving}"
    )


def dates_text(scan: str) -> str:
    """The day of the page, today in UTC, and that of its scan."""
    stated = os.environ.get(EPOCH, "")
    at = datetime.fromtimestamp(int(stated), UTC) if stated.isascii() and stated.isdigit() else datetime.now(UTC)
    return f"Made on {at.date().isoformat()} (UTC); {f'scan of {scan}' if scan else 'scan date not stated'}."


def scan_date(case: Any) -> str:
    """The day of the first CT slice among a case's inputs; the empty string where none says so (as in NIfTI)."""
    for one in case.inputs:
        path = case.path.parent / one.path
        if is_dicom_file(path):
            from puncture_twin.planning.formats.dicom.recognise import recognise  # with pydicom: few cases need it

            file = recognise(path)
            if file is not None and file.is_slice:
                return file.date
    return ""
