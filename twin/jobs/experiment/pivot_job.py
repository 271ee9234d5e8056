"""`pivot CASE JOINTS`: the needle's tip from touches of one place, beside what the case says of it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import read_input
from puncture_twin.planning.base.provenance import Input, content_input, inputs_document
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points.point_files import MAX_FILE_BYTES, parse_points
from puncture_twin.twin.guidance.ct.pivot import LARGE, Pivot, pivot_calibration


@dataclass(frozen=True, eq=False)
class PivotRun:
    """A calibrated tip beside the case's.

    Attributes:
        case: Whose arm and needle.
        pivot: What was found.
        poses: From so many.
        inputs: Every file that decided.
    """

    case: Case
    pivot: Pivot
    poses: int
    inputs: tuple[Input, ...]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        pivot = self.pivot
        return {
            "case": self.case.name,
            "poses": self.poses,
            "tip_flange_mm": pivot.tip_flange.tolist(),
            "tip_sd_mm": np.sqrt(np.diag(pivot.cov_tip)).tolist(),
            "stated_length_mm": self.case.needle.length_mm,
            "residual_mm": pivot.residual_mm,
            "expected_residual_mm": pivot.expected_mm,
            "residual_is_large": pivot.large,
            "inputs": inputs_document(self.inputs),
        }


def pivot_case(case: Case, joints: Path) -> PivotRun:
    """Calibrate the tip from a list of touches of one place.

    Args:
        case: For the arm and the declared `touch_mm`.
        joints: CSV as `touch` writes it: a line a pose, with q1_deg to q6_deg.

    Raises:
        InputError: The case declares no errors, or the list has no joints, too few, or too much alike.
    """
    if case.errors is None:
        raise InputError("no noise is declared", where=case.path, allowed="[errors] touch_mm")
    data = read_input(joints, max_bytes=MAX_FILE_BYTES, where=str(joints))
    read = parse_points(data, joints)
    if read.joints is None:
        raise InputError("no joints", where=joints, allowed="columns q1_deg to q6_deg beside name,x_mm,y_mm,z_mm")
    poses = flange_pose(ur_model(case.robot.model), read.joints)
    pivot = pivot_calibration(poses, case.errors.touch_mm, where=str(joints))
    inputs = (content_input("joints", joints.name, data), *case.inputs)
    return PivotRun(case, pivot, len(poses), inputs)


def pivot_text(run: PivotRun) -> str:
    """For the terminal."""
    pivot = run.pivot
    x, y, z = pivot.tip_flange
    sd = np.sqrt(np.diag(pivot.cov_tip))
    lines = [
        f"tip in the flange frame: ({x:.3f}, {y:.3f}, {z:.3f}) mm, sd ({sd[0]:.3f}, {sd[1]:.3f}, {sd[2]:.3f}), "
        f"from {run.poses} poses",
        f"the case states {run.case.needle.length_mm:g} mm along z: {z - run.case.needle.length_mm:+.3f} mm, "
        f"and {np.hypot(x, y):.3f} mm beside it",
        f"residual {pivot.residual_mm:.3f} mm rms; the declared touch noise leaves {pivot.expected_mm:.3f}",
    ]
    if pivot.large:
        lines.append(f"more than {LARGE:g} times that: the tip slipped, or the arm's own errors dominate")
    return "\n".join(lines)
