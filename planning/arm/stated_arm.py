"""Are the joints of this arm? Held against what the same file says of where flange, tool or tip was.

A UR3e's joints read as a UR3's are 18 mm off, and nothing in six angles says so. But a recording often states the same
thing twice: a controller's own pose beside its joints, a touched point, a flange. With the arm's nominal lengths both
must agree, up to what a controller's own calibration moves.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UR_MODELS, UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.joint_readings import JointRecording

MOST_OFF_MM = 5.0
"""A controller with its own calibration puts the tip up to some mm from where the data sheet's arm does."""

FITS_MM = 1.5
"""Another model whose joints put the tool so near to where it was is the arm that was recorded."""

LEVER_MM = 95.0
"""A flange's axes are held against joints by points so far out: 3 degrees move them by 5 mm."""


def check_arm(
    model: UrModel,
    q: Floats,
    points_base: Floats,
    tools_flange: Sequence[Floats],
    *,
    names: Sequence[str],
    where: str | Path,
    any_tool: bool = False,
) -> None:
    """Refuse joints that do not put the tool where the same file says that it was.

    Args:
        model: The case's arm.
        q: Shape (n, 6), rad.
        points_base: Shape (n, 3), mm: where the tool was.
        tools_flange: What the tool may be: points (3,) of the flange, mm.
        names: Of the n rows.
        where: What the error names.
        any_tool: Whether it may also be any other point, the same in all rows.

    Raises:
        InputError: Names the row that is farthest off, and the models that would fit.
    """

    def off(one: UrModel, known: bool) -> Floats:
        flanges = flange_pose(one, q)
        R, gaps = flanges[:, :3, :3], points_base - flanges[:, :3, 3]
        tools = [*tools_flange] if known else [np.median(np.einsum("nji,nj->ni", R, gaps), axis=0)]
        return min((np.linalg.norm(R @ tool - gaps, axis=1) for tool in tools), key=lambda misses: float(misses.max()))

    own = off(model, True)
    if own.max() <= MOST_OFF_MM:
        return
    likely = [one.name for one in UR_MODELS.values() if one != model and off(one, True).max() <= FITS_MM]
    if any_tool and not likely:
        own = off(model, False)
        if own.max() <= MOST_OFF_MM:
            return
        likely = [one.name for one in UR_MODELS.values() if one != model and off(one, False).max() <= FITS_MM]
    row = int(np.argmax(own))
    arm = f"; those of a {' or '.join(likely)} do not" if likely else ""
    what = f"the joints of {names[row]} put the tool of a {model.name} {own[row]:.1f} mm from where it was{arm}"
    allowed = f"within {MOST_OFF_MM:g} mm: joints of the case's arm, in their unit, with its needle"
    raise InputError(what, where=where, allowed=allowed, code="joints_of_another_arm")


def check_recording(model: UrModel, tip_mm: float, recording: JointRecording, *, where: str | Path) -> None:
    """Refuse a recording whose controller had its tool where this arm's joints do not put one; without a tool, nothing.

    Args:
        model: The case's arm.
        tip_mm: Flange to tip of its needle.
        recording: Joints, and where the controller had its tool: flange, tip, or another point that all rows share.
        where: What the error names.

    Raises:
        InputError: As `check_arm`.
    """
    if recording.tool_base is None:
        return
    tools = [np.zeros(3), np.array([0.0, 0.0, tip_mm])]
    names = [f"row {number}" for number in range(1, len(recording.q) + 1)]
    check_arm(model, recording.q, recording.tool_base, tools, names=names, where=where, any_tool=True)


def check_flanges(model: UrModel, q: Floats, T_base_flange: Floats, *, names: Sequence[str], where: str | Path) -> None:
    """Refuse joints (n, 6), rad, that do not belong to flanges (n, 4, 4), mm, in place and axes.

    Raises:
        InputError: As `check_arm`.
    """
    for tool in (np.zeros(3), *(LEVER_MM * np.eye(3)[:2])):
        points = T_base_flange[:, :3, 3] + T_base_flange[:, :3, :3] @ tool
        check_arm(model, q, points, [tool], names=names, where=where)
