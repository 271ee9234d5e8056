"""What the tip shall do: a joint motion at every step of the controller, with its speeds and accelerations."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.interpolate import CubicSpline

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.twin.world.control.tip import tips


@dataclass(frozen=True, eq=False)
class Reference:
    """One row a step of the controller.

    Attributes:
        q: Shape (n, 6), rad.
        speed: Shape (n, 6), rad/s.
        acceleration: Shape (n, 6), rad/s^2.
        position_m: Shape (n, 3), of the tip, base frame.
        R_base_tip: Shape (n, 3, 3).
        twist: Shape (n, 6), m/s and rad/s.
    """

    q: Floats
    speed: Floats
    acceleration: Floats
    position_m: Floats
    R_base_tip: Floats
    twist: Floats

    def __len__(self) -> int:
        return len(self.q)


def reference_of(model: UrModel, tip_m: float, trajectory: Trajectory, dt: float, hold_s: float = 0.0) -> Reference:
    """A trajectory at every step, smooth between its samples (cubic spline, at rest at both ends), then held.

    Args:
        model: The arm.
        tip_m: Flange to tip.
        trajectory: From rest to rest.
        dt: The controller's step, s.
        hold_s: How long its end is held.
    """
    moving = int(np.ceil(trajectory.duration_s / dt)) + 1
    times = np.minimum(dt * np.arange(moving + round(hold_s / dt)), trajectory.duration_s)
    if len(trajectory.q) == 1:
        still = np.zeros((len(times), 6))
        return _reference(model, tip_m, np.tile(trajectory.q[0], (len(times), 1)), still, still)
    spline = CubicSpline(trajectory.times_s, trajectory.q, bc_type="clamped")
    at_rest = (times >= trajectory.duration_s)[:, None]
    return _reference(
        model, tip_m, spline(times), np.where(at_rest, 0.0, spline(times, 1)), np.where(at_rest, 0.0, spline(times, 2))
    )


def _reference(model: UrModel, tip_m: float, q: Floats, speed: Floats, acceleration: Floats) -> Reference:
    tip = tips(model, tip_m, q)
    return Reference(q, speed, acceleration, tip.position_m, tip.R_base_tip, (tip.J @ speed[..., None])[..., 0])
