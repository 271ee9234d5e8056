"""The insertion for which a pose is corrected, and how residuals tell of the arm's errors there."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import ReadingNoise


@dataclass(frozen=True, eq=False)
class Aim:
    """The insertion for which a pose is corrected.

    Attributes:
        target_ct: Shape (3,), mm.
        q: Shape (6,), rad, the tip on the target.
        arm_jacobian: Shape (6, 28), J_f: how the arm's parameters move the needle there, base axes.
    """

    target_ct: Floats
    q: Floats
    arm_jacobian: Floats

    def response(self, noise: ReadingNoise, weights: Floats) -> Floats:
        """J_f Sigma_eta J' W, shape (..., 6, 3 N): motion of the pose at the target per residual, W (..., 3 N, 3 N)."""
        return np.asarray((self.arm_jacobian * noise.eta_variances) @ noise.arm_jacobian.T @ weights)


def aim_at(model: UrModel, tip_mm: float, target_ct: Floats, q: Floats) -> Aim:
    """The aim of an insertion in configuration q (6,), rad, at a target (3,), mm."""
    return Aim(target_ct, q, error_jacobian(model, q, tip_mm))


TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
"""Puncture angles that are tried for an insertion that the arm reaches, in this order."""

AZIMUTHS = 12
"""Directions tried at each."""


def reached_insertion(case: Case, T_base_ct: Floats) -> Floats | None:
    """Joints (6,), rad, that put the tip on the target at the least puncture angle tried; None where none reach.

    Only an arm's kinematics are looked at: organs and collisions are the search's.
    """
    model = case.robot.model
    target = apply(T_base_ct, case.target_ct)
    home = np.zeros(6)
    for tilt in np.radians(TILTS_DEG):
        azimuths = np.linspace(0, 2 * np.pi, AZIMUTHS if tilt else 1, endpoint=False)
        local = np.array([outward(float(tilt), float(azimuth)) for azimuth in azimuths])
        directions = local @ (T_base_ct[:3, :3] @ case.T_ct_entry[:3, :3]).T
        q = inverse(model, flange_poses(target, directions, case.needle.length_mm)).reshape(-1, 6)
        q = nearest_within_limits(model, q, home)
        q = q[~np.isnan(q).any(axis=1)]
        q = q[away_from_singularities(model, q)]
        if len(q):
            return np.asarray(q[0])
    return None
