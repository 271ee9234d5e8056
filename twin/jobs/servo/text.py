"""What a servo command prints for a person."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.jobs.servo.facts import NO_TOUCH, Facts, our_errors

NEEDLE_HEAD = "needle expected  95 % half axes      lateral  depth  direction  realised   (mm, deg; after the servo)"

PHASE_TEXT = {"open_loop": "by mapping and robot alone", "servoed": "after the servo"}

NOT_MODELLED = "a rod that bends, cameras that move after the calibration, tissue"

DOUBTED = 0.01
"""Chance of residuals so large below which the declaration is doubted, as in the CT case."""

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
    lines += ["", *needle_lines(facts["needle"])]
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
        NEEDLE_HEAD,
        *(_needle_row(row) for row in first["targets"]),
    ]


def _row_line(row: Mapping[str, Any]) -> str:
    return (
        "{target:6s} {mapping_mm:8.2f} {expected_tre_mm:9.2f} {before_mm:7.2f} {after_mm:7.2f} "
        "{servo_only_mm:11.3f} {steps:6d}  ".format(**row)
        + row["stop"].replace("_", " ")
    )


def _needle_row(row: Mapping[str, Any]) -> str:
    """The needle of one target at the servo's last look."""
    one = row["needle_servoed"]
    if one is None:
        return f"{row['target']:6s} unknown: nothing was seen at the end, or the measurements contradict each other"
    axes = " x ".join(f"{mm:.2f}" for mm in one["half_axes_mm"])
    chance = "" if one["p_hit"] is None else f"{chance_text(one['p_hit'])} to hit"
    return (
        f"{row['target']:6s} "
        + "{predicted_rms_mm:9.2f}  {axes:18s} {lateral_mm:8.2f} {depth_mm:6.2f} {predicted_direction_deg:10.2f}"
        "  {realised_mm:8.2f}  {chance}".format(**one, axes=axes, chance=chance)
    )


def needle_lines(needle: Mapping[str, Any]) -> list[str]:
    """Tip and direction against the anatomy, before and after the servo: realised beside predicted."""
    wrong = ", drawn from [rehearsal.errors]: the belief is wrong by design" if needle["wrong_belief"] else ""
    lines = [f"needle against the anatomy{wrong}:   realised   predicted"]
    for phase, text in PHASE_TEXT.items():
        lines += _phase_lines(text, needle[phase], needle["hit_radius_mm"])
    lines.append("  the needles of one seed share its room: seeds count, not needles")
    lines += [*_declaration_lines(needle["declaration"]), f"  chance to touch: {NO_TOUCH}"]
    return [*lines, f"  not modelled: {NOT_MODELLED}"]


def _phase_lines(text: str, one: Mapping[str, Any] | None, radius_mm: float | None) -> list[str]:
    if one is None:
        return [f"  {text}: unknown"]
    hit = f"    hit, within {radius_mm:g} mm" if radius_mm is not None else ""
    return [
        f"  {text}, {one['needles']} needles",
        "    tip error, rms         {realised_rms_mm:12.3f} {predicted_rms_mm:11.3f} mm".format(**one),
        "    direction, rms         {realised_direction_deg:12.3f} {predicted_direction_deg:11.3f} deg".format(**one),
        f"    in the 95 % ellipsoid  {100 * one['coverage_95']:12.1f} {95.0:11.1f} %",
        *([f"{hit:27s}{100 * one['hit_share']:12.1f} {100 * one['mean_p_hit']:11.1f} %"] if hit else []),
    ]


def _declaration_lines(test: Mapping[str, Any] | None) -> list[str]:
    """Whether what was measured is as far apart as declared."""
    if test is None:
        return ["  declared errors: not tested, the joint estimate does not settle"]
    line = "  declared errors: residuals {chi_squared:.0f} for {freedom} degrees of freedom, p = {p:.3f}".format(**test)
    return [line + ("; WARNING: they are larger than declared" if test["p"] < DOUBTED else "")]


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
        *needle_lines(facts["needle"]),
        "demanded here (the exit code):",
        *(f"  {one['words']}: {'holds' if one['holds'] else 'DOES NOT HOLD'}" for one in facts["conditions"]),
        *(f"  {name}" for name in facts["files"]),
    ])  # fmt: skip


def _gain_lines(facts: Facts) -> list[str]:
    """What the servo is worth, and on what that rests."""
    gains = [facts["gain"], facts["gain_with_the_rod_tilted_alike"]]
    line = [f"{one['mean']:.2f} (standard error {one['error']:.2f})" for one in gains]
    return [
        f"gain, before - after: {line[0]} mm with the rod tilted {facts['tilted_more_deg']:.0f} deg more during the "
        f"calibration than at the targets; {line[1]} mm tilted alike; paper {facts['paper_gain_mm']:.2f} mm",
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
