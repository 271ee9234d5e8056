"""What a servo command prints for a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from puncture_twin.twin.jobs.servo.facts import Facts, our_errors

HEAD = "target  mapping  expected  before   after  servo-only  steps  stop"


def servo_text(facts: Facts) -> str:
    """A case's sessions: the first in full, all together."""
    first = facts["sessions"][0]
    lines = [f"case {facts['case']}, seed {first['seed']}, errors in mm"]
    if first["refused"]:
        lines.append(f"  not held: {first['refused']}")
    else:
        lines += _session_lines(first)
    if len(facts["sessions"]) > 1:
        lines += ["", *statistics_lines(facts["statistics"])]
    return "\n".join([*lines, *(f"  {name}" for name in facts["files"])])


def _session_lines(first: Mapping[str, Any]) -> list[str]:
    stereo = np.array(first["stereo_mm"])
    return [
        f"  calibration: residual {' and '.join(f'{px:.3f}' for px in first['calibration_rms_px'])} px (rms), "
        f"robot to C {first['robot_residual_mm']:.2f} mm (mean)",
        f"  stereo at {len(stereo)} points: mean {stereo.mean():.3f}, max {stereo.max():.3f}",
        f"  markers: residual {first['fre_mm']:.2f} (rms; not the accuracy at a target)",
        HEAD,
        *(_row_line(row) for row in first["targets"]),
    ]


def _row_line(row: Mapping[str, Any]) -> str:
    return (
        "{target:6s} {mapping_mm:8.2f} {expected_tre_mm:9.2f} {before_mm:7.2f} {after_mm:7.2f} "
        "{servo_only_mm:11.3f} {steps:6d}  ".format(**row)
        + row["stop"].replace("_", " ")
    )


def statistics_lines(ours: Mapping[str, Any]) -> list[str]:
    """What many seeds say together."""
    refused = f", {ours['refused']} sessions could not be held" if ours["refused"] else ""
    return [
        f"over {ours['seeds']} seeds, {ours['targets']} targets{refused}:",
        "  stereo mean {stereo_mean:.3f}, max {stereo_max:.3f}".format(**ours),
        "  mapping {mapping_mean:.2f} (rms {mapping_rms:.2f}, expected {expected_tre_rms:.2f}), "
        "before {before_mean:.2f}, after {after_mean:.2f}; after/mapping {after_over_mapping:.3f}".format(**ours),
        "  servo-only mean {servo_only_mean:.3f}, max {servo_only_max:.3f}; median of steps {median_steps:g}; "
        "not confirmed {percent:.1f} %".format(**ours, percent=100 * ours["not_confirmed"]),
    ]


def reproduction_text(facts: Facts) -> str:
    """The paper's tables beside ours."""
    ours, errors = facts["statistics"], our_errors(facts)
    return "\n".join([
        *_table_1(facts),
        "",
        *_table_2(facts),
        "",
        f"            paper printed   by its rows   ours, {ours['seeds']} seeds, {ours['targets']} targets",
        *(_column_line(column, *errors[column["name"]]) for column in facts["paper"]),
        f"  servo-only      not measured   {'':14s}{ours['servo_only_mean']:.3f} / {ours['servo_only_max']:.2f}",
        "",
        f"ours: median of steps {ours['median_steps']:g}, not confirmed {100 * ours['not_confirmed']:.1f} %, "
        f"after/mapping {ours['after_over_mapping']:.3f} (paper: {1.00 / 1.06:.2f}, below 1 by chance)",
        *_gain_lines(facts),
        "demanded here (the exit code):",
        *(f"  {one['words']}: {'holds' if one['holds'] else 'DOES NOT HOLD'}" for one in facts["conditions"]),
        *(f"  {name}" for name in facts["files"]),
    ])  # fmt: skip


def _gain_lines(facts: Facts) -> list[str]:
    """What the servo is worth, and on what that rests."""
    gains = [facts["gain"], facts["gain_with_the_rod_tilted_alike"]]
    told = [f"{one['mean']:.2f} (standard error {one['error']:.2f})" for one in gains]
    return [
        f"gain, before - after: {told[0]} mm with the rod tilted {facts['tilted_more_deg']:.0f} deg more during the "
        f"calibration than at the targets; {told[1]} mm tilted alike; paper {facts['paper_gain_mm']:.2f} mm",
        "  the tilt is ours: the paper states none, and what gave its robot the error is not known",
    ]


def _table_1(facts: Facts) -> list[str]:
    first = facts["sessions"][0]
    return [
        "Table 1, stereo, mm (the paper's points are not ours: compare mean and maximum)",
        "  paper " + " ".join(f"{error:.2f}" for error in facts["paper_table_1_mm"]),
        "  ours  " + " ".join(f"{error:.2f}" for error in first["stereo_mm"]) + f"   (seed {first['seed']})",
    ]


def _table_2(facts: Facts) -> list[str]:
    columns = (facts["paper_table_2_mm"], facts["paper_servo_only_at_least_mm"], facts["sessions"][0]["targets"])
    return [
        "Table 2, mm: mapping, before, after servo; then what the servo alone leaves",
        "        paper                              ours",
        "        map.  bef.  aft.  servo-only  |  map.  bef.  aft.  servo-only  steps",
        *(
            f"  {number:4d}  {paper[0]:.2f}  {paper[1]:.2f}  {paper[2]:.2f}    >= {least:.2f}   |  "
            "{mapping_mm:.2f}  {before_mm:.2f}  {after_mm:.2f}     {servo_only_mm:.3f} {steps:5d}".format(**row)
            for number, (paper, least, row) in enumerate(zip(*columns, strict=False), start=1)
        ),
    ]


def _column_line(column: Mapping[str, Any], mean: float, most: float) -> str:
    note = "" if column["holds"] else "  <- the printed number is not what the rows give"
    return (
        "  {name:8s}  {printed_mean:.2f} / {printed_max:.2f}     {mean:.3f} / {max:.2f}   ".format(**column)
        + f"{mean:.2f} / {most:.2f}{note}"
    )
