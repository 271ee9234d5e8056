"""What a servo command found, as one table of plain values: ``--json``, the text and the page read nothing else."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

from puncture_twin.planning.base.provenance import inputs_document
from puncture_twin.twin.guidance.stereo.experiment import (
    ServoTrial,
    Statistics,
    TargetRow,
    declaration_test,
    needle_statistics,
)
from puncture_twin.twin.guidance.stereo.joint.needle_error import NeedleOutcome
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.jobs.servo.liu2007 import (
    TABLE_1,
    TABLE_2,
    Liu2007Tables,
    paper_columns,
    paper_gain_mm,
    paper_servo_only_at_least,
)

PHASES = ("open_loop", "servoed")
"""By mapping and robot alone, and after the servo."""

NO_TOUCH = "not computed: the case has no structures"
"""Of ``p_touch``: which is something else than 0."""

Facts = Mapping[str, Any]
"""What `servo_facts` or `reproduction_facts` returns: mm, shares 0..1."""


def servo_facts(case: ServoCase, trials: Sequence[ServoTrial], ours: Statistics) -> dict[str, Any]:
    """A case's sessions, each seed and all together."""
    stops = Counter(row.stop for one in trials for row in one.rows)
    return {
        "case": case.name,
        "inputs": inputs_document(case.inputs),
        "tolerance_mm": case.file.servo.tolerance_mm,
        "estimate": case.file.servo.estimate,
        "stops": dict(stops),
        "statistics": {**ours._asdict(), "after_over_mapping": ours.after_over_mapping},
        "sessions": [_session(one) for one in trials],
        "needle": _needle(case, trials),
    }


def _needle(case: ServoCase, trials: Sequence[ServoTrial]) -> dict[str, Any]:
    """The needle against the anatomy, predicted beside realised, over all seeds."""
    test = declaration_test(trials)
    return {
        **{
            phase: _needles([getattr(row, f"needle_{phase}") for one in trials for row in one.rows]) for phase in PHASES
        },
        "hit_radius_mm": case.file.target.hit_radius_mm,
        "p_touch": None,
        "p_touch_note": NO_TOUCH,
        "wrong_belief": case.wrong_belief,
        "declared": case.errors.stated(),
        "declaration": None if test is None else {**test._asdict(), "p": test.p},
    }


def _needles(outcomes: Sequence[NeedleOutcome | None]) -> dict[str, Any] | None:
    found = needle_statistics(outcomes)
    return None if found is None else found._asdict()


def reproduction_facts(result: Liu2007Tables) -> dict[str, Any]:
    """The paper's tables, and our sessions in a room like the paper's."""
    tilted = result.tilted
    calibration = tilted.case.file.calibration.tilt_deg
    return {
        "holds": result.passed,
        "conditions": [{"words": one.text, "holds": one.passed} for one in result.conditions],
        "paper_gain_mm": paper_gain_mm(),
        "gain": tilted.gain._asdict(),
        "gain_with_the_rod_tilted_alike": result.straight.gain._asdict(),
        "tilted_more_deg": 0.0 if calibration is None else calibration - tilted.case.file.tool.tilt_deg,
        **paper_facts(),
        **servo_facts(tilted.case, tilted.trials, tilted.ours),
    }


def paper_facts() -> dict[str, Any]:
    """The paper's tables, as printed and by their rows."""
    return {
        "paper": [{**column._asdict(), "holds": column.passed} for column in paper_columns()],
        "paper_table_1_mm": list(TABLE_1),
        "paper_table_2_mm": [list(row) for row in TABLE_2],
        "paper_servo_only_at_least_mm": list(paper_servo_only_at_least()),
    }


def _session(one: ServoTrial) -> dict[str, Any]:
    finished = not one.refused
    return {
        "seed": one.seed,
        "refused": one.refused or None,
        "stereo_mm": list(one.stereo_mm),
        "calibration_rms_px": list(one.rms_px),
        "fre_mm": one.fre_mm if finished else None,
        "robot_residual_mm": one.robot_residual_mm if finished else None,
        "targets": [_target(row) for row in one.rows],
    }


def _target(row: TargetRow) -> dict[str, Any]:
    needles = {f"needle_{phase}": getattr(row, f"needle_{phase}") for phase in PHASES}
    return {**row._asdict(), **{key: None if one is None else _outcome(one) for key, one in needles.items()}}


def _outcome(one: NeedleOutcome) -> dict[str, Any]:
    return {**one._asdict(), "half_axes_mm": list(one.half_axes_mm), "in_region": one.in_region}


class MeanAndMost(NamedTuple):
    """Of an error, mm."""

    mean: float
    most: float


def our_errors(facts: Facts) -> dict[str, MeanAndMost]:
    """Mean and maximum over all targets of all seeds, by the names of the paper's columns and ``servo_only``."""
    ours, rows = facts["statistics"], [row for one in facts["sessions"] for row in one["targets"]]
    errors = {"stereo": MeanAndMost(ours["stereo_mean"], ours["stereo_max"])}
    for name in ("mapping", "before", "after", "servo_only"):
        errors[name] = MeanAndMost(ours[f"{name}_mean"], max(row[f"{name}_mm"] for row in rows))
    return errors
