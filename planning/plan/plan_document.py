"""A plan as a versioned file, which is checked again by whoever loads it."""

import json
from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import HIGHEST, SpeedLimits
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.provenance import inputs_document, read_inputs
from puncture_twin.planning.base.strict_json import (
    array,
    field,
    fitting,
    number,
    number_or_nan,
    or_null,
    parse_document,
    point,
    text,
    texts,
    whole,
)
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Peaks, Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import arm_document, check_geometry, rate_limits, read_arm
from puncture_twin.planning.uncertainty.guided import WayChance

PLAN_VERSION = 3
"""Version of the file's layout. `arm` is absent for an arm of the table: its name gives its numbers."""
PLAN_ALLOWED = f"a plan.json of version {PLAN_VERSION}; plan again"

NAMES = (
    *("version", "case", "inputs", "seed", "robot", "arm", "T_base_ct", "expected_target_error_mm", "theta_deg"),
    *("beta_deg", "entry_ct_mm", "target_ct_mm", "outward_ct", "roll_deg", "standoff_mm", "needle_length_mm", "limits"),
    *("speed_limits", "approach", "insertion", "clearance_mm", "warnings", "guidance"),
)
PHASE_NAMES = ("times_s", "q_rad", "peaks")
CLEARANCE_NAMES = ("approach", "insertion", "needle")
INPUT_NAMES = ("role", "path", "sha256")
"""The keys of a plan and of its parts."""
SAME_TIME_S = 1e-9
"""Rounding of the samples' times."""
SAME_PEAK = 1e-6
"""Fraction by which a stated peak may differ from the samples' own: rounding."""
MAX_PLAN_BYTES = 50_000_000
"""A plan is some thousand waypoints; a larger file is something else."""


def write_plan(plan: Plan, path: Path) -> None:
    """Write a plan as JSON, whole or not at all; lengths in mm, joints in rad, times in s."""
    document = {
        "version": PLAN_VERSION,
        "case": plan.case_name,
        "inputs": inputs_document(plan.inputs),
        "seed": plan.seed,
        "robot": plan.model.name,
        **({} if (arm := arm_document(plan.model)) is None else {"arm": arm}),
        "T_base_ct": plan.T_base_ct.tolist(),
        "expected_target_error_mm": or_null(plan.expected_target_error_mm),
        "theta_deg": float(np.degrees(plan.theta)),
        "beta_deg": float(np.degrees(plan.beta)),
        "entry_ct_mm": plan.entry_ct.tolist(),
        "target_ct_mm": plan.target_ct.tolist(),
        "outward_ct": plan.outward_ct.tolist(),
        "roll_deg": float(np.degrees(plan.roll)),
        "standoff_mm": plan.standoff_mm,
        "needle_length_mm": plan.needle_length_mm,
        "limits": _rates_document(rate_limits(plan.model)),
        "speed_limits": plan.speeds._asdict(),
        "approach": _trajectory_document(plan.approach),
        "insertion": _trajectory_document(plan.insertion),
        "clearance_mm": {phase: or_null(value) for phase, value in plan.clearance_mm.items()},
        "warnings": list(plan.warnings),
        **({"guidance": [one.document() for one in plan.guidance]} if plan.guidance else {}),
    }
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")


def read_plan(path: Path) -> Plan:
    """Read a plan, from a whole output set or from outside of any, and check it as `parse_plan` does.

    Raises:
        InputError: It cannot be read, its folder's manifest lists other bytes, or see `parse_plan`.
    """
    return parse_plan(read_output(path, max_bytes=MAX_PLAN_BYTES).data, path)


def parse_plan(data: bytes, path: Path) -> Plan:
    """Check that a plan's bytes are whole and agree with themselves.

    Raises:
        InputError: Not a plan, another version, missing keys, numbers that do not fit, or a pose that the stored
            joint angles do not reach.
    """
    document = parse_document(data, PLAN_VERSION, where=path, allowed=PLAN_ALLOWED)
    with fitting(path, PLAN_ALLOWED):
        plan = _plan(document, path)
    check_geometry(plan, path)
    _check_stated(document, plan, path)
    _check_names(document, path)
    return plan


def _check_stated(document: dict[str, Any], plan: Plan, path: Path) -> None:
    stated: tuple[tuple[str, Any, dict[str, list[float]]], ...] = (
        ("limits", document.get("limits"), _rates_document(rate_limits(plan.model))),
        ("peaks of the approach", document["approach"].get("peaks"), _rates_document(plan.approach.peaks())),
        ("peaks of the insertion", document["insertion"].get("peaks"), _rates_document(plan.insertion.peaks())),
    )
    for name, said, known in stated:
        if not _same_rates(said, known):
            refuse(f"the {name} do not match its numbers", path, "plan again", "plan_contradicted")
    for phase, part in (("approach", plan.approach), ("insertion", plan.insertion)):
        even = SAMPLE_S * np.arange(len(part.times_s))
        if not np.allclose(part.times_s, even, rtol=0, atol=SAME_TIME_S):
            refuse(f"the times of the {phase} are not even", path, f"one row every {SAMPLE_S} s", "times_uneven")


def _same_rates(stated: Any, known: dict[str, list[float]]) -> bool:
    try:
        return set(stated) == set(known) and all(
            np.allclose(array(stated[rate], (6,)), known[rate], rtol=SAME_PEAK, atol=SAME_PEAK) for rate in known
        )
    except (TypeError, ValueError):
        return False


def _check_names(document: dict[str, Any], path: Path) -> None:
    """Refuse keys that no plan has: nothing checks what they state."""
    for where, part, known in (
        ("", document, NAMES),
        ("approach.", document["approach"], PHASE_NAMES),
        ("insertion.", document["insertion"], PHASE_NAMES),
        ("clearance_mm.", document["clearance_mm"], CLEARANCE_NAMES),
        *((f"guidance.{at}.", one, WayChance._fields) for at, one in enumerate(document.get("guidance", []))),
        *((f"inputs.{at}.", one, INPUT_NAMES) for at, one in enumerate(document["inputs"])),
    ):
        # a phase whose clearance is not stated is for whoever has the case to miss
        optional = set(known) if part is document["clearance_mm"] else {"arm", "guidance"}
        for name in sorted(set(part) ^ set(known) - (optional - set(part))):
            what = "is not known" if name in part else "is missing"
            refuse(f"key '{where}{name}' {what}", path, ", ".join(known), "unknown_key")


def _rates_document(rates: Peaks) -> dict[str, list[float]]:
    units = ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return {unit: rate.tolist() for unit, rate in zip(units, rates, strict=True)}


def _plan(document: dict[str, Any], path: Path) -> Plan:
    return Plan(
        case_name=field(document, "case", text),
        inputs=field(document, "inputs", read_inputs),
        seed=field(document, "seed", whole),
        model=read_arm(field(document, "robot", text), document.get("arm")),
        T_base_ct=guard_transform(document["T_base_ct"], where=f"{path}: T_base_ct"),
        expected_target_error_mm=field(document, "expected_target_error_mm", number_or_nan),
        theta=float(np.radians(field(document, "theta_deg", number))),
        beta=float(np.radians(field(document, "beta_deg", number))),
        entry_ct=field(document, "entry_ct_mm", point),
        target_ct=field(document, "target_ct_mm", point),
        outward_ct=field(document, "outward_ct", point),
        roll=float(np.radians(field(document, "roll_deg", number))),
        standoff_mm=field(document, "standoff_mm", number),
        needle_length_mm=field(document, "needle_length_mm", number),
        approach=field(document, "approach", _trajectory),
        insertion=field(document, "insertion", _trajectory),
        clearance_mm=field(document, "clearance_mm", _clearances),
        speeds=field(document, "speed_limits", _speed_limits),
        warnings=field(document, "warnings", texts),
        guidance=tuple(_way_chance(one) for one in document.get("guidance", [])),
    )


def _way_chance(value: Any) -> WayChance:
    error, hit, stop = (field(value, name, number_or_nan) for name in ("expected_error_mm", "p_hit", "p_stop"))
    return WayChance(field(value, "way", text), error, hit, stop, field(value, "lost_sight", text))


def _clearances(value: Any) -> Mapping[str, float]:
    return MappingProxyType({phase: number_or_nan(one) for phase, one in value.items()})


def _speed_limits(value: Any) -> SpeedLimits:
    if set(value) != set(SpeedLimits._fields):
        raise ValueError(f"speed_limits are {', '.join(SpeedLimits._fields)}")
    speeds = SpeedLimits(*(number(value[name]) for name in SpeedLimits._fields))
    if not all(0.0 < speed <= most for speed, most in zip(speeds, HIGHEST, strict=True)):
        raise ValueError(f"speed_limits are above 0 and at most {', '.join(f'{most:g}' for most in HIGHEST)}")
    return speeds


def _trajectory(document: Any) -> Trajectory:
    count = len(document["times_s"])
    return Trajectory(array(document["times_s"], (count,)), array(document["q_rad"], (count, 6)))


def _trajectory_document(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "times_s": trajectory.times_s.tolist(),
        "q_rad": trajectory.q.tolist(),
        "peaks": _rates_document(trajectory.peaks()),
    }
