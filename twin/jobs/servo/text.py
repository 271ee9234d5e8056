"""What a servo session says: for a person, and as plain values."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Any

import numpy as np

from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.stereo.experiment import ServoTrial, Statistics, TargetRow
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.jobs.servo.liu2007 import TABLE_1, TABLE_2, Liu2007Tables, paper_servo_only_at_least

HEAD = "target  mapping  expected  before   after  servo-only  steps  stop"


def servo_text(case: ServoCase, trials: Sequence[ServoTrial], ours: Statistics | None, files: Sequence[str]) -> str:
    """A case's sessions: the first in full, all together."""
    first = trials[0]
    lines = [f"case {case.name}, seed {first.seed}, errors in mm"]
    if first.refused:
        lines.append(f"  not held: {first.refused}")
    else:
        lines += _session_lines(first)
    if ours is not None and len(trials) > 1:
        lines += ["", *statistics_lines(ours)]
    return "\n".join([*lines, *(f"  {name}" for name in files)])


def _session_lines(first: ServoTrial) -> list[str]:
    stereo = np.array(first.stereo_mm)
    return [
        f"  calibration: residual {' and '.join(f'{px:.3f}' for px in first.rms_px)} px (rms), "
        f"robot to C {first.robot_residual_mm:.2f} mm (mean)",
        f"  stereo at {len(stereo)} points: mean {stereo.mean():.3f}, max {stereo.max():.3f}",
        f"  markers: residual {first.fre_mm:.2f} (rms; not the accuracy at a target)",
        HEAD,
        *(_row_line(row) for row in first.rows),
    ]


def _row_line(row: TargetRow) -> str:
    return (
        f"{row.target:6s} {row.mapping_mm:8.2f} {row.expected_tre_mm:9.2f} {row.before_mm:7.2f} {row.after_mm:7.2f} "
        f"{row.servo_only_mm:11.3f} {row.steps:6d}  {row.stop.replace('_', ' ')}"
    )


def statistics_lines(ours: Statistics) -> list[str]:
    """What many seeds say together."""
    refused = f", {ours.refused} sessions could not be held" if ours.refused else ""
    return [
        f"over {ours.seeds} seeds, {ours.targets} targets{refused}:",
        f"  stereo mean {ours.stereo_mean:.3f}, max {ours.stereo_max:.3f}",
        f"  mapping {ours.mapping_mean:.2f} (rms {ours.mapping_rms:.2f}, expected {ours.expected_tre_rms:.2f}), "
        f"before {ours.before_mean:.2f}, after {ours.after_mean:.2f}; after/mapping {ours.after_over_mapping:.3f}",
        f"  servo-only mean {ours.servo_only_mean:.3f}, max {ours.servo_only_max:.3f}; median of steps "
        f"{ours.median_steps:g}; not confirmed {100 * ours.not_confirmed:.1f} %",
    ]


def servo_summary(case: ServoCase, trials: Sequence[ServoTrial], ours: Statistics | None) -> dict[str, Any]:
    """The same as plain values."""
    stops = Counter(row.stop for one in trials for row in one.rows)
    return {
        "case": case.name,
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": case.file.servo.tolerance_mm,
        "estimate": case.file.servo.estimate,
        "stops": dict(stops),
        "statistics": None if ours is None else {**ours._asdict(), "after_over_mapping": ours.after_over_mapping},
        "sessions": [_trial_summary(one) for one in trials],
    }


def _trial_summary(one: ServoTrial) -> dict[str, Any]:
    held = not one.refused
    return {
        "seed": one.seed,
        "refused": one.refused or None,
        "stereo_mm": list(one.stereo_mm),
        "calibration_rms_px": list(one.rms_px),
        "fre_mm": one.fre_mm if held else None,
        "robot_residual_mm": one.robot_residual_mm if held else None,
        "targets": [row._asdict() for row in one.rows],
    }


def reproduction_text(result: Liu2007Tables, files: Sequence[str]) -> str:
    """The paper's tables beside ours."""
    first, ours = result.trials[0], result.ours
    lines = ["Table 1, stereo, mm (the paper's points are not ours: compare mean and maximum)"]
    lines.append("  paper " + " ".join(f"{error:.2f}" for error in TABLE_1))
    lines.append("  ours  " + " ".join(f"{error:.2f}" for error in first.stereo_mm) + f"   (seed {first.seed})")
    lines += ["", "Table 2, mm: mapping, before, after servo; then what the servo alone leaves"]
    lines.append("        paper                              ours")
    lines.append("        map.  bef.  aft.  servo-only  |  map.  bef.  aft.  servo-only  steps")
    for number, (paper, least, row) in enumerate(
        zip(TABLE_2, paper_servo_only_at_least(), first.rows, strict=False), start=1
    ):
        lines.append(
            f"  {number:4d}  {paper[0]:.2f}  {paper[1]:.2f}  {paper[2]:.2f}    >= {least:.2f}   |  "
            f"{row.mapping_mm:.2f}  {row.before_mm:.2f}  {row.after_mm:.2f}     {row.servo_only_mm:.3f} {row.steps:5d}"
        )
    lines += ["", f"            paper printed   by its rows   ours, {ours.seeds} seeds, {ours.targets} targets"]
    values = {
        "stereo": (ours.stereo_mean, ours.stereo_max),
        "mapping": (ours.mapping_mean, max(row.mapping_mm for one in result.trials for row in one.rows)),
        "before": (ours.before_mean, max(row.before_mm for one in result.trials for row in one.rows)),
        "after": (ours.after_mean, max(row.after_mm for one in result.trials for row in one.rows)),
    }
    for column in result.columns:
        mean, most = values[column.name]
        note = "" if column.holds else "  <- the printed number is not what the rows give"
        lines.append(
            f"  {column.name:8s}  {column.printed_mean:.2f} / {column.printed_max:.2f}     {column.mean:.3f} / "
            f"{column.max:.2f}   {mean:.2f} / {most:.2f}{note}"
        )
    lines += [
        f"  servo-only      not measured   {'':14s}{ours.servo_only_mean:.3f} / {ours.servo_only_max:.2f}",
        "",
        f"ours: median of steps {ours.median_steps:g}, not confirmed {100 * ours.not_confirmed:.1f} %, "
        f"after/mapping {ours.after_over_mapping:.3f} (paper: {1.00 / 1.06:.2f}, below 1 by chance)",
        "the servo takes the robot's error out: "
        + ("after < before, it holds" if result.holds else "after is NOT below before: DOES NOT HOLD"),
    ]
    return "\n".join([*lines, *(f"  {name}" for name in files)])


def reproduction_summary(result: Liu2007Tables) -> dict[str, Any]:
    """The same as plain values."""
    return {
        "holds": result.holds,
        "paper": [{**column._asdict(), "holds": column.holds} for column in result.columns],
        "paper_table_1_mm": list(TABLE_1),
        "paper_table_2_mm": [list(row) for row in TABLE_2],
        "paper_servo_only_at_least_mm": list(paper_servo_only_at_least()),
        **servo_summary(result.case, result.trials, result.ours),
    }
