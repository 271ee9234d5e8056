"""``servo.html``: a servo session on one page that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.jobs.servo.facts import NO_TOUCH, Facts, our_errors
from puncture_twin.twin.jobs.servo.text import DOUBTED, NOT_MODELLED, PHASE_TEXT
from puncture_twin.twin.report.numbers import number, percent
from puncture_twin.twin.report.page.page_tables import faint, inputs_table, pairs, table, two
from puncture_twin.twin.report.page.template import Card, data_address, write_html

ROW_HEAD = ("target", "mapping", "expected", "before", "after", "servo-only", "corrections", "ended")


def write_servo_page(case: ServoCase, facts: Facts, pictures: Sequence[Path], convergence: Path, path: Path) -> None:
    """Write the page.

    Args:
        case: The case.
        facts: What was found: every seed, of which the first is shown in full, and the paper's tables if compared.
        pictures: One for each camera.
        convergence: The plot.
        path: The HTML to write; it appears whole or not at all.
    """
    first = facts["sessions"][0]
    write_html(
        "servo.html",
        path,
        title=f"{case.name}: visual servoing onto {len(first['targets'])} targets",
        setup=_setup(case),
        cards=_cards(facts),
        paper=_paper(facts) if "paper" in facts else "",
        seed=first["seed"],
        targets=table(ROW_HEAD, [_cells(row) for row in first["targets"]], kind="numbers"),
        convergence=data_address(convergence),
        cameras=[(picture.stem, data_address(picture)) for picture in pictures],
        statistics=_statistics(facts["statistics"]),
        needle=needle_section(facts["needle"], first),
        calibration=_calibration(case, first),
        inputs=inputs_table(case.inputs),
    )


def _setup(case: ServoCase) -> str:
    plan, robot, servo, arm = case.file.cameras, case.file.robot, case.file.servo, case.errors.stated()
    return (
        f"Two cameras of {plan.size_px[0]} x {plan.size_px[1]} px, {plan.baseline_mm:g} mm apart, "
        f"{plan.distance_mm:g} mm away, noise {plan.noise_grey:g} grey levels; centre by {plan.centre}; "
        f"{robot.model} off by {arm['link_mm']:g} mm, {arm['joint_deg']:g}°, play {arm['backlash_deg']:g}°, "
        f"repeatability {arm['repeatability_deg']:g}°; tolerance {servo.tolerance_mm:g} mm; "
        f"estimate: {'joint' if servo.estimate == 'joint' else 'the chain'}."
    )


def _cards(facts: Facts) -> list[Card]:
    ours, tolerance = facts["statistics"], facts["tolerance_mm"]
    ratio, most = f"{ours['after_over_mapping']:.3f}", f"{ours['servo_only_max']:.3f}"
    steps = f"{ours['median_steps']:g}"
    return [
        Card("before the servo", number(ours["before_mean"], 2, "mm"), "mean, true ball to true target"),
        Card("after the servo", number(ours["after_mean"], 2, "mm"), f"{ratio} times the mapping's"),
        Card("servo-only", number(ours["servo_only_mean"], 3, "mm"), f"mean; at most {most} mm"),
        Card("not confirmed", percent(ours["not_confirmed"]), f"within {tolerance:g} mm; median {steps} steps"),
    ]


def _cells(row: Mapping[str, Any]) -> tuple[str, ...]:
    return (
        row["target"],
        *(number(row[key], 2) for key in ("mapping_mm", "expected_tre_mm", "before_mm", "after_mm")),
        number(row["servo_only_mm"], 3),
        str(row["steps"]),
        row["stop"].replace("_", " "),
    )


def _statistics(ours: Mapping[str, Any]) -> Markup:
    refused = f"; {ours['refused']} could not be held" if ours["refused"] else ""

    def value(key: str, unit: str = "mm", digits: int = 3) -> str:
        return number(ours[key], digits, unit)

    return pairs(
        [
            ("sessions and targets", f"{ours['seeds']} seeds{refused}; {ours['targets']} targets"),
            ("stereo, mean and maximum", f"{value('stereo_mean', '')} and {value('stereo_max')}"),
            ("mapping, mean", value("mapping_mean")),
            (
                "mapping, rms, beside what it expects of itself",
                f"{value('mapping_rms', '')} and {value('expected_tre_rms')}",
            ),
            ("before, mean", value("before_mean")),
            ("after, mean", value("after_mean")),
            ("after over mapping (its floor is 1)", value("after_over_mapping", "")),
            ("servo-only, mean and maximum", f"{value('servo_only_mean', '')} and {value('servo_only_max')}"),
            ("corrections, median", value("median_steps", "", 1)),
            ("not confirmed", percent(ours["not_confirmed"])),
        ]
    )


def _calibration(case: ServoCase, first: Mapping[str, Any]) -> Markup:
    residuals = " and ".join(number(px, 3) for px in first["calibration_rms_px"])
    cal = case.file.calibration
    return pairs(
        [
            ("points held by the robot", f"12, over {' x '.join(f'{mm:g}' for mm in cal.size_mm)} mm"),
            ("measuring arm, per axis", number(case.errors.measuring_mm, 3, "mm")),
            ("residual of each camera (rms)", f"{residuals} px"),
            ("robot against C after the rigid fit (mean)", number(first["robot_residual_mm"], 2, "mm")),
            ("markers, residual (rms; not the accuracy at a target)", number(first["fre_mm"], 2, "mm")),
        ]
    )


def _paper(facts: Facts) -> Markup:
    """The paper's tables beside ours."""
    first, errors = facts["sessions"][0], our_errors(facts)
    lines = []
    for column in facts["paper"]:
        ours, note = errors[column["name"]], "" if column["holds"] else " (not what the rows give)"
        printed = "{printed_mean:.2f} / {printed_max:.2f}".format(**column) + note
        by_rows, own = "{mean:.3f} / {max:.2f}".format(**column), f"{ours.mean:.2f} / {ours.most:.2f}"
        lines.append((column["name"], printed, by_rows, own))
    alone = errors["servo_only"]
    lines.append(("servo-only", "not measured", "–", f"{alone.mean:.3f} / {alone.most:.2f}"))
    means = table(("mean / maximum, mm", "paper, printed", "paper, by its rows", "ours"), lines, kind="numbers")
    body = [
        (str(i), *(f"{mm:.2f}" for mm in theirs), f"≥ {least:.2f}", *_cells(row)[1:2], *_cells(row)[3:7])
        for i, (theirs, least, row) in enumerate(
            zip(facts["paper_table_2_mm"], facts["paper_servo_only_at_least_mm"], first["targets"], strict=False), 1
        )
    ]
    head = ("target", "mapping", "before", "after", "servo-only", "ours: mapping", "before", "after", "servo-only",
            "corrections")  # fmt: skip
    text = (
        "The paper's head, robot and targets are not ours: compare means, not rows. It did not measure what the servo "
        "alone leaves; by the triangle's inequality it is at least |after − mapping|. "
        f"Rows of the twin: seed {first['seed']}."
    )
    return Markup("<h2>Liu et al. 2007, and ours</h2>") + faint(text) + two(means, table(head, body, kind="numbers"))


TARGET_HEAD = (
    "target", "expected, mm", "95 % half axes, mm", "lateral, mm", "depth, mm", "direction, °", "chance to hit",
    "realised, mm",
)  # fmt: skip


def needle_section(needle: Mapping[str, Any], first: Mapping[str, Any]) -> Markup:
    """Both tables: over all seeds by each way, and the needles of the first seed after the servo.

    Args:
        needle: Of the facts, over all seeds.
        first: The session that is shown in full.
    """
    columns = [needle[phase] for phase in PHASE_TEXT]
    rows = [(label, *(_cell(one, keys) for one in columns)) for label, keys in _rows(needle["hit_radius_mm"])]
    all_seeds = table(("realised / predicted", *PHASE_TEXT.values()), rows, kind="numbers")
    each = table(TARGET_HEAD, [_needle(row) for row in first["targets"]], kind="numbers")
    return all_seeds + faint(" ".join(_reserves(needle))) + each


def _rows(radius_mm: float | None) -> list[tuple[str, tuple[str, str]]]:
    hit = [] if radius_mm is None else [(f"hit, within {radius_mm:g} mm", ("hit_share", "mean_p_hit"))]
    return [
        ("tip error, rms, mm", ("realised_rms_mm", "predicted_rms_mm")),
        ("direction, rms, °", ("realised_direction_deg", "predicted_direction_deg")),
        ("inside of the 95 % ellipsoid", ("coverage_95", "")),
        *hit,
    ]


def _cell(one: Mapping[str, Any] | None, keys: tuple[str, str]) -> str:
    if one is None:
        return "unknown"
    realised, predicted = one[keys[0]], one.get(keys[1], 0.95)
    if keys[0].endswith(("_mm", "_deg")):
        return f"{realised:.3f} / {predicted:.3f}"
    return f"{100 * realised:.1f} / {100 * predicted:.1f} %"


def _reserves(needle: Mapping[str, Any]) -> list[str]:
    """What a reader must know before believing the table."""
    said = ["The needles of one seed share its room: seeds count, not needles."]
    if needle["wrong_belief"]:
        said.append("The rooms were drawn from [rehearsal.errors]: the belief is wrong by design.")
    test = needle["declaration"]
    if test is not None and test["p"] < DOUBTED:
        said.append(f"What was measured lies farther apart than the declared errors make it (p = {test['p']:.1g}).")
    return [*said, f"Chance to touch: {NO_TOUCH}.", f"Not modelled: {NOT_MODELLED}."]


def _needle(row: Mapping[str, Any]) -> tuple[str, ...]:
    one = row["needle_servoed"]
    if one is None:
        return (row["target"], "unknown", *[""] * (len(TARGET_HEAD) - 2))
    numbers = [one[key] for key in ("lateral_mm", "depth_mm", "predicted_direction_deg")]
    return (
        row["target"],
        f"{one['predicted_rms_mm']:.2f}",
        " x ".join(f"{mm:.2f}" for mm in one["half_axes_mm"]),
        *(f"{value:.2f}" for value in numbers),
        "" if one["p_hit"] is None else chance_text(one["p_hit"]),
        f"{one['realised_mm']:.2f}",
    )
