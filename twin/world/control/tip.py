"""The needle's tip as the controller computes it: pose and Jacobian, in metres."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import jacobians, link_frames
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import skew
from puncture_twin.twin.world.units import MM_PER_M


class Tip(NamedTuple):
    """The tip at n configurations, base frame."""

    position_m: Floats
    """Shape (n, 3)."""
    R_base_tip: Floats
    """Shape (n, 3, 3), the flange's axes; z points along the needle to its tip."""
    J: Floats
    """Shape (n, 6, 6): tip velocity (m/s), then angular velocity (rad/s), from joint speeds (rad/s)."""


def tips(model: UrModel, tip_m: float, q: Floats) -> Tip:
    """The tip and its Jacobian.

    Args:
        model: The arm, nominal.
        tip_m: Flange to tip, along the flange's z.
        q: Shape (n, 6), rad.
    """
    frames, J = np.empty((len(q), 7, 4, 4)), np.empty((len(q), 6, 6))
    link_frames(model.lengths, np.array(q, order="C"), frames)
    jacobians(frames, J)
    flange = frames[:, 6]
    arm_m = tip_m * flange[:, :3, 2]
    # v_tip = v_flange + w x r
    J[:, :3] = J[:, :3] / MM_PER_M - skew(arm_m) @ J[:, 3:]
    return Tip(flange[:, :3, 3] / MM_PER_M + arm_m, flange[:, :3, :3], J)
