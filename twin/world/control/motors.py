"""PyBullet's own position motors as a controller: in the air, and beside the controllers of the tip."""

from __future__ import annotations

from puncture_twin.twin.world.client import TIME_STEP_S
from puncture_twin.twin.world.control.reference import Reference
from puncture_twin.twin.world.control.run import Goals, Measured


class Motors:
    """The reference's joints are the motors' goals, whatever is measured."""

    dt = TIME_STEP_S

    def act(self, measured: Measured, reference: Reference, row: int) -> Goals:
        """Goals of the next step."""
        del measured
        return Goals(reference.q[row], reference.speed[row])
