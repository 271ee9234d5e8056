"""The limits of an arm's joints: those of its URDF, or narrower ones that the case states. None is guessed."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.urdf.document import UrdfJoint
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError

MOST_RAD = 4.0 * math.pi
"""Beyond two whole turns either way a limit is in degrees, or is none."""

MOST_RAD_S = 4.0 * math.pi
"""Twice as fast as any joint of a UR: beyond, a speed is in degrees."""

ROUNDING_RAD = 1e-4
"""By which a stated limit may exceed the URDF's: 6.2832 for a whole turn."""


class JointLimits(NamedTuple):
    """What six joints can do."""

    angles: Floats
    """Shape (6, 2), rad."""
    speeds: Floats
    """Shape (6,), rad/s."""
    torques: Floats
    """Shape (6,), N m."""


class StatedLimits(NamedTuple):
    """Limits that a case states; None where it leaves them to the arm."""

    angles: Floats | None = None
    """Shape (6, 2), rad."""
    speeds: Floats | None = None
    """Shape (6,), rad/s."""


NOTHING_STATED = StatedLimits()


def urdf_limits(joints: tuple[UrdfJoint, ...], stated: StatedLimits, where: Path) -> JointLimits:
    """The limits of a URDF's six joints; what the case states of them takes the place of what the URDF lacks.

    Args:
        joints: The six.
        stated: By the case.
        where: The URDF, for errors.

    Raises:
        InputError: A limit is missing, is in degrees, or makes no sense.
    """
    angles, speeds, torques = np.empty((6, 2)), np.empty(6), np.empty(6)
    for row, joint in enumerate(joints):
        here = f"{where}: joint '{joint.name}'"
        angles[row] = (-MOST_RAD, MOST_RAD) if _unlimited(joint, stated) else _angles(joint, here)
        speeds[row] = _above_zero(joint, "velocity", here, "rad/s", MOST_RAD_S)
        torques[row] = _above_zero(joint, "effort", here, "N m", math.inf)
    return JointLimits(angles, speeds, torques)


def narrowed(known: JointLimits, stated: StatedLimits, where: str) -> JointLimits:
    """The limits with what a case states in their place.

    Raises:
        InputError: A stated limit is wider than the arm's own.
    """
    angles, speeds = known.angles, known.speeds
    if stated.angles is not None:
        wider = (stated.angles[:, 0] < angles[:, 0] - ROUNDING_RAD) | (
            stated.angles[:, 1] > angles[:, 1] + ROUNDING_RAD
        )
        if wider.any():
            joint = int(np.argmax(wider))
            low, high = np.degrees(angles[joint])
            what = f"the angles of joint {joint + 1} go beyond the arm's own"
            raise InputError(what, where=where, allowed=f"from {low:g} to {high:g} degrees")
        angles = stated.angles
    if stated.speeds is not None:
        faster = stated.speeds > speeds + ROUNDING_RAD
        if faster.any():
            joint = int(np.argmax(faster))
            what = f"the speed of joint {joint + 1} is above the arm's own"
            raise InputError(what, where=where, allowed=f"at most {np.degrees(speeds[joint]):g} degrees/s")
        speeds = stated.speeds
    return JointLimits(angles, speeds, known.torques)


def _unlimited(joint: UrdfJoint, stated: StatedLimits) -> bool:
    """Whether a joint's limits come from the case alone."""
    return stated.angles is not None and (joint.kind == "continuous" or not {"lower", "upper"} <= set(joint.limits))


def _angles(joint: UrdfJoint, here: str) -> tuple[float, float]:
    if joint.kind == "continuous":
        raise InputError("it is continuous: it states no limits", where=here, allowed="revolute, or [robot.limits]")
    if not {"lower", "upper"} <= set(joint.limits):
        raise InputError("<limit> lacks lower or upper", where=here, allowed="both, in rad; or [robot.limits]")
    low, high = joint.limits["lower"], joint.limits["upper"]
    if not low < high:
        raise InputError(f"limits from {low:g} to {high:g}", where=here, allowed="lower below upper, in rad")
    if max(-low, high) > MOST_RAD:
        what = f"limits from {low:g} to {high:g} rad, which look like degrees"
        raise InputError(what, where=here, allowed=f"rad, at most {MOST_RAD:.2f} either way")
    return low, high


def _above_zero(joint: UrdfJoint, key: str, here: str, unit: str, most: float) -> float:
    value = joint.limits.get(key, 0.0)
    if not 0.0 < value <= most:
        allowed = f"above 0{'' if math.isinf(most) else f', at most {most:.2f}'} {unit}"
        raise InputError(f'<limit {key}="{value:g}">', where=here, allowed=allowed)
    return value
