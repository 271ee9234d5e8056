"""What the commands print for a person. Plain values in, text out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.constraints import closest_miss
from puncture_twin.planning.search.explain import deep_text, needle_warnings, reason_text
from puncture_twin.planning.search.sides import sides_text
from puncture_twin.planning.search.windows import find_windows
from puncture_twin.planning.uncertainty.sources import SOURCES
from puncture_twin.twin.jobs.patient.budget import budget_lines, correction_lines
from puncture_twin.twin.jobs.patient.run import Run
from puncture_twin.twin.jobs.patient.summaries import plan_summary, rehearsal_summary
from puncture_twin.twin.report.numbers import TRUTH_IS_BELIEF

if TYPE_CHECKING:  # it brings the planner with it
    from puncture_twin.planning.export.exporter import Exported

LEAST_SOURCE = 0.005
"""Of the variance: a smaller source is not named to people."""

NOTABLE = 0.05
"""Of an expected error: by as much two configurations' differ before people are told."""

SAME_AIM = 0.02
"""rad: joints that differ by less are of one insertion; an arm's errors do the same there within a fiftieth."""

LEAST_SHOWN = 5e-5
"""A chance or share below it rounds to nothing in what people read."""


CONE_TEXT = {"grid": "as far as the grid tells", "certificate": "proven by the certificate", "": "not known"}


def search_text(run: Run) -> str:
    """Counts, the best ten, or what came closest; then the files."""
    return "\n".join([*_search(run), *_footer(run)])


def plan_text(run: Run) -> str:
    """The search, then the plan; then the files."""
    return "\n".join([*_search(run), *_plan(run), *_footer(run)])


def rehearsal_text(run: Run) -> str:
    """The search and the plan, then where the tip ended; then the files."""
    rooms = [] if run.distribution is None else distribution_lines(run.distribution.summary())
    return "\n".join([*_notice(run), *_search(run), *_plan(run), *_rehearsal(run), *rooms, *_footer(run)])


def _notice(run: Run) -> list[str]:
    """What must be read first."""
    return [f"NOTE: {TRUTH_IS_BELIEF}"] if run.rehearsal is not None and run.rehearsal.truth_is_belief else []


def _search(run: Run) -> list[str]:
    found = run.candidates
    lines = [f"case {run.context.case.name}: {find_windows(found).headline}"]
    looked = f", looked from: {sides_text(run.context.sides, searched=True)}" if run.context.sides else ""
    lines += [f"{len(found)} direction{'s' if len(found) != 1 else ''}{looked}"]
    counts = ((found.safe_text if reason == "safe" else reason, count) for reason, count in found.counts().items())
    lines += [f"  {count:7d}  {reason}" for reason, count in counts]
    lines += [*needle_warnings(run.context.case, found), *(one.sentence for one in found.findings)]
    lines += [] if found.arm_checked else [f"arm {found.arm_note}"]
    return lines + (_best(run) if found.safe.any() else _nothing_safe(run))


def _plan(run: Run) -> list[str]:
    assert run.plan is not None
    plan = plan_summary(run.plan)
    error = plan["expected_target_error_mm"]
    return [
        f"plan: theta {plan['theta_deg']:g} deg, beta {plan['beta_deg']:g} deg, standoff {plan['standoff_mm']:.1f} mm",
        *(f"  {label:18s} {value}" for label, value in (() if run.facts is None else run.facts.rows())),
        f"  approach {plan['approach_s']:.1f} s, insertion {plan['insertion_s']:.1f} s",
        f"  {_expected(run, error)}",
        *_otherwise(run.candidates, run.plan),
        *_other_aim(run),
    ]


def _expected(run: Run, error_mm: float | None) -> str:
    """What the tip is expected to miss the target by, and of what: only rooms count a needle that bends."""
    if error_mm is None:
        return "expected tip error: unknown (no markers)"
    if run.context.chance is None:
        return f"expected TRE at the target: {error_mm:.2f} mm (rms), markers alone: no [errors] declare the arm's"
    straight = "" if run.context.case.bending is None else ", of a needle that does not bend"
    return f"expected tip error: {error_mm:.2f} mm (rms), in the plan's configuration of the arm{straight}"


def _otherwise(candidates: Candidates, plan: Plan) -> list[str]:
    """That the table's row of the plan's direction is of another configuration, where that tells."""
    row = np.flatnonzero((candidates.theta == plan.theta) & (candidates.beta == plan.beta))
    if candidates.chances is None or not len(row):
        return []
    other = float(np.hypot(candidates.chances.lateral_mm[row[0]], candidates.chances.depth_mm[row[0]]))
    if not abs(other - plan.expected_target_error_mm) > NOTABLE * plan.expected_target_error_mm:
        return []
    return [f"    in the configuration of the table and of check {other:.2f} mm: an approach may end in another one"]


def _other_aim(run: Run) -> list[str]:
    """That the pose was corrected for another insertion, and what would correct it for this one."""
    assert run.plan is not None
    registration = None if run.context.placement is None else run.context.placement.registration
    q = run.plan.insertion.q[-1]
    if registration is None or registration.aim is None or np.abs(q - registration.aim.q).max() < SAME_AIM:
        return []
    joints = ", ".join(f"{angle:.2f}" for angle in np.degrees(q))
    return [f"    the aim is corrected for another insertion; for this one: correct_joints_deg = [{joints}]"]


def _rehearsal(run: Run) -> list[str]:
    assert run.rehearsal is not None
    done = rehearsal_summary(run.rehearsal)
    kept = {s.name: done["least_clearance_mm"][s.name] for s in run.context.anatomy.structures if s.demands_margin}
    nearest = min(kept.items(), key=lambda item: item[1], default=("nothing", float("nan")))
    return [
        f"rehearsal (seed {done['seed']}): the tip ended {done['tip_error_mm']:.2f} mm from the true target"
        + ("" if run.rehearsal.standing is None else f", {run.rehearsal.standing.text}"),
        f"  lateral {done['lateral_mm']:.2f} mm, depth {done['depth_mm']:+.2f} mm (+ is too deep)",
        f"  insertion {run.rehearsal.followed_text}",
        f"  {run.rehearsal.force_text}",
        f"  {_true_needle(*nearest)}",
        f"  arm contacts: {'; '.join(done['contacts']) or 'none'}",
        *(f"  the answer is no: {failure}" for failure in run.failures),
    ]


def _true_needle(name: str, clearance_mm: float) -> str:
    if clearance_mm < 0:
        return f"the true needle crosses what it must avoid: {name}{deep_text(clearance_mm)}"
    return f"least clearance of the true needle to what it must avoid: {clearance_mm:.2f} mm, {name}"


def distribution_lines(rooms: dict[str, Any]) -> list[str]:
    """What happened in many rooms, beside what was predicted; share and chance by structure where there is any."""
    if rooms["realised_rms_mm"] is None:
        return [f"{rooms['rooms']} rooms: in none did the arm reach the pose that its registration asked for"]
    wrong = ", drawn from [rehearsal.errors]: the belief is wrong by design" if rooms["wrong_belief"] else ""
    guessed = ["  nobody says how the arm touched the markers: a posture was assumed (touch.csv, q1_deg to q6_deg)"]
    missed = [f"  in {rooms['unreached']} of them the arm did not reach the pose; they are not counted"]
    chances = [
        f"    {name}: touched in {100 * fraction:.2f} %, predicted {100 * rooms['p_touch_by_structure'][name]:.2f} %"
        for name, fraction in rooms["touch_share_by_structure"].items()
        if max(fraction, rooms["p_touch_by_structure"][name]) >= LEAST_SHOWN
    ]
    sources = sorted(rooms["predicted_share"].items(), key=lambda source: -source[1])
    return [
        f"{rooms['rooms']} rooms, seed {rooms['seed']}{wrong}:                realised   predicted",
        f"  tip error, rms             {rooms['realised_rms_mm']:12.3f} {rooms['predicted_rms_mm']:11.3f} mm",
        f"  inside the 95 % ellipsoid  {100 * rooms['coverage_95']:12.1f} {95.0:11.1f} %",
        f"  hit the target             {100 * rooms['hit_share']:12.2f} {100 * rooms['mean_p_hit']:11.2f} %",
        f"  touched anything           {100 * rooms['touch_share']:12.2f} {100 * rooms['mean_p_touch']:11.2f} %",
        *chances,
        "  of the predicted variance: "
        + ", ".join(f"{SOURCES[name].text} {100 * part:.0f} %" for name, part in sources if part >= LEAST_SOURCE),
        *_bent(rooms.get("deflection_mm")),
        *(missed if rooms["unreached"] else []),
        *(guessed if rooms["guessed_touches"] else []),
        *_physics(rooms.get("physics")),
        f"  not modelled: {rooms['not_modelled']}",
    ]


def _bent(tip_mm: float | None) -> list[str]:
    return [] if tip_mm is None else [f"  the needle bends by {tip_mm:.2f} mm, to a side drawn in each room"]


def _physics(run_again: dict[str, Any] | None) -> list[str]:
    if run_again is None:
        return []
    return [
        f"  {run_again['rooms']} of them in the simulator: tips at most {run_again['largest_apart_mm']:.4f} mm "
        f"from those of the kinematics; contacts in {run_again['rooms_with_contacts']}"
    ]


def certificate_lines(summary: dict[str, Any]) -> list[str]:
    """What a certificate says of the cap; where nothing is safe, that this is proven, and to what."""
    fraction = summary["undecided_share"]
    undecided = "" if fraction is None else f" ({100 * fraction:.2f} % of the cap)"
    area = f"{summary['undecided_square_deg']:.1f} square degrees{undecided}"
    if summary["safe_cells"] == 0:
        left = f", except perhaps in {area} of undecided cells" if summary["undecided_cells"] else ""
        reached = (
            "is safe" if summary["touch"] is None else f"keeps the margins of a chance to touch of {summary['touch']:g}"
        )
        said = f"proven: no direction of the cap {reached}, to {summary['size_deg']:g} deg{left}"
    else:
        fraction = summary["safe_share"]
        safe = "" if fraction is None else f" ({100 * fraction:.1f} % of the cap)"
        said = f"certified to {summary['size_deg']:g} deg: safe {summary['safe_square_deg']:.1f} square degrees{safe}"
        said += f", undecided {area}"
    return [f"{said}; {summary['queries']} exact queries", f"  not certified: {', '.join(summary['not_certified'])}"]


def certificate_text(report: dict[str, Any]) -> str:
    """What the plain checker proved."""
    done = report["verified"]
    return "\n".join(
        [
            f"{report['certificate']}: every cell holds",
            f"  {done['safe']} safe and {done['rejected']} rejected cells proven again, {done['undecided']} undecided",
            *certificate_lines(report),
        ]
    )


def export_text(done: Exported, case_checked: bool) -> str:
    """What was written, and what whoever runs it should know."""
    checked = "" if case_checked else "the plan was not held against its case again: name it with --case"
    notes = [note for note in (*done.notes, checked) if note]
    direction = f"theta {np.degrees(done.plan.theta):g} deg, beta {np.degrees(done.plan.beta):g} deg"
    lines = [f"{done.format_name}: {done.path}", f"  direction: {direction}", *(f"  {note}" for note in notes)]
    return "\n".join([*lines, *(f"warning: {one}" for one in done.plan.warnings)])


def registration_text(report: dict[str, Any]) -> str:
    """Residuals, expected error and weak points of a registration."""
    method = "joint fit of pose and arm" if report["method"] == "joint" else report["method"]
    lines = [f"case {report['case']}: registration by {method}"]
    if "target_mm" in report:
        place = ", ".join(f"{mm:g}" for mm in report["target_mm"])
        lines.append(f"  target ({place}) mm {report['space']}")
    lines += [f"  marker {name}: residual {mm:.3f} mm" for name, mm in report["residual_mm"].items()]
    lines += [
        f"  FRE {report['fre_mm']:.3f} mm, mean residual {report['mean_error_mm']:.3f} mm",
        "  (the residuals are not the accuracy at the target)",
        f"  FLE {report['fle_mm']:.3f} mm, {report['fle_source']}{_interval(report['fle_interval_mm'])}",
        f"  expected TRE at the target {report['expected_tre_target_mm']:.3f} mm (rms), markers alone"
        + _interval(report["expected_tre_target_interval_mm"], "of that rms, "),
        f"  one insertion ends within {report['one_insertion_95_mm']:.3f} mm in 95 of 100, by the markers and by the "
        f"target, read {report['target_read']}; arm, needle and tissue come on top",
        *_along_shaft(report["expected_tre_along_shaft_mm"]),
        f"  spread s2/s1 {report['spread_ratio']:.2f}, altitude {report['altitude_mm']:.0f} mm, "
        f"TRE/FLE {report['leverage']:.2f}",
    ]
    lines += _declared_lines(report)
    for kind, key in (("weak", "flags"), ("warning", "warnings"), ("note", "notes")):
        lines += [f"  {kind}: {sentence}" for sentence in report[key]]
    return "\n".join(lines)


def _along_shaft(expected_mm: Sequence[float]) -> list[str]:
    return ["  along the shaft, target to hub: " + ", ".join(f"{mm:.3f}" for mm in expected_mm)] if expected_mm else []


def _declared_lines(report: dict[str, Any]) -> list[str]:
    """What the declared errors say of a registration; nothing without them."""
    if "declaration" not in report:
        return []
    axes = ", ".join(f"{mm:.2f}" for mm in report["half_axes_95_mm"])
    lines = [
        f"  95 % ellipsoid at the target, by the readings alone: half axes {axes} mm",
        "  of its variance: " + ", ".join(f"{name} {100 * part:.0f} %" for name, part in report["share"].items()),
        f"  {report['declaration']['text']}",
    ]
    lines += [
        f"  without {name}: expected TRE {one['rms_mm']:.3f} mm, p of the residuals {one['probability']:.2g}"
        for name, one in report["without"].items()
    ]
    if report["one_more"] is not None:
        more = report["one_more"]
        place = ", ".join(f"{mm:.0f}" for mm in more["point_mm"])
        lines.append(f"  one more marker helps most at ({place}) mm {more['space']}: {more['rms_mm']:.3f} mm")
    return [*lines, *correction_lines(report.get("correction")), *budget_lines(report["budget"])]


def _interval(bounds: Sequence[float], of: str = "") -> str:
    """A 95 % interval; nothing where both bounds are one."""
    low, high = bounds
    return "" if low == high else f" ({of}95 %: {low:.3f} to {high:.3f})"


def _best(run: Run) -> list[str]:
    summary = run.summary()
    head = "the best of each window"
    if summary["windows"] > len(summary["best"]):
        head += f" (the first {len(summary['best'])} of {summary['windows']})"
    cones = CONE_TEXT[summary["safe_cone_from"]]
    lines = [
        f"{head}; cone: off by so much in any direction a needle stays safe for the organs, {cones}",
        "window  rank  theta   beta   cost  clearance  path  angle  reach   cone   window's area   on the skin",
        "                 deg    deg               mm    mm    deg            deg           deg2           cm2",
    ]
    for best in summary["best"]:
        reach = "    -" if best["reach_margin"] is None else f"{best['reach_margin']:5.2f}"
        cone = "    -" if best["safe_cone_deg"] is None else f"{best['safe_cone_deg']:5.1f}"
        lines.append(
            f"{best['window']:6d}{best['rank']:6d} {best['theta_deg']:6.1f} {best['beta_deg']:6.1f} "
            f"{best['cost']:6.3f} "
            f"{best['min_clearance_mm']:10.2f} {best['path_length_mm']:5.0f} {best['skin_angle_deg']:6.1f}  {reach}"
            f"  {cone}  {best['window_square_deg']:14.0f} {best['window_entry_cm2']:13.1f}"
        )
    return lines


def _nothing_safe(run: Run) -> list[str]:
    row = closest_miss(run.candidates)
    if row is None:
        return ["no candidate is safe"]
    found = run.candidates.at(row)
    angles = f"theta {found['theta_deg']:g} deg, beta {found['beta_deg']:g} deg"
    return [f"no candidate is safe; closest came {angles}: {reason_text(run.candidates, row)}"]


def _footer(run: Run) -> list[str]:
    notes = (one.sentence for one in run.context.anatomy.findings if one.severity == "note")
    lines = [*(f"warning: {one}" for one in run.context.anatomy.warnings), *(f"note: {one}" for one in notes)]
    if run.certificate is not None:
        lines += certificate_lines(run.certificate.summary())
    if run.checked is not None:
        checked = run.checked
        lines.append(
            f"cross-check: FCL measured {checked.directions} directions again; {checked.pairs} distances agree,"
            f" largest difference {checked.largest_mm:.1e} mm"
        )
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in run.context.stages.seconds.items())
    return [*lines, f"seconds: {stages}", "look at:", *(f"  {path}" for path in run.files)]
