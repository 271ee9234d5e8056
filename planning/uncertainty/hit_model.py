"""When a tip hits: within a radius of the target, or within its mesh, with the errors of the pose."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.uncertainty.hit import TargetRays, hit_in_ball, hit_in_mesh, target_rays
from puncture_twin.planning.uncertainty.pose_error import PoseError


@dataclass(frozen=True, eq=False)
class HitModel:
    """When a tip hits: within a radius of the target, or within its mesh.

    Attributes:
        radius_mm: Where a case gives one.
        rays: The target's mesh, else.
    """

    radius_mm: float | None
    rays: TargetRays | None

    def chance(self, error: PoseError, cov_ct: Floats) -> Floats:
        """The chance of needles with these Sigma6, shape (n, 6, 6), CT axes: shape (n,)."""
        if self.rays is None or self.radius_mm is not None:
            assert self.radius_mm is not None
            return hit_in_ball(cov_ct[:, :3, :3] + error.target_covariance_ct, self.radius_mm, error.freedom)
        # a surface that lies off takes from the target as a tip would that errs so
        cov = cov_ct[:, :3, :3] + error.surface_mm**2 * np.eye(3)
        return hit_in_mesh(self.rays, np.ascontiguousarray(cov), error.freedom)


def hit_model(radius_mm: float | None, mesh: TriangleMesh, target_ct: Floats) -> HitModel:
    """By the radius where there is one, else by the mesh of the target's structure."""
    return HitModel(radius_mm, None if radius_mm is not None else target_rays(mesh, target_ct))
