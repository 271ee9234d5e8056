"""``report.html``: everything about a run on one page that needs no network.

The page's slices: CT and overlay apart, so that a page can show the CT in every window.
"""

from __future__ import annotations

import base64
import io
import os
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup
from PIL import Image

from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.reasons import css
from puncture_twin.planning.formats.dicom.storage import is_dicom_file
from puncture_twin.planning.geometry.spaces import to_lps
from puncture_twin.planning.search.bedside import EntryFacts
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.choice import Pick, best_pick
from puncture_twin.planning.search.uncertainty_breakdown import UncertaintyBreakdown
from puncture_twin.planning.search.windows import find_windows
from puncture_twin.twin.report.error_pictures import budget_png
from puncture_twin.twin.report.map.map_raster import MapRaster
from puncture_twin.twin.report.map_view import step_of
from puncture_twin.twin.report.numbers import (
    TRUTH_IS_BELIEF,
    demanding,
    expected_text,
    nearest_text,
    needle_text,
    number,
    percent,
    reason_counts,
    target_text,
)
from puncture_twin.twin.report.page import page_tables as tables
from puncture_twin.twin.report.page.page_chances import chance_card, chances_section, rooms_section
from puncture_twin.twin.report.page.page_map import map_data
from puncture_twin.twin.report.page.page_scene import scene_figure
from puncture_twin.twin.report.page.page_tables import PROJECT, faint, table, two
from puncture_twin.twin.report.page.template import (
    Card,
    image_address,
    plotly_script,
    png_address,
    rehearsal_charts,
    script_json,
    write_html,
)
from puncture_twin.twin.report.slices.panel import TONES, Panel, grey_table, stored
from puncture_twin.twin.report.slices.sheet import Slices


class Uncertainty(NamedTuple):
    """What a page says of chances.

    Attributes:
        breakdown: Of the chosen direction, or None where it has no chances.
        rooms: A `Distribution` as plain values, or None.
        picture: ``rooms.png``, or None.
        budget: Of the chosen direction, as ``register --json`` has it, or None.
    """

    breakdown: UncertaintyBreakdown | None
    rooms: Mapping[str, Any] | None = None
    picture: Path | None = None
    budget: Mapping[str, Any] | None = None


def write_page(
    case: Any,
    anatomy: Any,
    candidates: Candidates,
    plan: Any | None,
    rehearsal: Any | None,
    registration: Mapping[str, Any] | None,
    path: Path,
    *,
    film: str | None = None,
    uncertainty: Uncertainty | None = None,
    pick: Pick | None = None,
    slices: Sequence[Slices] = (),
    facts: EntryFacts | None = None,
    refusal: str = "",
    raster: MapRaster | None = None,
) -> None:
    """Write the page.

    Args:
        case: The case.
        anatomy: Structures, skin, warnings.
        candidates: The search's rows.
        plan: The plan, or None.
        rehearsal: What was measured, or None.
        registration: The registration as plain values, or None.
        path: The HTML to write; it appears whole or not at all.
        film: Name of the rehearsal's film, which lies beside the page and is linked; None without one.
        uncertainty: What there is to say of chances and rooms; None where the case declares no errors.
        pick: The planned candidate, or the one to be shown; None shows the best.
        slices: What is shown in the CT, the first at once, the others where they are chosen.
        facts: How the planned or shown path is found at the patient.
        refusal: Why there is no plan although one was requested; "" where none was.
        raster: The map's pixels where somebody has them already.
    """
    pick = pick or best_pick(candidates)
    breakdown = None if uncertainty is None else uncertainty.breakdown
    seed = case.rehearsal.seed if plan is None else plan.seed
    write_html(
        "report.html",
        path,
        title=f"{case.name}: puncture of {target_text(case)}",
        stands=_location(case),
        dates=dates_text(case),
        needle=needle_text(case),
        sliced=bool(slices),
        tones=SHOWN_TONES if slices and slices[0].panels[0].hu is not None else (),
        methods=methods_text(case, anatomy, candidates),
        notice=TRUTH_IS_BELIEF if rehearsal is not None and rehearsal.truth_is_belief else "",
        refused=_refused(candidates),
        cards=_cards(candidates, pick, plan, rehearsal, breakdown, refusal),
        counts=tables.counts_table(candidates),
        best=tables.best_table(candidates),
        plan=tables.plan_section(
            plan, () if facts is None else facts.rows(), refusal, declared=uncertainty is not None
        ),
        registration=tables.registration_section(registration),
        rehearsal=tables.rehearsal_section(rehearsal, demanding(anatomy), film),
        warnings=tables.warnings_section((*(one.sentence for one in candidates.findings), *anatomy.warnings)),
        inputs=tables.inputs_table(case.inputs),
        origin=tables.origin_section(seed),
        data=script_json(_drawn(case, anatomy, candidates, plan, rehearsal, pick, slices, raster)),
        plotly=plotly_script(),
        **_uncertain_sections(uncertainty, registration),
    )


def _drawn(
    case: Any,
    anatomy: Any,
    candidates: Candidates,
    plan: Any | None,
    rehearsal: Any | None,
    pick: Pick | None,
    slices: Sequence[Slices],
    raster: MapRaster | None,
) -> dict[str, Any]:
    """What the page's script draws: map, scene, the rehearsal's charts and slices; arguments as of `write_page`."""
    return {
        "map": map_data(case, candidates, pick, raster),
        "scene": scene_figure(case, anatomy, candidates, plan, user_cache(), pick),
        "charts": None if rehearsal is None else rehearsal_charts(rehearsal, demanding(anatomy)),
        "slices": slices_data(slices),
        "target": [float(v) for v in case.target_ct],
        "probe_mm": float(case.needle.length_mm),
    }


def _uncertain_sections(uncertainty: Uncertainty | None, registration: Mapping[str, Any] | None) -> dict[str, Any]:
    """What the page says of chances, budget and rooms; nothing where the case declares no errors."""
    if uncertainty is None:
        return {"chances": None, "budget": None, "rooms": None}
    return {
        "chances": chances_section(uncertainty.breakdown, registration),
        "budget": None if uncertainty.budget is None else budget_section(uncertainty.budget),
        "rooms": rooms_section(uncertainty.rooms, uncertainty.picture),
    }


def _refused(candidates: Candidates) -> str:
    """What stands in place of the cards where nothing is safe; "" where something is."""
    if candidates.safe.any():
        return ""
    counts = ", ".join(f"{k.replace('_', ' ')}: {v:,}" for k, v in candidates.counts().items())
    return f"All {len(candidates):,} directions are refused ({counts})."


def _cards(
    candidates: Candidates,
    pick: Pick | None,
    plan: Any | None,
    rehearsal: Any | None,
    breakdown: UncertaintyBreakdown | None,
    refusal: str,
) -> list[Card]:
    safe = int(candidates.safe.sum())
    if safe == 0:
        return []
    cards = [] if breakdown is None else [chance_card(breakdown)]
    cards.append(_window_card(candidates))
    if pick is not None:
        cards.append(_direction_card(*pick, best=pick == best_pick(candidates)))
    if not candidates.arm_checked:
        cards.append(Card("arm", "not checked", candidates.arm_note.removeprefix("not checked: ")))
    if plan is None:
        cards.append(
            Card("plan", "failed", refusal, bad=True)
            if refusal
            else Card("plan", "not requested", tables.NOT_REQUESTED)
        )
    if rehearsal is not None:
        touched = len(rehearsal.contacts)
        detail = f"{touched} contact{'s' if touched != 1 else ''}" if touched else "no contact"
        expected = f"expected (rms) {expected_text(rehearsal.predicted_error_mm)}; {detail}"
        if rehearsal.standing is not None:
            expected = f"{rehearsal.standing.text}; {expected}"
        cards.append(Card("rehearsed tip error", number(rehearsal.tip_error_mm, 2, "mm"), expected))
    return cards


def _window_card(candidates: Candidates) -> Card:
    """What a person can aim at, before how much of all directions that is."""
    windows = find_windows(candidates)
    largest = windows.largest
    value, wide = ("", "") if largest is None else (f"{largest.entry_cm2:.1f} cm²", f"{largest.wide_deg:.0f}° wide")
    solid = percent(next(line.solid_angle for line in reason_counts(candidates) if line.code == "safe"))
    return Card(
        "safe directions" if candidates.arm_checked else f"directions {candidates.safe_text}",
        value,
        f"the largest window on the skin, {wide}; in {_counted(len(windows.windows), 'window')} {solid} "
        "of the solid angle",
    )


def _counted(count: int, noun: str) -> str:
    return f"{count} {noun}{'' if count == 1 else 's'}"


def _location(case: Any) -> str:
    """Case, space and target in the coordinates that the case is written in."""
    point = ", ".join(f"{mm:.1f}" for mm in to_lps(np.asarray(case.target_ct)[None], case.space)[0])
    return f"Case {case.name}; target {target_text(case)} at ({point}) mm {case.space};"


def _direction_card(candidates: Candidates, row: int, *, best: bool) -> Card:
    where = f"θ {np.degrees(candidates.theta[row]):.4g}°, β {np.degrees(candidates.beta[row]):.4g}°"
    detail = f"{number(float(candidates.path.length[row]), 1, 'mm')} in the body; {nearest_text(candidates, row)}"
    return Card("best direction" if best else "chosen direction", where, detail)


def methods_text(case: Any, anatomy: Any, candidates: Candidates) -> str:
    """What was checked, by what, and what was not."""
    theta, step = np.degrees(candidates.theta), np.degrees(step_of(candidates))
    checked = sum(1 for one in anatomy.checked if str(one.role) in {"avoid", "unknown"})
    arm_name = case.robot.model.name.upper()
    arm = (
        f"For each remaining direction it was checked whether a {arm_name} reaches it and inserts the "
        "needle without contact."
        if candidates.arm_checked
        else "The arm was not checked."
    )
    chances = (
        "Chances to hit and to touch were propagated from the declared errors of markers, touches and arm."
        if candidates.chances is not None
        else "No errors were declared, so that no chances were computed."
    )
    return (
        f"Straight needle paths to the target were searched with {PROJECT} {version(PROJECT)} over {len(candidates):,} "
        f"entry directions, θ {theta.min():g}° to {theta.max():g}° and every azimuth β of the case, in steps of "
        f"{step:g}° (angles as in Chen et al. 2019, Eq. 10-15; {needle_text(case)}). For each direction the distance "
        f"between the needle and each of {checked} structures to keep away from was computed exactly on their triangle "
        f"meshes and compared with the structure's margin; a direction through a region that the images or labels do "
        f"not show was refused as unknown. {arm} {chances} Every input is listed below with its SHA-256. "
        + _left_out(case)
    )


def _left_out(case: Any) -> str:
    """What was not modelled, and what was of breath and needle."""
    if case.breathing is None and case.bending is None:
        return "Breathing, needle bending and tissue motion were not modelled."
    return " ".join([_breath(case.breathing), _needle(case.bending), "The deformation of tissue was not modelled."])


def _breath(breath: Any) -> str:
    if breath is None:
        return "Breathing was not modelled."
    return (
        f"Breathing was taken as a motion of {breath.amplitude_mm:g} mm along one line after Lujan et al. 1999 "
        f"(exponent {breath.exponent}, {len(breath.positions)} positions), each structure with a weight of its own: a "
        f"safe direction is safe {breath.window_text}; a needle in place moves with the organ and bends."
    )


def _needle(bending: Any) -> str:
    if bending is None:
        return "Needle bending was not modelled."
    return (
        f"The needle was taken as a beam in an elastic foundation whose bevel cuts {np.degrees(bending.alpha):g}° off "
        "its direction (Webster et al. 2006); its greatest deflection to any side was kept as clearance."
    )


EPOCH = "SOURCE_DATE_EPOCH"
"""Seconds since 1970 that stand for "now", as tools take them that make the same bytes on every day."""


def dates_text(case: Any) -> str:
    """The day of the page and of its scan."""
    return f"Made on {made_on()} (UTC); scan of {scan_date(case) or 'a date that its files do not state'}."


def made_on() -> str:
    """Today, UTC."""
    stated = os.environ.get(EPOCH, "")
    at = datetime.fromtimestamp(int(stated), UTC) if stated.isascii() and stated.isdigit() else datetime.now(UTC)
    return at.date().isoformat()


def scan_date(case: Any) -> str:
    """The day of the first CT slice among a case's inputs; the empty string where none says so (as in NIfTI)."""
    for one in case.inputs:
        path = case.path.parent / one.path
        if is_dicom_file(path):
            from puncture_twin.planning.formats.dicom.recognise import recognise  # with pydicom: few cases need it

            found = recognise(path)
            if found is not None and found.is_slice:
                return found.date
    return ""


SHOWN_MM = 0.005
"""A source that costs less would be 0.00."""


def budget_section(facts: Mapping[str, Any]) -> Markup:
    """The picture, and its numbers.

    Args:
        facts: As ``register --json`` has them under ``budget``, of the direction that is shown.
    """
    now, best = facts["expected_mm"], facts["best"]
    won = now - best["expected_mm"]
    head = f"Expected tip error of this insertion: {now:.2f} mm (rms)"
    text = f"{head}. The next {won:.2f} mm is won by {best['text']}." if won >= SHOWN_MM else f"{head}."
    form = (
        "<p>{}</p>"
        '<p><img src="{}" style="max-width:100%" alt="What each source of the error costs, and what changes leave"></p>'
    )
    sources = [
        (one["text"], f"{one['alone_mm']:.2f}", f"{one['without_mm']:.2f}")
        for one in facts["sources"]
        if one["alone_mm"] >= SHOWN_MM
    ]
    changes = [(one["text"], f"{one['expected_mm']:.2f}") for one in facts["changes"]]
    numbers = two(
        table(("source", "alone, mm", "all but it, mm"), sources, kind="numbers"),
        table(("with this one change", "expected, mm"), changes, kind="numbers"),
    )
    shown = Markup(form).format(text, png_address(budget_png(facts)))
    return shown + numbers + faint(f"Not modelled: {facts['not_modelled']}.")


MOST_BYTES = 2_900_000
"""Of all slices on a page: the directions beyond it are left out, the last windows first."""

QUALITY, COLOURS = 72, 128
"""Of the CT as JPEG, and of the overlay's palette: both were looked at."""

OVERLAY_LEVEL = 6
"""How hard overlays are packed: at 9 they take seven times as long and are a fifteenth smaller."""

SHOWN_TONES = ("abdomen", "lung", "bone")


def slices_data(shown: Sequence[Slices]) -> dict[str, Any]:
    """What the page's script shows, of as many directions as `MOST_BYTES` takes; the first always."""
    directions: list[dict[str, Any]] = []
    size = 0
    for one in shown:
        data = _direction(one)
        size += sum(len(part) for panel in data["panels"] for part in (panel["ct"], panel["over"])) + len(data["units"])
        if directions and size > MOST_BYTES:
            break
        directions.append(data)
    return {"directions": directions, "tones": {name: grey_table(TONES[name]) for name in SHOWN_TONES}}


def _direction(one: Slices) -> dict[str, Any]:
    pick = one.subject.pick
    return {
        **({} if pick is None else pick.candidates.at(pick.row)),
        "panels": [_panel(panel) for panel in one.panels],
        "units": "" if one.units is None else image_address(one.units.quantize(COLOURS), OVERLAY_LEVEL),
        "legend": [[name.replace("_", " "), css(colour)] for name, colour in one.legend],
        "notes": list(one.notes),
    }


def _panel(panel: Panel) -> dict[str, str]:
    ct = ""
    if panel.hu is not None:
        stream = io.BytesIO()
        Image.fromarray(stored(panel.hu)).save(stream, format="JPEG", quality=QUALITY)
        ct = "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
    over = image_address(Image.fromarray(panel.overlay).quantize(COLOURS), OVERLAY_LEVEL)
    return {"name": panel.plane.name, "ct": ct, "over": over}
