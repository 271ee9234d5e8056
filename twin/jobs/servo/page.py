"""``servo.html``: a servo session on one page that needs no network."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from markupsafe import Markup

from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.jobs.servo.facts import Facts, our_errors
from puncture_twin.twin.jobs.servo.page_needle import needle_section
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
