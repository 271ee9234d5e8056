"""The chosen pose and its motion, as a versioned file that is checked again by whoever loads it."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, TypeVar

import numpy as np

from puncture_twin.planning.arm.insertion import flange_at, needle_lines
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import atomic
from puncture_twin.planning.base.output.manifest import read_output
from puncture_twin.planning.base.provenance import Input, differing_input, inputs_document, read_inputs
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import needle_pose
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.motion.follow import MAX_JERK
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Peaks, Trajectory
from puncture_twin.planning.plan.html import plan_html

Value = TypeVar("Value")

PLAN_VERSION = 3
"""Version of the file's layout. 2: states the peaks of both phases beside the limits; the approach is smooth. 3: lists
its inputs with their roles, files that a file names included."""

PLAN_ALLOWED = f"a plan.json of version {PLAN_VERSION}; plan again"

POSE_TOLERANCE_MM = 0.01
"""How far the tip of the stored joint angles may be from the stored pose: well above rounding, far below any error."""

JOIN_TOLERANCE_RAD = 1e-9
"""How far the insertion may start from where the approach ends: rounding of the time laws."""

STRAIGHT_TOLERANCE_MM = 0.1
"""How far the tip may leave the straight path during the insertion: what a UR3 repeats."""

BETWEEN_RAD = 0.002
"""Joint step at which an insertion is looked at between its rows: up to 1.3 mm at the tip, bent by far less."""

MAX_NUMBER = 1e6
"""Of millimetres, degrees, radians and seconds: products of larger ones overflow."""

MOST_STATES = 100_000
"""Joints that turn through more steps than this (200 rad) during one insertion do something else."""

ROLL_TOLERANCE_RAD = 1e-4
"""How far the stated roll may be from that of the joint angles: what the pose's tolerance lets the flange turn."""

ANGLE_ROUNDING = 1e-12
"""Share of a turn by which degrees and radians round."""

SAME_TIME_S = 1e-9
"""Rounding of the samples' times."""

AGREE = "T_base_ct, target_ct_mm, outward_ct, needle_length_mm, standoff_mm and joint angles must agree"

NAMES = (
    *("version", "case", "inputs", "seed", "robot", "T_base_ct", "expected_target_error_mm", "theta_deg", "beta_deg"),
    *("entry_ct_mm", "target_ct_mm", "outward_ct", "roll_deg", "standoff_mm", "needle_length_mm", "limits"),
    *("approach", "insertion", "clearance_mm"),
)
PHASE_NAMES = ("times_s", "q_rad", "peaks")
CLEARANCE_NAMES = ("approach", "insertion", "needle")
INPUT_NAMES = ("role", "path", "sha256")
"""The keys of a plan and of its parts."""

SAME_PEAK = 1e-6
"""Share by which a stated peak may differ from the samples' own: rounding."""

INSERTION_MM_S = 10.0
"""Tip speed of the insertion: a needle is driven slowly, and an operator must be able to stop it."""

SPEED_ROUNDING = 1e-3
"""A time law that just keeps a speed may exceed it by its sampling."""

MAX_PLAN_BYTES = 50_000_000
"""A plan is some thousand waypoints; a larger file is something else."""


@dataclass(frozen=True, eq=False)
class Plan:
    """One puncture, ready to be rehearsed: mm, rad, s.

    Attributes:
        case_name: The case that it was made for.
        inputs: Every file of that case, with role and hash.
        seed: Of the approach's planner.
        model: The arm.
        T_base_ct: Shape (4, 4), the belief of where the patient is.
        expected_target_error_mm: rms, from the registration; NaN for a stated mount.
        theta: Puncture angle.
        beta: Azimuth.
        entry_ct: Shape (3,), skin entry.
        target_ct: Shape (3,).
        outward_ct: Shape (3,), unit, from the target along the needle.
        roll: About the needle.
        standoff_mm: Tip to target before the insertion.
        needle_length_mm: Tip to flange.
        approach: From home to standoff.
        insertion: From standoff to the target.
        clearance_mm: Per phase, the least distance that was found: ``approach`` and ``insertion`` of arm and holder
            to patient and room, ``needle`` to the nearest structure with a margin.
    """

    case_name: str
    inputs: tuple[Input, ...]
    seed: int
    model: str
    T_base_ct: Floats
    expected_target_error_mm: float
    theta: float
    beta: float
    entry_ct: Floats
    target_ct: Floats
    outward_ct: Floats
    roll: float
    standoff_mm: float
    needle_length_mm: float
    approach: Trajectory
    insertion: Trajectory
    clearance_mm: Mapping[str, float]

    def _repr_html_(self) -> str:
        """What a notebook shows."""
        return plan_html(self)


def write_plan(plan: Plan, path: Path) -> None:
    """Write a plan as JSON, whole or not at all; lengths in mm, joints in rad, times in s."""
    document = {
        "version": PLAN_VERSION,
        "case": plan.case_name,
        "inputs": inputs_document(plan.inputs),
        "seed": plan.seed,
        "robot": plan.model,
        "T_base_ct": plan.T_base_ct.tolist(),
        "expected_target_error_mm": _or_null(plan.expected_target_error_mm),
        "theta_deg": float(np.degrees(plan.theta)),
        "beta_deg": float(np.degrees(plan.beta)),
        "entry_ct_mm": plan.entry_ct.tolist(),
        "target_ct_mm": plan.target_ct.tolist(),
        "outward_ct": plan.outward_ct.tolist(),
        "roll_deg": float(np.degrees(plan.roll)),
        "standoff_mm": plan.standoff_mm,
        "needle_length_mm": plan.needle_length_mm,
        "limits": _rates_document(_limits(plan.model)),
        "approach": _trajectory_document(plan.approach),
        "insertion": _trajectory_document(plan.insertion),
        "clearance_mm": {phase: _or_null(value) for phase, value in plan.clearance_mm.items()},
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

    Args:
        data: The file's bytes.
        path: The file, for errors.

    Raises:
        InputError: Not a plan, another version, missing keys, numbers that do not fit, or a pose that the stored
            joint angles do not reach.
    """
    document = _document(data, path)
    try:
        plan = _plan(document, path)
    except (KeyError, TypeError, ValueError, IndexError, AttributeError, OverflowError) as error:
        what = f"key {error} is missing" if isinstance(error, KeyError) else f"does not fit: {error}"
        raise InputError(what, where=path, allowed=PLAN_ALLOWED) from error
    check_geometry(plan, path)
    _check_stated(document, plan, path)
    _check_names(document, path)
    return plan


def check_inputs(plan: Plan, case: Case, path: Path) -> None:
    """Refuse a plan whose case has changed since.

    Raises:
        InputError: Names the first input that differs.
    """
    name = differing_input(plan.inputs, case.inputs)
    if name is not None:
        raise InputError(f"input '{name}' is not the one that the plan was made from", where=path, allowed="plan again")


def check_geometry(plan: Plan, path: Path) -> None:
    """Refuse a plan whose motion does not do what it says: join, start at standoff, end on the target.

    Raises:
        InputError: Says which end is off, and by how much.
    """
    if not np.allclose(plan.approach.q[-1], plan.insertion.q[0], rtol=0, atol=JOIN_TOLERANCE_RAD):
        raise InputError("the insertion does not start where the approach ends", where=path, allowed="joined phases")
    _check_straight(plan, path)
    _check_speeds(plan, path)
    model = ur_model(plan.model)
    for name, q, standoff in (
        ("standoff", plan.insertion.q[0], plan.standoff_mm),
        ("target", plan.insertion.q[-1], 0.0),
    ):
        pose = needle_pose(plan.target_ct, plan.outward_ct, standoff=standoff, length=plan.needle_length_mm)
        T_base_flange = flange_pose(model, q)
        tip = T_base_flange[:3, 3] + plan.needle_length_mm * T_base_flange[:3, 2]
        for what, point, wanted in (("tip", tip, pose.tip_ct), ("flange", T_base_flange[:3, 3], pose.top_ct)):
            error = float(np.linalg.norm(point - plan.T_base_ct[:3, :3] @ wanted - plan.T_base_ct[:3, 3]))
            if not error <= POSE_TOLERANCE_MM:
                raise InputError(
                    f"the {what} at {name} is {error:.3g} mm off the stored pose",
                    where=path,
                    allowed=f"at most {POSE_TOLERANCE_MM} mm: {AGREE}",
                )


def check_angles(plan: Plan, path: Path) -> None:
    """Refuse a roll that is not that of the joint angles at standoff, and angles beyond their turn.

    Raises:
        InputError: Names the angle.
    """
    for name, angle, turn in (("theta_deg", plan.theta, np.pi), ("beta_deg", plan.beta, 2 * np.pi)):
        if not 0.0 <= angle <= turn * (1 + ANGLE_ROUNDING):
            raise InputError(f"{name} = {np.degrees(angle):g}", where=path, allowed=f"0 to {np.degrees(turn):g}")
    R, t = plan.T_base_ct[:3, :3], plan.T_base_ct[:3, 3]
    line = needle_lines((R @ plan.target_ct + t)[None], (R @ plan.outward_ct)[None])[0]
    unrolled = flange_at(line, plan.needle_length_mm + plan.standoff_mm)[:3, :3]
    x_axis = unrolled.T @ flange_pose(ur_model(plan.model), plan.insertion.q[0])[:3, 0]
    roll = float(np.arctan2(x_axis[1], x_axis[0])) % (2 * np.pi)
    off = abs((plan.roll - roll + np.pi) % (2 * np.pi) - np.pi)
    if off > ROLL_TOLERANCE_RAD or not 0.0 <= plan.roll < 2 * np.pi:
        what = f"roll_deg is {np.degrees(plan.roll):g}, the joint angles at standoff give {np.degrees(roll):.4g}"
        raise InputError(what, where=path, allowed="plan again")


def _check_straight(plan: Plan, path: Path) -> None:
    """Refuse an insertion that leaves the straight line, tilts the needle, goes too deep or turns back.

    Between two stored rows the joints turn evenly, so the motion is looked at there too.
    """
    model = ur_model(plan.model)
    poses = flange_pose(model, _between(plan.insertion.q, path))
    forward = poses[:, :3, 2]
    tips = poses[:, :3, 3] + plan.needle_length_mm * forward
    R, t = plan.T_base_ct[:3, :3], plan.T_base_ct[:3, 3]
    outward, from_target = R @ plan.outward_ct, tips - (R @ plan.target_ct + t)
    along = from_target @ outward
    aside = np.linalg.norm(from_target - along[:, None] * outward, axis=1).max()
    swing = plan.needle_length_mm * np.linalg.norm(forward + outward, axis=1).max()
    back = np.max(along - np.minimum.accumulate(along))
    deep = max(-along.min(), along.max() - plan.standoff_mm)
    for what, amount in (
        ("tip leaves the straight path", aside),
        ("flange end of the needle swings out", swing),
        ("insertion turns back", back),
        ("insertion goes beyond standoff and target", deep),
    ):
        if not amount <= STRAIGHT_TOLERANCE_MM:
            allowed = f"at most {STRAIGHT_TOLERANCE_MM} mm: {AGREE}"
            raise InputError(f"the {what} by {amount:.3g} mm", where=f"{path}: insertion", allowed=allowed)


def _between(q: Floats, path: Path) -> Floats:
    """The rows of a joint path and points between them, no more than `BETWEEN_RAD` apart in any joint."""
    counts = np.ceil(np.abs(np.diff(q, axis=0)).max(axis=1, initial=0.0) / BETWEEN_RAD).clip(min=1)
    if counts.sum() > MOST_STATES:
        raise InputError("the insertion turns its joints over and over", where=path, allowed="a straight insertion")
    segment = np.repeat(np.arange(len(counts)), counts.astype(np.int64))
    starts = np.cumsum(counts) - counts
    share = (np.arange(len(segment)) - starts[segment]) / counts[segment]
    return np.concatenate([q[segment] + share[:, None] * (q[segment + 1] - q[segment]), q[-1:]])


def _check_speeds(plan: Plan, path: Path) -> None:
    """Refuse joint limits, joint speeds or a tip speed beyond what a plan may have."""
    model = ur_model(plan.model)
    for phase, part in (("approach", plan.approach), ("insertion", plan.insertion)):
        if not model.within_limits(part.q).all():
            raise InputError(
                f"the {phase} leaves the joint limits", where=path, allowed="angles within the arm's limits"
            )
        fastest = float((part.max_speeds() / model.max_speeds).max())
        if not fastest <= 1 + SPEED_ROUNDING:
            raise InputError(
                f"the {phase} is {fastest:.3g} times as fast as a joint can turn",
                where=path,
                allowed="the arm's speeds",
            )
    poses = flange_pose(model, plan.insertion.q)
    tips = poses[:, :3, 3] + plan.needle_length_mm * poses[:, :3, 2]
    speed = float((np.linalg.norm(np.diff(tips, axis=0), axis=1) / np.diff(plan.insertion.times_s)).max(initial=0.0))
    if not speed <= INSERTION_MM_S * (1 + SPEED_ROUNDING):
        raise InputError(
            f"the insertion drives the tip at {speed:.3g} mm/s", where=path, allowed=f"at most {INSERTION_MM_S:g} mm/s"
        )


def _check_stated(document: dict[str, Any], plan: Plan, path: Path) -> None:
    """Refuse limits and peaks that are not the arm's and the samples' own: people read them."""
    stated: tuple[tuple[str, Any, dict[str, list[float]]], ...] = (
        ("limits", document.get("limits"), _rates_document(_limits(plan.model))),
        ("peaks of the approach", document["approach"].get("peaks"), _rates_document(plan.approach.peaks())),
        ("peaks of the insertion", document["insertion"].get("peaks"), _rates_document(plan.insertion.peaks())),
    )
    for name, said, known in stated:
        if not _same_rates(said, known):
            raise InputError(f"the {name} are not those of its numbers", where=path, allowed="plan again")
    for phase, part in (("approach", plan.approach), ("insertion", plan.insertion)):
        even = SAMPLE_S * np.arange(len(part.times_s))
        if not np.allclose(part.times_s, even, rtol=0, atol=SAME_TIME_S):
            raise InputError(f"the times of the {phase} are not even", where=path, allowed=f"a row every {SAMPLE_S} s")


def _same_rates(said: Any, known: dict[str, list[float]]) -> bool:
    try:
        return set(said) == set(known) and all(
            np.allclose(_array(said[rate], (6,)), known[rate], rtol=SAME_PEAK, atol=SAME_PEAK) for rate in known
        )
    except (TypeError, ValueError):
        return False


def _check_names(document: dict[str, Any], path: Path) -> None:
    """Refuse keys that no plan has: nothing says whether what they state is so."""
    for where, part, known in (
        ("", document, NAMES),
        ("approach.", document["approach"], PHASE_NAMES),
        ("insertion.", document["insertion"], PHASE_NAMES),
        ("clearance_mm.", document["clearance_mm"], CLEARANCE_NAMES),
        *((f"inputs.{at}.", one, INPUT_NAMES) for at, one in enumerate(document["inputs"])),
    ):
        # a phase whose clearance is not stated is for whoever has the case to miss
        for name in sorted(set(part) - set(known) if part is document["clearance_mm"] else set(part) ^ set(known)):
            what = "is not known" if name in part else "is missing"
            raise InputError(f"key '{where}{name}' {what}", where=path, allowed=", ".join(known))


def _limits(model_name: str) -> Peaks:
    model = ur_model(model_name)
    return Peaks(model.max_speeds, np.full(6, model.max_acceleration), np.full(6, MAX_JERK))


def _rates_document(rates: Peaks) -> dict[str, list[float]]:
    units = ("speed_rad_s", "acceleration_rad_s2", "jerk_rad_s3")
    return {unit: rate.tolist() for unit, rate in zip(units, rates, strict=True)}


def _document(data: bytes, path: Path) -> dict[str, Any]:
    try:
        document = json.loads(data.decode("utf-8"), parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as error:
        raise InputError(f"is not JSON: {error}", where=path, allowed=PLAN_ALLOWED) from error
    if not isinstance(document, dict) or document.get("version") != PLAN_VERSION:
        version = document.get("version") if isinstance(document, dict) else None
        raise InputError(f"version {version!r}", where=path, allowed=PLAN_ALLOWED)
    return document


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is no number")


def _plan(document: dict[str, Any], path: Path) -> Plan:
    return Plan(
        case_name=_field(document, "case", _text),
        inputs=_field(document, "inputs", read_inputs),
        seed=_field(document, "seed", _whole),
        model=_field(document, "robot", _text),
        T_base_ct=guard_transform(document["T_base_ct"], where=f"{path}: T_base_ct"),
        expected_target_error_mm=_field(document, "expected_target_error_mm", _number_or_nan),
        theta=float(np.radians(_field(document, "theta_deg", _number))),
        beta=float(np.radians(_field(document, "beta_deg", _number))),
        entry_ct=_field(document, "entry_ct_mm", _point),
        target_ct=_field(document, "target_ct_mm", _point),
        outward_ct=_field(document, "outward_ct", _point),
        roll=float(np.radians(_field(document, "roll_deg", _number))),
        standoff_mm=_field(document, "standoff_mm", _number),
        needle_length_mm=_field(document, "needle_length_mm", _number),
        approach=_field(document, "approach", _trajectory),
        insertion=_field(document, "insertion", _trajectory),
        clearance_mm=_field(document, "clearance_mm", _numbers),
    )


def _field(document: dict[str, Any], name: str, read: Callable[[Any], Value]) -> Value:
    """A value by its key, which errors name."""
    value = document[name]
    try:
        return read(value)
    except InputError as error:
        raise ValueError(f"{name}: {error.what}, not {error.allowed}") from error
    except KeyError as error:
        raise KeyError(f"{name}.{error.args[0]}") from error
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        raise ValueError(f"{name}: {error}") from error


def _numbers(value: Any) -> Mapping[str, float]:
    return MappingProxyType({_text(key): _number_or_nan(one) for key, one in value.items()})


def _number_or_nan(value: Any) -> float:
    return float("nan") if value is None else _number(value)


def _point(value: Any) -> Floats:
    return _array(value, (3,))


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{value!r} is no number")
    return _within(float(value))


def _within(value: float) -> float:
    if not abs(value) <= MAX_NUMBER:
        raise ValueError(f"{value:.3g} is beyond {MAX_NUMBER:g}")
    return value


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r} is no whole number")
    return value


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise TypeError(f"{value!r} is no text")
    return value


def _array(value: Any, shape: tuple[int, ...]) -> Floats:
    if np.asarray(value).dtype.kind not in "iuf":
        raise ValueError("an array of something else than numbers")
    array = np.array(value, dtype=np.float64)
    if array.shape != shape or not np.all(np.abs(array) <= MAX_NUMBER):
        raise ValueError(f"an array of shape {array.shape} where {shape} numbers within {MAX_NUMBER:g} belong")
    array.setflags(write=False)
    return array


def _trajectory(document: Any) -> Trajectory:
    count = len(document["times_s"])
    return Trajectory(_array(document["times_s"], (count,)), _array(document["q_rad"], (count, 6)))


def _trajectory_document(trajectory: Trajectory) -> dict[str, Any]:
    return {
        "times_s": trajectory.times_s.tolist(),
        "q_rad": trajectory.q.tolist(),
        "peaks": _rates_document(trajectory.peaks()),
    }


def _or_null(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
