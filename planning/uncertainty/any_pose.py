"""The most that a needle's pose may err in any configuration that puts its tip on the target.

No configuration is asked: every column of the arm's error Jacobian is bounded by its lever, and a lever's length by the
chain between the tip and the joint. For matrices |A + B| <= |A| + |B| and |[A B]|^2 <= |A|^2 + |B|^2 (largest singular
values), so that for every q

    sqrt(lmax Sigma_dd) <= deviation_mm,   sqrt(lmax Sigma_phiphi) <= deviation_rad.

A distance whose gradient is g = (n; s u x n), |n| = |u| = 1, then deviates by deviation_mm + s deviation_rad at most.

A point of the axis at depth s is displaced by no more than |d| + s |phi|, phi across the axis, and a surface by e. With
(d, phi, e) whitened to w of 6 dimensions, Cauchy and Schwarz give for all s at once

    |d| + s |phi| + |e| <= |w| hypot(deviation_mm + s deviation_rad, surface_mm),

and |w|^2 is chi-squared (6 times Fisher's F where the residuals gave the noise's size). So a distance that is larger
than the needle's radius by z times this, z^2 the quantile of 1 - P, is used up with a chance of P at most, whatever the
surface's shape.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri, fdtri

from puncture_twin.planning.arm.kinematics import PARAMETERS
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.uncertainty.pose_error import PoseError


class AnyPose(NamedTuple):
    """Bounds of a pose's error, whatever the configuration; see above."""

    deviation_mm: float
    deviation_rad: float

    def of_distance(self, depth_mm: Floats, surface_mm: Floats) -> Floats:
        """Bound of the standard deviation of distances whose nearest axis points lie no deeper than this, (k,), mm."""
        return np.hypot(self.deviation_mm + depth_mm * self.deviation_rad, surface_mm)

    def margin(
        self,
        chance: float,
        freedom: int | None,
        farthest_mm: Floats,
        lengths_mm: Floats,
        radius_mm: float,
        surface_mm: Floats,
    ) -> Floats:
        """Clearance at which no needle touches a structure more often than ``chance``, whatever its shape, (k,), mm.

        Beyond ``farthest`` the axis leaves the structure by as much as it goes on, which is more than it is displaced
        by as soon as it has left it by ``beyond``: deeper points never decide.

        Args:
            chance: P.
            freedom: Of the residuals that gave the noise's size; None where it is declared.
            farthest_mm: Shape (k,), the structures' greatest distances from the target.
            lengths_mm: Shape (k,), how long the axis is.
            radius_mm: The needle's.
            surface_mm: Shape (k,), by which each structure's surface may lie off as a whole, at most.
        """
        count = 5 + int((surface_mm > 0).any())
        square = chdtri(count, chance) if freedom is None else count * fdtri(count, freedom, 1.0 - chance)
        z = np.sqrt(square)
        kept, deepest = 1.0 - z * self.deviation_rad, np.asarray(lengths_mm, dtype=np.float64)
        if kept > 0.0:
            straight = self.deviation_mm + surface_mm + farthest_mm * self.deviation_rad
            beyond = (radius_mm + z * straight) / kept
            deepest = np.minimum(farthest_mm + beyond, deepest)
        return np.asarray(z * self.of_distance(deepest, surface_mm))


def any_pose(error: PoseError) -> AnyPose:
    """The bounds of a pose error."""
    noise, arm, scale = error.fit.noise, error.errors.arm, error.fit.test.scale
    variance, levers = noise.eta_variances, _levers_mm(error)
    link, twist, joint, tip, direction = (variance[PARAMETERS[kind]] for kind in PARAMETERS)
    own_mm = np.sqrt(link.sum() + twist @ levers[1:] ** 2 + joint @ levers[:6] ** 2 + tip.max())
    own_rad = np.sqrt(twist.sum() + joint.sum() + direction.max())
    anew = np.hypot(arm.drift, arm.repeatability)
    readings = error.fit.cov_at(error.target_base)
    bounds = []
    for rows, own, arrival in (
        (slice(0, 3), own_mm, anew * np.linalg.norm(levers[:6])),
        (slice(3, 6), own_rad, anew * np.sqrt(6.0)),
    ):
        if noise.touches_known:
            at_touches = error.fit.map_at(error.target_base)[rows] @ noise.arm_jacobian
            lasting = own + np.linalg.norm(at_touches * np.sqrt(variance), 2)
        else:
            lasting = np.sqrt(2.0) * own
        largest = np.linalg.eigvalsh(readings[rows, rows])[-1]
        bounds.append(float(np.sqrt(largest + scale**2 * (lasting**2 + arrival**2))))
    return AnyPose(bounds[0], bounds[1])


def _levers_mm(error: PoseError) -> Floats:
    """Of each frame's origin, 0 to 6, from a tip on the target: the chain between them from either end, shape (7,)."""
    model, target = error.model, error.target_base
    links = np.hypot(model.a, model.d)
    from_tip = error.tip_mm + np.append(np.cumsum(links[::-1])[::-1], 0.0)
    to_base, to_shoulder = np.linalg.norm(target), np.linalg.norm(target - model.shoulder_base)
    from_base = np.concatenate([[to_base], to_shoulder + np.concatenate([[0.0], np.cumsum(links[1:])])])
    return np.asarray(np.minimum(from_tip, from_base))
