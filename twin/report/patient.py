"""A patient's search, plan, rehearsal, registration and error budget as blocks that terminal and page both show."""

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from puncture_twin.planning.base.reasons import UNSEEN_AIR, Reason, css
from puncture_twin.planning.base.text import Facts, plural
from puncture_twin.planning.plan.plan import CLEARANCE_TEXT
from puncture_twin.planning.search.candidates import MOST_WINDOWS, Candidates, Window
from puncture_twin.planning.search.explain import deep_text
from puncture_twin.planning.search.uncertainty_breakdown import (
    LEAST_FRACTION,
    WAY_HEAD,
    UncertaintyBreakdown,
    chance_text,
    way_cells,
)
from puncture_twin.planning.uncertainty.sources import SOURCES
from puncture_twin.twin.report import numbers
from puncture_twin.twin.report.present import Block, Field, Table, Warn, bold, facts, grid, number, percent, vector

CONE_TEXT = {  # where the safe cone comes from
    "grid": "from the directions of the search, to one step; a certificate can prove it",
    "certificate": "proven by the certificate",
}

LEAST_SHOWN = 5e-5  # a chance or share below it rounds to nothing
SHOWN_MM = 0.005  # a source that costs less would be 0.00
NO_CHANCES = "No chances: they need markers, the arm, and a direction that is safe for the organs and the arm."
NOT_REQUESTED = "this run only searched; the plan command plans the arm's motion"
"""Text where no plan was requested."""

TRE_TEXT = "expected TRE at the target (rms), from the markers alone"
TIP_ERROR_TEXT = "expected tip error (rms), in the arm configuration of the plan"
"""Names of the errors of the registration, and of the whole insertion with the arm's declared errors."""

MOST_NEAREST = 12  # structures whose least clearance in a rehearsal is listed


def counts(candidates: Candidates) -> list[Block]:
    """Table of the directions by reason; also the map's legend, whose patches have the lines of the map."""
    patch = Markup('<span class="patch {}" style="background-color:{}"></span>{}')
    code, rows = Markup("<code>{}</code>"), []
    for line in numbers.reason_counts(candidates):
        lines = "hatched air" if line.colour == UNSEEN_AIR else "hatched"
        lines = lines if line.code == Reason.UNKNOWN_REGION.value else ""
        text = patch.format(lines, css(line.colour), line.text)
        rows.append((text, percent(line.solid_angle), f"{line.count:,}", code.format(line.code)))
    return [Table(("verdict", "of solid angle", "directions", "code"), tuple(rows)), f"{numbers.arm_text(candidates)}."]


def windows(candidates: Candidates, scan: Any | None) -> list[Block]:
    """The best candidate of each window, with the window's size, in digits that the voxels of the CT carry."""
    ranked = candidates.windows.windows
    if not ranked:
        return ["No direction is safe, so there is nothing to rank."]
    shown = f"the first {MOST_WINDOWS} of " if len(ranked) > MOST_WINDOWS else ""
    text = f"{shown}{plural(len(ranked), 'window')} (connected sets of safe directions), each with its best direction."
    if candidates.cone_source:
        source = CONE_TEXT[candidates.cone_source]
        text += f" Safe cone: angle by which the needle may be off and stay safe for the organs, {source}."
    return [grid(_window_fields(candidates, *numbers.carried_digits(scan)), ranked[:MOST_WINDOWS]), text]


def _window_fields(candidates: Candidates, digits: int, tolerance: str) -> list[Field]:
    button = Markup('<button type="button" class="pick" data-row="{}">{}</button>')

    def best(values: Any) -> Any:
        return lambda window: float(values[window.best])

    def nearest(window: Window) -> tuple[str, float]:
        return numbers.nearest_structure(candidates, window.best)

    path, ranking = candidates.path, candidates.ranking
    return [
        Field("window", lambda window: button.format(window.best, window.number)),
        Field("rank", lambda window: str(ranking.rank[window.best])),
        Field("θ °", lambda window: f"{np.degrees(candidates.theta[window.best]):.4g}"),
        Field("β °", lambda window: f"{np.degrees(candidates.beta[window.best]):.4g}"),
        Field("cost", best(ranking.cost), 3),
        Field(f"clearance{tolerance}", lambda window: nearest(window)[1], digits, "mm"),
        Field("nearest structure", lambda window: nearest(window)[0].replace("_", " ") or None),
        Field(f"path{tolerance}", best(path.length), digits, "mm"),
        Field("skin angle", best(np.degrees(path.skin_angle)), 0, "°"),
        Field("reach margin", best(candidates.arm.margin), 2),
        Field("safe cone", best(np.degrees(candidates.safe_cone)), 1, "°"),
        Field("window's area", lambda window: window.square_deg, 0, "deg²"),
        Field("on the skin, cm²", lambda window: f"{window.entry_cm2:.{int(window.entry_cm2 < 10)}f}"),
    ]


def plan(
    plan: Any | None, at_patient: Facts = (), refusal: str = "", *, declared: bool = False, notes: Sequence[str] = ()
) -> list[Block]:
    """The plan's numbers, or why there is none, and how its path, or that of the best direction, is found.

    `refusal` says why there is no plan although one was requested; `declared`, whether the case declares the arm's
    errors, which a plan's expected error then counts.
    """
    if plan is None:
        best = facts(at_patient)
        return [*([Warn((f"Planning failed: {refusal}",))] if refusal else []), *([best] if best.rows else [])]
    rows = [
        ("direction", f"θ {np.degrees(plan.theta):g}°, β {np.degrees(plan.beta):g}°"),
        ("arm", str(plan.model.name)),
        ("roll about the needle", f"{np.degrees(plan.roll):.1f}°"),
        ("standoff (tip to target)", number(plan.standoff_mm, 1, "mm")),
        *at_patient,
        ("entry point, CT frame", vector(plan.entry_ct, 1, "mm")),
        ("target, CT frame", vector(plan.target_ct, 1, "mm")),
        ("approach", f"{plan.approach.times_s[-1]:.1f} s, {len(plan.approach.q)} waypoints"),
        ("insertion", f"{plan.insertion.times_s[-1]:.1f} s, {len(plan.insertion.q)} waypoints"),
        *((CLEARANCE_TEXT[phase], number(float(mm), 1, "mm")) for phase, mm in plan.clearance_mm.items()),
        (TIP_ERROR_TEXT if declared else TRE_TEXT, numbers.expected_text(plan.expected_target_error_mm)),
        ("seed", str(plan.seed)),
    ]
    led = [Table(WAY_HEAD, tuple(map(way_cells, plan.guidance)))] if plan.guidance else []
    return [facts(rows), *led, *notes]


def rehearsal(
    done: Any, keep_away: frozenset[str], film: str | None = None, failures: Sequence[str] = ()
) -> list[Block]:
    """The rehearsal's numbers; clearances of the structures that the needle must keep away from; a link to the film."""
    touched = [
        f"{c.link} touches {c.body} at {c.time_s:.2f} s"
        f"{f' ({c.depth_mm:.2f} mm deep)' if math.isfinite(c.depth_mm) else ''}"
        for c in done.contacts
    ]
    fraction = np.max(done.max_joint_speed / done.speed_limits)
    by_name = {name: float(np.min(mm)) for name, mm in done.clearance_mm.items() if name in keep_away and len(mm)}
    least = sorted(by_name.items(), key=lambda item: item[1])
    name, mm = least[0] if least else ("nothing", math.nan)
    needle = f"keeps {number(mm, 2, 'mm')} or more from every structure to avoid; nearest: {name}"
    if mm < 0:
        needle = f"crosses {name}, which it must avoid{deep_text(mm)}"
    rows = [
        ("tip error at the end", bold(number(done.tip_error_mm, 2, "mm"))),
        *([] if done.standing is None else [("rank", done.standing.text)]),
        ("its lateral part", number(done.lateral_mm, 2, "mm")),
        ("its depth part", f"{number(abs(done.depth_mm), 2, 'mm')} too {'deep' if done.depth_mm >= 0 else 'shallow'}"),
        ("expected by the plan (rms)", numbers.expected_text(done.predicted_error_mm)),
        ("true needle", needle),
        ("contacts", "; ".join(touched) or "none"),
        ("insertion", done.followed_text),
        ("force", done.force_text),
        ("fastest joint", f"{100 * fraction:.0f} % of its limit{'' if fraction <= 1 else ' (too fast)'}"),
        ("joint speeds, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(done.max_joint_speed))),
        ("their limits, °/s", ", ".join(f"{v:.0f}" for v in np.degrees(done.speed_limits))),
        ("truth", str(getattr(done, "truth_source", "–"))),
        ("seed", str(done.seed)),
        *([("film", Markup('<a href="{}">{}</a>').format(film, film))] if film else ()),
    ]
    named = ((name.replace("_", " "), numbers.clearance_text(mm)) for name, mm in least[:MOST_NEAREST])
    nearest = Table(("structure", "least clearance mm"), tuple(named))
    more = f"The {MOST_NEAREST} nearest of {len(least)} structures to avoid."
    warned = Warn(tuple(f"the answer is no: {one}" for one in failures))
    return [warned, (facts(rows), nearest), *([more] if len(least) > MOST_NEAREST else [])]


def trials(summary: Mapping[str, Any] | None) -> list[Block]:
    """Results of many trials, beside what was predicted; nothing without trials."""
    if summary is None:
        return []
    if summary["realised_rms_mm"] is None:
        return [Warn((f"{plural(summary['rooms'], 'trial')}: the needle reached the target in none",))]
    touched = (
        (f"touched {name.replace('_', ' ')}", fraction, summary["p_touch_by_structure"][name])
        for name, fraction in summary["touch_share_by_structure"].items()
    )
    fractions = (
        ("inside the 95 % ellipsoid", summary["coverage_95"], 0.95),
        ("hit the target", summary["hit_share"], summary["mean_p_hit"]),
        ("touched a structure to avoid", summary["touch_share"], summary["mean_p_touch"]),
        *((text, fraction, chance) for text, fraction, chance in touched if max(fraction, chance) >= LEAST_SHOWN),
    )
    rows = [("tip error, rms, mm", f"{summary['realised_rms_mm']:.3f}", f"{summary['predicted_rms_mm']:.3f}")]
    rows += [(text, _percent(fraction), _percent(chance)) for text, fraction, chance in fractions]
    rows += _stepwise_rows(summary) if "steps" in summary else []
    led = f", guidance {summary['guidance']}" if "guidance" in summary else ""
    head = (f"{plural(summary['rooms'], 'trial')}, seed {summary['seed']}{led}", "realised", "predicted")
    return [Table(head, tuple(rows)), Warn(tuple(_reserves(summary))), *_sources(summary)]


def _stepwise_rows(summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """Rows of the same patients without control scans, and what these cost; predictions where there are some."""
    alone, sizes = summary["open_loop"], ", ".join(number(mm, 2) for mm in summary["correction_mm"] if mm is not None)
    rms = "-" if alone["realised_rms_mm"] is None else f"{alone['realised_rms_mm']:.3f}"
    hits = "-" if alone["hit_share"] is None else _percent(alone["hit_share"])
    return [
        ("open loop: tip error, rms, mm", rms, f"{alone['predicted_rms_mm']:.3f}"),
        ("open loop: hit the target", hits, _percent(alone["mean_p_hit"])),
        (f"corrections of {plural(summary['steps'], 'step')} (rms, mm: {sizes})", number(summary["passes"], 2), "-"),
        ("control scans, and their dose, mSv", f"{number(summary['scans'], 2)}: {number(summary['dose_msv'], 2)}", "-"),
        ("minutes (open loop)", f"{number(summary['minutes'], 1)} ({number(alone['minutes'], 1)})", "-"),
    ]


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.2f} %"


def _reserves(summary: Mapping[str, Any]) -> list[str]:
    said = []
    if summary["wrong_belief"]:
        said.append("The trials were drawn from [rehearsal.errors]: the belief is wrong by design.")
    if summary["unreached"]:
        said.append(f"In {summary['unreached']:,} trials the arm did not reach the pose; they are not counted.")
    if summary.get("stopped"):
        left = "a correction would have left the corridor, and the needle was stopped"
        counted = f"predicted: {_percent(summary['p_stop'])}; they do not hit, and are in no other number"
        said.append(f"In {summary['stopped']:,} trials {left} ({counted}).")
    notes = (*summary.get("assumed", ()), *summary.get("lost_sight", ()))
    said += [f"{one[0].upper()}{one[1:]}." for one in notes]
    if summary["guessed_touches"]:
        how = "a posture was assumed (touch.csv, q1_deg to q6_deg)"
        said.append(f"The arm's joints at the touches are not known: {how}.")
    return said


def _sources(summary: Mapping[str, Any]) -> list[Block]:
    fractions = sorted(summary.get("predicted_share", {}).items(), key=lambda source: -source[1])
    named = [f"{SOURCES[name].text} {100 * part:.0f} %" for name, part in fractions if part >= LEAST_FRACTION]
    said = [f"Sources of the predicted variance: {', '.join(named)}."] if named else []
    if summary.get("deflection_mm") is not None:
        said.append(f"The needle bends by {summary['deflection_mm']:.2f} mm, to a side drawn in each trial.")
    if "pushed_mm" in summary:
        said.append(f"The needle pushes the target on by {summary['pushed_mm']:.2f} mm.")
    if summary.get("physics") is not None:
        said.append(
            "{rooms} of them in the simulator: tips at most {largest_apart_mm:.4f} mm from the kinematic result; "
            "contacts in {rooms_with_contacts}.".format(**summary["physics"])
        )
    return [*said, f"Not modelled: {summary['not_modelled']}."]


def chances(breakdown: UncertaintyBreakdown | None, registration: Mapping[str, Any] | None) -> list[Block]:
    """Chances, expected error and its sources, the declaration's test, and what would have to be better."""
    if breakdown is None:
        return [Markup("<p>{}</p>").format(NO_CHANCES)]
    budget, (name, chance) = breakdown.budget, breakdown.likeliest
    rows = [
        ("chance to hit the target", bold(chance_text(breakdown.p_hit))),
        ("chance to touch a structure to avoid, at most", chance_text(breakdown.p_touch_any)),
        *([("most likely touched", f"{name.replace('_', ' ')}, {chance_text(chance)}")] if name else []),
        ("expected tip error (rms), this insertion", number(budget.rms_mm, 2, "mm")),
        ("across the needle (rms)", number(budget.lateral_mm, 2, "mm")),
        ("along the needle (rms)", number(budget.depth_mm, 2, "mm")),
        ("half axes of the 95 % ellipsoid", vector(budget.half_axes_mm, 2, "mm")),
        ("error of a marker, CT and touch (FLE, rms)", _fle(registration or {})),
        ("declared errors", breakdown.declaration),
        ("not modelled", breakdown.not_modelled),
    ]
    shares = ((SOURCES[source].text, f"{100 * fraction:.1f} %") for source, fraction in breakdown.sources())
    goals = Warn(tuple(goal.text() for goal in breakdown.goals))
    return [goals, (facts(row for row in rows if row[1]), Table(("source", "fraction of the variance"), tuple(shares)))]


def _fle(registration: Mapping[str, Any]) -> str:
    if registration.get("fle_mm") is None:
        return ""
    return number(registration["fle_mm"], 3, "mm") + _interval(registration.get("fle_interval_mm"))


def _interval(bounds: Sequence[float] | None, of: str = "") -> str:
    low, high = bounds or (0.0, 0.0)
    return f" ({of}95 %: {number(low, 3)} to {number(high, 3)})" if low < high else ""


REGISTRATION = (
    Field("method", lambda one: "joint fit of pose and arm" if one["method"] == "joint" else one["method"]),
    Field("FRE (rms residual; not the accuracy at the target)", "fre_mm", 3, "mm"),
    Field("mean residual (Chen 2019, Eq. 16)", "mean_error_mm", 3, "mm"),
    Field("FLE", _fle),
    Field("FLE from", "fle_source"),
    Field("TRE along the shaft, target to hub", lambda one: vector(one["expected_tre_along_shaft_mm"], 3, "mm")),
    Field("half axes of the 95 % ellipsoid at the target, from the readings alone", lambda one: vector(
        one["half_axes_95_mm"], 2, "mm")),
    Field("sources of its variance", lambda one: ", ".join(
        f"{name} {100 * part:.0f} %" for name, part in one["share"].items())),
    Field("marker spread s₂/s₁", "spread_ratio", 2),
    Field("least altitude of the triangle", "altitude_mm", 1, "mm"),
    Field("TRE(target)/FLE", "leverage", 2),
)  # fmt: skip


def registration(report: Mapping[str, Any] | None) -> list[Block]:
    """The registration's numbers from a mapping of plain values; absent ones are left out."""
    if not report:
        return [Markup("<p>The case has no markers: the patient's position is stated, or not known.</p>")]
    expected = number(report.get("expected_tre_target_mm", math.nan), 2, "mm")
    of_rms = _interval(report.get("expected_tre_target_interval_mm"), "of this rms, ")
    rows = [(TRE_TEXT, bold(expected) + of_rms), *facts(REGISTRATION, report).rows]
    flags, residuals = tuple(map(str, report.get("flags") or ())), report.get("residual_mm") or {}
    without = report.get("without") or {}
    markers = [
        Field("marker", lambda item: item[0]),
        Field("residual mm", lambda item: float(item[1]), 3),
        *([Field("TRE without it, mm", lambda item: without[item[0]]["rms_mm"], 3)] if without else []),
        *([Field("p without it", lambda item: f"{without[item[0]]['probability']:.2g}")] if without else []),
    ]
    flagged = Warn(tuple(f"weak: {flag}" for flag in flags)) if flags else "no flag raised"
    shown = (facts(rows), grid(markers, residuals.items())) if residuals else (facts(rows),)
    return [shown, flagged, *_advice(report)]


def _advice(report: Mapping[str, Any]) -> list[Block]:
    said: list[Block] = []
    if "one_insertion_95_mm" in report:
        said.append(
            f"one insertion ends within {report['one_insertion_95_mm']:.3f} mm in 95 of 100 cases, counting the "
            f"markers and the target, read {report['target_read']}; arm, needle and tissue add to it"
        )
    if "declaration" in report:
        said.append(report["declaration"]["text"])
    if report.get("one_more") is not None:
        more = report["one_more"]
        place = f"{vector(more['point_mm'], 0, 'mm')} {more['space']}"
        said.append(f"one more marker helps most at {place}: {more['rms_mm']:.3f} mm")
    if (correction := report.get("correction")) is not None:
        joints = ", ".join(f"{angle:.2f}" for angle in correction["joints_deg"])
        said.append((
            "aim corrected for the insertion at theta {theta_deg:.0f}, beta {beta_deg:.0f} (joints {joints} deg): "
            "moved by {moved_mm:.2f} mm and {turned_deg:.2f} deg; expected there {expected_mm:.2f} mm (rms), not "
            "corrected ({uncorrected_method}) {uncorrected_mm:.2f} mm; this relies on the arm errors in [errors]"
        ).format(**{**correction, "joints": joints}))  # fmt: skip
    return said


def budget(summary: Mapping[str, Any] | None) -> list[Block]:
    """Error budget: what each source costs, what one change would leave, and the change that wins most."""
    if summary is None:
        return []
    now, best = summary["expected_mm"], summary["best"]
    said = [f"Expected tip error of this insertion, markers and arm together: {now:.2f} mm (rms)"]
    if "limit_95_mm" in summary:
        said[0] += (
            ", inserted at theta {theta_deg:.0f}, beta {beta_deg:.0f}: {expected_lateral_mm:.2f} across it and "
            "{expected_depth_mm:.2f} along it; one of 20 insertions ends beyond {limit_95_mm:.2f} mm"
        ).format(**summary)
    if now - best["expected_mm"] >= SHOWN_MM:
        said.append(f"The next {now - best['expected_mm']:.2f} mm would be gained by: {best['text']}")
    sources = grid(
        (Field("source", "text"), Field("alone", "alone_mm", 2, "mm"), Field("all but this", "without_mm", 2, "mm")),
        (one for one in summary["sources"] if one["alone_mm"] >= SHOWN_MM),
    )
    changed = grid((Field("with this one change", "text"), Field("expected, mm", "expected_mm", 2)), summary["changes"])
    return [f"{'. '.join(said)}.", (sources, changed), f"Not modelled: {summary['not_modelled']}."]


def certificate(summary: Mapping[str, Any]) -> list[Block]:
    """A certificate's proof of the cap; where nothing is safe, that this is proven, and to what."""
    fraction = summary["undecided_share"]
    undecided = "" if fraction is None else f" ({100 * fraction:.2f} % of the cap)"
    area = f"{summary['undecided_square_deg']:.1f} square degrees{undecided}"
    if summary["safe_cells"] == 0:
        left = f", except perhaps in {area} of undecided cells" if summary["undecided_cells"] else ""
        touch = summary["touch"]
        reached = "is safe" if touch is None else f"keeps the margins for a chance to touch of {touch:g}"
        said = f"proven: no direction of the cap {reached}, to {summary['size_deg']:g} deg{left}"
    else:
        fraction = summary["safe_share"]
        safe = "" if fraction is None else f" ({100 * fraction:.1f} % of the cap)"
        said = f"certified to {summary['size_deg']:g} deg: safe {summary['safe_square_deg']:.1f} square degrees{safe}"
        said += f", undecided {area}"
    return [f"{said}; {summary['queries']} exact queries", f"not certified: {', '.join(summary['not_certified'])}"]
