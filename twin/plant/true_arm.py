"""The ground truth of an arm: links and joints off their nominal values, play in the gears, joints that miss.

What planning believes is a :class:`planning.arm.ur.UrModel`. A commanded configuration
becomes a true one in three steps: the gears stop at the edge of their play (:func:`settle`), the joints miss by their
repeatability, and the true Denavit-Hartenberg numbers carry the flange somewhere near where the nominal ones say.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import ErringArm
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats


class ArmErrors(NamedTuple):
    """Deviations of an arm from its nominal model: standard deviations, normal, and the width of the play."""

    link_mm: float = 0.0
    """Deviation of every Denavit-Hartenberg length a_i and d_i."""
    twist_rad: float = 0.0
    """Deviation of every twist alpha_i: axes that should be parallel or square and are not quite."""
    joint_rad: float = 0.0
    """Deviation of every joint's zero."""
    backlash_rad: float = 0.0
    """Full width of the play of every joint, not random."""
    repeatability_rad: float = 0.0
    """Deviation of every joint, drawn anew at each arrival."""


class TrueArm(NamedTuple):
    """One arm, drawn. Denavit-Hartenberg numbers of shape (6,), mm and rad."""

    nominal: UrModel
    a: Floats
    d: Floats
    alpha: Floats
    joint_offsets: Floats
    """True zero minus nominal zero of each joint, rad."""
    backlash_rad: float
    repeatability_rad: float

    def link_poses(self, q_true: Floats) -> Floats:
        """T_base_link, shape (..., 7, 4, 4), mm, of true configurations (..., 6), rad: base first, flange last."""
        return ErringArm(self.a, self.d, self.alpha, self.joint_offsets).link_poses(q_true)

    def flange_pose(self, q_true: Floats) -> Floats:
        """T_base_flange, shape (..., 4, 4), mm, of true configurations (..., 6), rad."""
        return np.ascontiguousarray(self.link_poses(q_true)[..., 6, :, :])

    def settle(self, q_command: Floats, q_before: Floats, rng: np.random.Generator) -> Floats:
        """Joints at rest, shape (6,), rad.

        The play operator: a joint moves only when the motor has crossed the play, q = clip(q_before, q_command - b/2,
        q_command + b/2); then its repeatability adds a normal error, which the next arrival draws anew.

        Args:
            q_command: Shape (6,), what the encoders say on arrival.
            q_before: Shape (6,), what this function gave for the arrival before, or the first command.
            rng: For the repeatability.
        """
        half = 0.5 * self.backlash_rad
        settled = np.clip(q_before, q_command - half, q_command + half)  # the play operator
        return np.asarray(settled + rng.normal(0.0, self.repeatability_rad, 6))


def draw_true_arm(nominal: UrModel, errors: ArmErrors, rng: np.random.Generator) -> TrueArm:
    """An arm whose errors are drawn from their standard deviations.

    The offset d2 along axis 2 is not drawn with d3: the axes are parallel, and both move the arm alike.
    """
    d_errors = rng.normal(0.0, errors.link_mm, 6)
    d_errors[1] = 0.0
    return TrueArm(
        nominal,
        a=np.array(nominal.a) + rng.normal(0.0, errors.link_mm, 6),
        d=np.array(nominal.d) + d_errors,
        alpha=np.array(nominal.alpha) + rng.normal(0.0, errors.twist_rad, 6),
        joint_offsets=rng.normal(0.0, errors.joint_rad, 6),
        backlash_rad=errors.backlash_rad,
        repeatability_rad=errors.repeatability_rad,
    )
