"""The arm in the workcell: loaded, moved by its joint motors, and read back."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.links import LINK_NAMES, model_urdf
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE, ArmUrdf
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm_file import write_arm_urdf
from puncture_twin.twin.world.client import pose_to_m, pose_to_mm, pybullet

POSITION_GAIN = 0.1
"""Fraction of a joint's position error that its motor takes back per step, Bullet's default: an error falls to 1/e
in 9.5 steps (40 ms), slow enough that starts and stops leave a visible trace, as a real controller's do."""

VELOCITY_GAIN = 1.0
"""Fraction of a joint's speed error that its motor takes back per step."""


class JointState(NamedTuple):
    """Angles and speeds of the joints."""

    q: Floats
    """Shape (6,), rad."""
    speed: Floats
    """Shape (6,), rad/s."""


@dataclass(frozen=True)
class Arm:
    """A loaded arm. Joint angles are the true ones of the simulated body.

    Attributes:
        joints: Indices of the six joints.
        links: Name (as in `planning.collision.checker.BODY_NAMES`, and the flange) to index; the base is -1.
        max_torque: Shape (6,), N m.
    """

    client: int
    body: int
    joints: tuple[int, ...]
    links: MappingProxyType[str, int]
    max_torque: tuple[float, ...]

    def link_name(self, index: int) -> str:
        """Name of a link."""
        return next(name for name, number in self.links.items() if number == index)

    def place(self, q: Floats) -> None:
        """Put the joints at q, shape (6,), rad, at rest, without physics."""
        for joint, angle in zip(self.joints, q.tolist(), strict=True):
            pybullet.resetJointState(self.body, joint, angle, 0.0, physicsClientId=self.client)

    def command(self, q: Floats, speed: Floats) -> None:
        """Set the motors' goal for the next steps: angles (6,) in rad, speeds (6,) in rad/s."""
        pybullet.setJointMotorControlArray(
            self.body,
            self.joints,
            pybullet.POSITION_CONTROL,
            targetPositions=q.tolist(),
            targetVelocities=speed.tolist(),
            forces=self.max_torque,
            positionGains=[POSITION_GAIN] * 6,
            velocityGains=[VELOCITY_GAIN] * 6,
            physicsClientId=self.client,
        )

    def release(self) -> None:
        """Switch the motors off, for torques."""
        pybullet.setJointMotorControlArray(
            self.body, self.joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * 6, physicsClientId=self.client
        )

    def torque(self, torque_nm: Floats) -> None:
        """Torques (6,), N m, for the next step alone, cut to what the joints can give."""
        cut = np.clip(torque_nm, -np.array(self.max_torque), self.max_torque)
        pybullet.setJointMotorControlArray(
            self.body, self.joints, pybullet.TORQUE_CONTROL, forces=cut.tolist(), physicsClientId=self.client
        )

    def push(self, link: str, force_n: Floats, point_m: Floats) -> None:
        """Push a link in the next step alone: a force (3,), N, at a point (3,), m, both in the world frame."""
        pybullet.applyExternalForce(
            self.body,
            self.links[link],
            force_n.tolist(),
            point_m.tolist(),
            pybullet.WORLD_FRAME,
            physicsClientId=self.client,
        )

    def state(self) -> JointState:
        """Angles and speeds of the joints."""
        states = pybullet.getJointStates(self.body, self.joints, physicsClientId=self.client)
        return JointState(np.array([s[0] for s in states]), np.array([s[1] for s in states]))

    def link_pose(self, name: str) -> Floats:
        """T_world_link of a link's URDF frame, shape (4, 4), mm."""
        state = pybullet.getLinkState(
            self.body, self.links[name], computeForwardKinematics=1, physicsClientId=self.client
        )
        return pose_to_mm(state[4], state[5])

    def flange_pose(self) -> Floats:
        """T_world_flange, shape (4, 4), mm."""
        return self.link_pose(FLANGE)


def load_arm(client: int, model: UrModel, tool: Tool, T_world_base: Floats | None = None) -> Arm:
    """Load the arm with holder and needle, its base fixed.

    Args:
        T_world_base: Pose of the controller's base, shape (4, 4), mm; None for the world's origin.

    Raises:
        InputError: There is no body of that model.
    """
    urdf = model_urdf(model)
    T_world_urdf = urdf.T_base_root if T_world_base is None else T_world_base @ urdf.T_base_root
    position, quaternion = pose_to_m(T_world_urdf)
    with tempfile.TemporaryDirectory() as folder:
        body = pybullet.loadURDF(
            str(write_arm_urdf(model, tool, Path(folder))),
            position,
            quaternion,
            useFixedBase=True,
            flags=pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER,
            physicsClientId=client,
        )
    joints, links, names = [], {"base": -1}, _names(urdf)
    for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, index, physicsClientId=client)
        links[names.get(link := info[12].decode(), f"{link} of the URDF")] = index
        if link == urdf.chain.flange:
            links[FLANGE] = index
        if info[2] == pybullet.JOINT_REVOLUTE:
            joints.append(index)
        pybullet.changeDynamics(
            body, index, linearDamping=0.0, angularDamping=0.0, jointDamping=0.0, physicsClientId=client
        )
    return Arm(client, body, tuple(joints), MappingProxyType(links), tuple(model.max_torques.tolist()))


def _names(urdf: ArmUrdf) -> dict[str, str]:
    """Names of the URDF's moving links, and of those that are added to them."""
    first = [body[0].link.name for body in urdf.chain.bodies]
    return {
        **{name: name for name in ("tool", "holder", "needle")},
        **dict(zip(first[1:], LINK_NAMES[1:], strict=True)),
    }
