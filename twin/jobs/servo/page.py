"""``servo.html``: a servo session on one page that needs no network."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from markupsafe import Markup

from puncture_twin.twin.guidance.stereo.experiment import ServoTrial, Statistics, TargetRow
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.jobs.servo.liu2007 import TABLE_2, PaperMean, paper_servo_only_at_least
from puncture_twin.twin.report.numbers import number, percent
from puncture_twin.twin.report.page.page_tables import faint, inputs_table, pairs, table, two
from puncture_twin.twin.report.page.template import Card, data_address, write_html

ROW_HEAD = ("target", "mapping", "expected", "before", "after", "servo-only", "corrections", "ended")


def write_servo_page(
    case: ServoCase,
    trials: Sequence[ServoTrial],
    ours: Statistics,
    pictures: Sequence[Path],
    convergence: Path,
    path: Path,
    paper: Sequence[PaperMean] = (),
) -> None:
    """Write the page.

    Args:
        case: The case.
        trials: Every seed; the first is shown in full.
        ours: Over all of them.
        pictures: One for each camera.
        convergence: The plot.
        path: The HTML to write; it appears whole or not at all.
        paper: The paper's columns, where it is compared.
    """
    first = trials[0]
    write_html(
        "servo.html",
        path,
        title=f"{case.name}: visual servoing onto {len(first.rows)} targets",
        setup=_setup(case),
        cards=_cards(case, ours),
        paper=_paper(paper, ours, trials) if paper else "",
        seed=first.seed,
        targets=table(ROW_HEAD, [_cells(row) for row in first.rows], kind="numbers"),
        convergence=data_address(convergence),
        cameras=[(picture.stem, data_address(picture)) for picture in pictures],
        statistics=_statistics(ours),
        calibration=_calibration(case, first),
        inputs=inputs_table(case.inputs),
    )


def _setup(case: ServoCase) -> str:
    plan, robot, servo = case.file.cameras, case.file.robot, case.file.servo
    return (
        f"Two cameras of {plan.size_px[0]} x {plan.size_px[1]} px, {plan.baseline_mm:g} mm apart, "
        f"{plan.distance_mm:g} mm away, noise {plan.noise_grey:g} grey levels; centre by {plan.centre}; "
        f"{robot.model} off by {robot.link_mm:g} mm, {robot.joint_deg:g}°, play {robot.backlash_deg:g}°, "
        f"repeatability {robot.repeatability_deg:g}°; tolerance {servo.tolerance_mm:g} mm; "
        f"estimate: {'joint' if servo.estimate == 'joint' else 'the chain'}."
    )


def _cards(case: ServoCase, ours: Statistics) -> list[Card]:
    tolerance, steps = case.file.servo.tolerance_mm, f"{ours.median_steps:g}"
    return [
        Card("before the servo", number(ours.before_mean, 2, "mm"), "mean, true ball to true target"),
        Card("after the servo", number(ours.after_mean, 2, "mm"), f"{ours.after_over_mapping:.3f} times the mapping's"),
        Card("servo-only", number(ours.servo_only_mean, 3, "mm"), f"mean; at most {ours.servo_only_max:.3f} mm"),
        Card("not confirmed", percent(ours.not_confirmed), f"within {tolerance:g} mm; median {steps} steps"),
    ]


def _cells(row: TargetRow) -> tuple[str, ...]:
    lengths = (row.mapping_mm, row.expected_tre_mm, row.before_mm, row.after_mm)
    return (
        row.target,
        *(number(mm, 2) for mm in lengths),
        number(row.servo_only_mm, 3),
        str(row.steps),
        row.stop.replace("_", " "),
    )


def _statistics(ours: Statistics) -> Markup:
    refused = f"; {ours.refused} could not be held" if ours.refused else ""
    return pairs(
        [
            ("sessions and targets", f"{ours.seeds} seeds{refused}; {ours.targets} targets"),
            ("stereo, mean and maximum", f"{number(ours.stereo_mean, 3)} and {number(ours.stereo_max, 3, 'mm')}"),
            ("mapping, mean", number(ours.mapping_mean, 3, "mm")),
            (
                "mapping, rms, beside what it expects of itself",
                f"{number(ours.mapping_rms, 3)} and {number(ours.expected_tre_rms, 3, 'mm')}",
            ),
            ("before, mean", number(ours.before_mean, 3, "mm")),
            ("after, mean", number(ours.after_mean, 3, "mm")),
            ("after over mapping (its floor is 1)", number(ours.after_over_mapping, 3)),
            (
                "servo-only, mean and maximum",
                f"{number(ours.servo_only_mean, 3)} and {number(ours.servo_only_max, 3, 'mm')}",
            ),
            ("corrections, median", number(ours.median_steps, 1)),
            ("not confirmed", percent(ours.not_confirmed)),
        ]
    )


def _calibration(case: ServoCase, first: ServoTrial) -> Markup:
    residuals = " and ".join(number(px, 3) for px in first.rms_px)
    cal = case.file.calibration
    return pairs(
        [
            ("points held by the robot", f"12, over {' x '.join(f'{mm:g}' for mm in cal.size_mm)} mm"),
            ("measuring arm, per axis", number(cal.measuring_arm_mm, 3, "mm")),
            ("residual of each camera (rms)", f"{residuals} px"),
            ("robot against C after the rigid fit (mean)", number(first.robot_residual_mm, 2, "mm")),
            ("markers, residual (rms; not the accuracy at a target)", number(first.fre_mm, 2, "mm")),
        ]
    )


def _paper(paper: Sequence[PaperMean], ours: Statistics, trials: Sequence[ServoTrial]) -> Markup:
    """The paper's tables beside ours."""
    rows = [row for one in trials for row in one.rows]
    most = {
        name: max(getattr(row, f"{name}_mm") for row in rows) for name in ("mapping", "before", "after", "servo_only")
    }
    mean = {"mapping": ours.mapping_mean, "before": ours.before_mean, "after": ours.after_mean}
    lines = []
    for column in paper:
        our_mean, our_most = mean.get(column.name, ours.stereo_mean), most.get(column.name, ours.stereo_max)
        note = "" if column.holds else " (not what the rows give)"
        printed = f"{column.printed_mean:.2f} / {column.printed_max:.2f}{note}"
        by_rows, own = f"{column.mean:.3f} / {column.max:.2f}", f"{our_mean:.2f} / {our_most:.2f}"
        lines.append((column.name, printed, by_rows, own))
    lines.append(("servo-only", "not measured", "–", f"{ours.servo_only_mean:.3f} / {most['servo_only']:.2f}"))
    means = table(("mean / maximum, mm", "paper, printed", "paper, by its rows", "ours"), lines, kind="numbers")
    body = [
        (str(i), *(f"{mm:.2f}" for mm in theirs), f"≥ {least:.2f}", *_cells(row)[1:2], *_cells(row)[3:7])
        for i, (theirs, least, row) in enumerate(
            zip(TABLE_2, paper_servo_only_at_least(), trials[0].rows, strict=False), start=1
        )
    ]
    head = ("target", "mapping", "before", "after", "servo-only", "ours: mapping", "before", "after", "servo-only",
            "corrections")  # fmt: skip
    words = (
        "The paper's head, robot and targets are not ours: compare means, not rows. It did not measure what the servo "
        "alone leaves; by the triangle's inequality it is at least |after − mapping|. "
        f"Rows of the twin: seed {trials[0].seed}."
    )
    return Markup("<h2>Liu et al. 2007, and ours</h2>") + faint(words) + two(means, table(head, body, kind="numbers"))
