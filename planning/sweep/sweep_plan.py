"""A sweep: the needle's axis through one fixed point while its direction changes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class SweepPlan:
    """A motion about the virtual TCP (Chen 2019): the point on the needle's axis, a standoff before its tip.

    Attributes:
        model: The arm.
        needle_length_mm: Flange to tip.
        standoff_mm: Tip to virtual TCP.
        point_base: Shape (3,), mm: where the virtual TCP stays, the target.
        angles: Shape (k, 2), rad: theta and beta of every direction that is passed, a degree apart or less.
        wanted: Theta and beta, rad, where it should have ended.
        approach: From home to the first direction.
        sweep: Through all of them.
        stopped: Where and why it ends before; empty where it does not.
    """

    model: UrModel
    needle_length_mm: float
    standoff_mm: float
    point_base: Floats
    angles: Floats
    wanted: tuple[float, float]
    approach: Trajectory
    sweep: Trajectory
    stopped: str

    def off_point_mm(self, T_base_flange: Floats) -> Floats:
        """How far flange poses (m, 4, 4), mm, leave the virtual TCP from its point, shape (m,)."""
        reach = self.needle_length_mm + self.standoff_mm
        virtual = T_base_flange[:, :3, 3] + reach * T_base_flange[:, :3, 2]
        return np.asarray(np.linalg.norm(virtual - self.point_base, axis=1))
