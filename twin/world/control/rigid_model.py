"""The controller's own model of the arm: its inverse dynamics and mass matrix, right for any mount.

PyBullet evaluates inverse dynamics as if the body's base were not turned in the world: gravity enters in world axes and
leaves in base axes. The model therefore stands in a world of its own, its URDF base unturned, under a gravity that was
turned instead: g_urdf = R_urdf_base g_base.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.model_urdf import model_urdf
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm import Arm, load_arm
from puncture_twin.twin.world.client import physics_client
from puncture_twin.twin.world.engine import pybullet


@dataclass(frozen=True)
class RigidModel:
    """What the controller knows of the arm's masses; it never moves.

    Attributes:
        kinematics: Lengths of the arm.
        tip_m: Flange to tip, along the flange's z.
        arm: The body that is evaluated, alone in a client of its own.
    """

    kinematics: UrModel
    tip_m: float
    arm: Arm

    def inverse_dynamics(self, q: Floats, speed: Floats, acceleration: Floats) -> Floats:
        """Torques that give accelerations: tau = M(q) qdd + c(q, qd) + g(q); all of shape (6,), rad, s, N m."""
        client, body = self.arm.client, self.arm.body
        return np.array(
            pybullet.calculateInverseDynamics(
                body, q.tolist(), speed.tolist(), acceleration.tolist(), physicsClientId=client
            )
        )

    def mass_matrix(self, q: Floats) -> Floats:
        """M(q), shape (6, 6), kg m^2."""
        return np.array(pybullet.calculateMassMatrix(self.arm.body, q.tolist(), physicsClientId=self.arm.client))


@contextmanager
def rigid_model(model: UrModel, tool: Tool, down_base: Floats) -> Iterator[RigidModel]:
    """Open the model of an arm, and close it again.

    Args:
        model: The arm.
        tool: What its flange carries.
        down_base: Shape (3,), unit vector of gravity in the controller's base frame: any mount is a direction.

    Raises:
        InputError: There is no body of that arm.
    """
    T_base_root = model_urdf(model).T_base_root
    with physics_client(down=T_base_root[:3, :3].T @ down_base) as client:
        # T_world_urdf = T_world_base T_base_urdf = identity
        arm = load_arm(client, model, tool, np.asarray(np.linalg.inv(T_base_root), np.float64))
        yield RigidModel(model, tool.needle_length_mm / 1000.0, arm)
