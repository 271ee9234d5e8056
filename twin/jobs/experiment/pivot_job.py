"""`pivot CASE JOINTS`: the needle's tip from touches of one place, beside what the case says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.stated_arm import check_recording
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.base.provenance import Input, content_input, inputs_document
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.joint_readings import parse_joint_recording
from puncture_twin.planning.formats.points.point_files import MAX_FILE_BYTES
from puncture_twin.twin.guidance.ct.pivot import LARGE, Pivot, arm_covariance, check_one_place, pivot_calibration

STANDS_OUT = 2.0
"""A touch that misses by so many times the others' root mean square is named."""


@dataclass(frozen=True, eq=False)
class PivotRun:
    """A calibrated tip beside the case's.

    Attributes:
        case: Whose arm and needle.
        pivot: What was found.
        names: Of its touches.
        inputs: Every file that decided.
    """

    case: Case
    pivot: Pivot
    names: tuple[str, ...]
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        pivot = self.pivot
        return {
            "case": self.case.name,
            "poses": len(self.names),
            "tip_flange_mm": pivot.tip_flange.tolist(),
            "tip_sd_mm": np.sqrt(np.diag(pivot.cov_tip)).tolist(),
            "stated_length_mm": self.case.needle.length_mm,
            "residual_mm": pivot.residual_mm,
            "expected_residual_mm": pivot.expected_mm,
            "expected_residual_with_arm_mm": pivot.expected_whole_mm,
            "residual_is_large": pivot.large,
            "misses_mm": dict(zip(self.names, pivot.misses_mm.tolist(), strict=True)),
            "inputs": inputs_document(self.inputs),
        }


def pivot_case(case: Case, joints: Path) -> PivotRun:
    """Calibrate the tip from a list of touches of one place.

    Args:
        case: For the arm and the declared errors.
        joints: CSV, a line a pose, with q1_deg to q6_deg alone or among other columns, as `pivot CASE` writes it.

    Raises:
        InputError: The case declares no errors, or the list has no joints, too few, too much alike, or of several
            places.
    """
    data = read_input(joints, max_bytes=MAX_FILE_BYTES, where=str(joints))
    read = parse_joint_recording(data, joints, timed=False)
    check_recording(case.robot.model, case.needle.length_mm, read, where=joints)
    pivot = calibrated(case, read.names, read.q, where=str(joints))
    inputs = (content_input("joints", joints.name, data), *case.inputs)
    return PivotRun(case, pivot, read.names, inputs)


def calibrated(case: Case, names: tuple[str, ...], q: Floats, *, where: str) -> Pivot:
    """The tip from joints (n, 6), rad, that touched one place.

    Raises:
        InputError: As `pivot_case`.
    """
    if case.errors is None:
        raise InputError("no noise is declared", where=case.path, allowed="[errors] touch_mm")
    model, tip_mm = case.robot.model, case.needle.length_mm
    poses = flange_pose(model, q)
    check_one_place(names, poses[:, :3, 3] + tip_mm * poses[:, :3, 2], poses[:, :3, :3], where=where)
    arm_cov = arm_covariance(case.errors, model, tip_mm, q)
    return pivot_calibration(poses, case.errors.touch_mm, arm_cov=arm_cov, where=where)


def pivot_text(run: PivotRun) -> str:
    """For the terminal."""
    pivot = run.pivot
    x, y, z = pivot.tip_flange
    sd = np.sqrt(np.diag(pivot.cov_tip))
    lines = [
        f"tip in the flange frame: ({x:.3f}, {y:.3f}, {z:.3f}) mm, sd ({sd[0]:.3f}, {sd[1]:.3f}, {sd[2]:.3f}), "
        f"from {len(run.names)} poses",
        f"the case states {run.case.needle.length_mm:g} mm along z: {z - run.case.needle.length_mm:+.3f} mm, "
        f"and {np.hypot(x, y):.3f} mm beside it",
        f"residual {pivot.residual_mm:.3f} mm rms; the declared touch noise leaves {pivot.expected_mm:.3f}, "
        f"with the declared arm {pivot.expected_whole_mm:.3f}",
        *_doubt(run),
    ]
    return "\n".join(lines)


def _doubt(run: PivotRun) -> list[str]:
    """What a large residual is likely to come from."""
    pivot = run.pivot
    if not pivot.large:
        arm = pivot.expected_whole_mm > LARGE * pivot.expected_mm
        return ["the arm's own errors, as declared, leave most of it: more poses do not help"] if arm else []
    worst = int(np.argmax(pivot.misses_mm))
    rest = float(np.sqrt(np.mean(np.delete(pivot.misses_mm, worst) ** 2)))
    head = f"more than {LARGE:g} times what is declared"
    if pivot.misses_mm[worst] > STANDS_OUT * rest:
        one = f"{run.names[worst]} misses by {pivot.misses_mm[worst]:.2f} mm, the others by {rest:.2f} (rms)"
        return [f"{head}: {one}: the tip slipped there, or touched another place"]
    return [f"{head}, and all touches alike: the arm errs by more than it declares, or they are of several places"]
