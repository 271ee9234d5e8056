"""The arm as PyBullet reads it (its URDF, holder and needle added), moved by its joint motors, and read back."""

import math
import tempfile
import xml.etree.ElementTree as ET
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import trimesh

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import LINK_NAMES, address_file, collision_links, model_urdf
from puncture_twin.planning.arm.tool import Tool, ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import FLANGE
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.mesh import joined
from puncture_twin.twin.world.client import pose_to_m, pose_to_mm, pybullet, to_m, write_obj

HOLDER_DENSITY_KG_M3 = 1200.0
"""A printed holder, solid ABS or similar."""
NEEDLE_DENSITY_KG_M3 = 7900.0
"""Stainless steel, taken as solid."""
KEPT_TAGS = ("visual", "collision", "inertial")
"""Elements of a link that are kept; other programs' additions would be taken for friction and the like."""
NO_WEIGHT = ET.fromstring(
    '<inertial><mass value="0"/><inertia ixx="0" ixy="0" ixz="0" iyy="0" iyz="0" izz="0"/></inertial>'
)
"""Inertia of a link that states none: PyBullet would take 1 kg, and 1 kg m^2 about each axis."""


def write_arm_urdf(model: UrModel, tool: Tool, folder: Path) -> Path:
    """Write the arm with holder and needle as a URDF that PyBullet can load, and its collision pieces next to it."""
    urdf = model_urdf(model)
    robot, flange = ET.fromstring(urdf.text), urdf.chain.flange
    what = "it states no mass and inertia above 0, without which nothing can be simulated"
    for members in urdf.chain.bodies[1:]:
        if not any(member.link.weighs for member in members):
            where = f"{urdf.where}: link '{members[0].link.name}'"
            refuse(what, where, "an <inertial> of every moving link", "no_inertia")
    _simplify(robot)
    _replace_shapes(robot, model, folder)
    holder_mm = tool.holder_length_mm
    if holder_mm > 0:
        _add_cylinder(robot, flange, "holder", 0.0, holder_mm, tool.holder_diameter_mm, HOLDER_DENSITY_KG_M3)
    _add_cylinder(robot, flange, "needle", holder_mm, tool.shaft_mm, tool.needle_diameter_mm, NEEDLE_DENSITY_KG_M3)
    if tool.body is not None:
        _add_tool(robot, flange, tool.body, folder)
    path = folder / "arm.urdf"
    ET.ElementTree(robot).write(path, encoding="utf-8", xml_declaration=True)
    return path


def _simplify(robot: ET.Element) -> None:
    for element in list(robot):
        if element.tag not in ("link", "joint"):
            robot.remove(element)
    for link in robot.findall("link"):
        for element in list(link):
            if element.tag not in KEPT_TAGS:
                link.remove(element)
        if link.find("inertial") is None:
            link.append(deepcopy(NO_WEIGHT))


def _replace_shapes(robot: ET.Element, model: UrModel, folder: Path) -> None:
    """Give every body the planner's convex pieces, moved from our link frames to the URDF's: a constant motion."""
    urdf = model_urdf(model)
    T_urdflink_link = np.linalg.inv(urdf.body_poses(np.zeros(6))) @ link_poses(model, np.zeros(6))
    elements = {element.get("name"): element for element in robot.findall("link")}
    kinds = ("collision",) if model.shipped else ("collision", "visual")  # what else may be drawn need not be readable
    for element in elements.values():
        for shape in [shape for kind in kinds for shape in element.findall(kind)]:
            element.remove(shape)
    for mesh in robot.iter("mesh"):
        mesh.set("filename", address_file(urdf, mesh.get("filename", "")))
    for link, members, T in zip(collision_links(model), urdf.chain.bodies, T_urdflink_link, strict=True):
        for number, piece in enumerate(link.pieces):
            path = folder / f"{link.name}_{number}.obj"
            write_obj(piece.transformed(T), path)
            for kind in kinds:
                geometry = ET.SubElement(ET.SubElement(elements[members[0].link.name], kind), "geometry")
                ET.SubElement(geometry, "mesh", filename=str(path))


def _add_tool(robot: ET.Element, flange: str, body: ToolBody, folder: Path) -> None:
    whole = joined(body.pieces)
    solid = trimesh.Trimesh(to_m(whole.vertices), whole.faces, process=False)
    solid.density = HOLDER_DENSITY_KG_M3
    weight, tensor = solid.mass_properties, solid.moment_inertia
    shapes = []
    for number, piece in enumerate(body.pieces):
        path = folder / f"tool_{number}.obj"
        write_obj(piece, path)
        shape = f'<geometry><mesh filename="{path}"/></geometry>'
        shapes.append(f"<visual>{shape}</visual><collision>{shape}</collision>")
    xyz = " ".join(str(float(value)) for value in weight.center_mass)
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    inertia = " ".join(f'{name}="{tensor[at]}"' for name, at in names.items())
    weighs = f'<origin xyz="{xyz}" rpy="0 0 0"/><mass value="{weight.mass}"/><inertia {inertia}/>'
    _append(robot, flange, "tool", f"<inertial>{weighs}</inertial>{''.join(shapes)}")


def _append(robot: ET.Element, flange: str, name: str, content: str, start: str = "") -> None:
    ends = f'<parent link="{flange}"/><child link="{name}"/>'
    robot.append(ET.fromstring(f'<link name="{name}">{content}</link>'))
    robot.append(ET.fromstring(f'<joint name="{name}_joint" type="fixed">{ends}{start}</joint>'))


def _add_cylinder(
    robot: ET.Element, flange: str, name: str, start_mm: float, length_mm: float, diameter_mm: float, density: float
) -> None:
    """A cylinder on the flange's z axis, its link frame at its flange end."""
    length, radius = float(to_m(length_mm)), float(to_m(diameter_mm / 2))
    mass = density * math.pi * radius**2 * length
    across, along = mass * (3 * radius**2 + length**2) / 12, mass * radius**2 / 2
    middle = f'<origin xyz="0 0 {length / 2}" rpy="0 0 0"/>'
    shape = f'{middle}<geometry><cylinder radius="{radius}" length="{length}"/></geometry>'
    inertia = f'ixx="{across}" iyy="{across}" izz="{along}" ixy="0" ixz="0" iyz="0"'
    weighs = f'<inertial>{middle}<mass value="{mass}"/><inertia {inertia}/></inertial>'
    bodies = f"<visual>{shape}</visual><collision>{shape}</collision>"
    _append(robot, flange, name, weighs + bodies, f'<origin xyz="0 0 {to_m(start_mm)}" rpy="0 0 0"/>')


POSITION_GAIN = 0.1
"""Fraction of a joint's position error that its motor takes back per step, Bullet's default: an error falls to 1/e
in 9.5 steps (40 ms), slow enough that starts and stops leave a visible trace, as a real controller's do."""
VELOCITY_GAIN = 1.0
"""Fraction of a joint's speed error that its motor takes back per step."""


class JointState(NamedTuple):
    """Angles (6,), rad, and speeds (6,), rad/s, of the joints."""

    q: Floats  # shape (6,), rad
    speed: Floats  # shape (6,), rad/s


@dataclass(frozen=True)
class Arm:
    """A loaded arm; joint angles are the true ones. Links by the names of `planning.collision.checker.BODY_NAMES`."""

    client: int
    body: int
    joints: tuple[int, ...]
    links: MappingProxyType[str, int]
    max_torque: tuple[float, ...]  # shape (6,), N m

    def link_name(self, index: int) -> str:
        """Name of a link."""
        return next(name for name, number in self.links.items() if number == index)

    def place(self, q: Floats) -> None:
        """Put the joints at q, shape (6,), rad, at rest, without physics."""
        for joint, angle in zip(self.joints, q.tolist(), strict=True):
            pybullet.resetJointState(self.body, joint, angle, 0.0, physicsClientId=self.client)

    def command(self, q: Floats, speed: Floats) -> None:
        """Set the motors' goal for the next steps: angles (6,) in rad, speeds (6,) in rad/s."""
        goals = {"targetPositions": q.tolist(), "targetVelocities": speed.tolist(), "forces": self.max_torque}
        gains = {"positionGains": [POSITION_GAIN] * 6, "velocityGains": [VELOCITY_GAIN] * 6}
        self._drive(pybullet.POSITION_CONTROL, **goals, **gains)

    def release(self) -> None:
        """Switch the motors off, for torques."""
        self._drive(pybullet.VELOCITY_CONTROL, forces=[0.0] * 6)

    def torque(self, torque_nm: Floats) -> None:
        """Torques (6,), N m, for the next step alone, cut to what the joints can give."""
        cut = np.clip(torque_nm, -np.array(self.max_torque), self.max_torque)
        self._drive(pybullet.TORQUE_CONTROL, forces=cut.tolist())

    def _drive(self, mode: int, **goals: object) -> None:
        pybullet.setJointMotorControlArray(self.body, self.joints, mode, **goals, physicsClientId=self.client)

    def push(self, link: str, force_n: Floats, point_m: Floats) -> None:
        """Push a link in the next step alone: a force (3,), N, at a point (3,), m, both in the world frame."""
        push = force_n.tolist(), point_m.tolist(), pybullet.WORLD_FRAME
        pybullet.applyExternalForce(self.body, self.links[link], *push, physicsClientId=self.client)

    def state(self) -> JointState:
        """Angles and speeds of the joints."""
        states = pybullet.getJointStates(self.body, self.joints, physicsClientId=self.client)
        return JointState(np.array([s[0] for s in states]), np.array([s[1] for s in states]))

    def link_pose(self, name: str) -> Floats:
        """T_world_link of a link's URDF frame, shape (4, 4), mm."""
        link = self.links[name]
        state = pybullet.getLinkState(self.body, link, computeForwardKinematics=1, physicsClientId=self.client)
        return pose_to_mm(state[4], state[5])

    def flange_pose(self) -> Floats:
        """T_world_flange, shape (4, 4), mm."""
        return self.link_pose(FLANGE)


def load_arm(client: int, model: UrModel, tool: Tool, T_world_base: Floats | None = None) -> Arm:
    """Load the arm with holder and needle, its base fixed: the controller's at T_world_base (4, 4), mm, or the origin.

    Raises:
        InputError: There is no body of that model.
    """
    urdf = model_urdf(model)
    T_world_urdf = urdf.T_base_root if T_world_base is None else T_world_base @ urdf.T_base_root
    position, quaternion = pose_to_m(T_world_urdf)
    flags = pybullet.URDF_USE_INERTIA_FROM_FILE | pybullet.URDF_USE_IMPLICIT_CYLINDER
    with tempfile.TemporaryDirectory() as folder:
        place = str(write_arm_urdf(model, tool, Path(folder))), position, quaternion
        body = pybullet.loadURDF(*place, useFixedBase=True, flags=flags, physicsClientId=client)
    added, first = ("tool", "holder", "needle"), [members[0].link.name for members in urdf.chain.bodies[1:]]
    names = dict(zip((*added, *first), (*added, *LINK_NAMES[1:]), strict=True))
    undamped = dict.fromkeys(("linearDamping", "angularDamping", "jointDamping"), 0.0)
    joints, links = [], {"base": -1}
    for index in range(pybullet.getNumJoints(body, physicsClientId=client)):
        info = pybullet.getJointInfo(body, index, physicsClientId=client)
        links[names.get(link := info[12].decode(), f"{link} of the URDF")] = index
        if link == urdf.chain.flange:
            links[FLANGE] = index
        if info[2] == pybullet.JOINT_REVOLUTE:
            joints.append(index)
        pybullet.changeDynamics(body, index, **undamped, physicsClientId=client)
    return Arm(client, body, tuple(joints), MappingProxyType(links), tuple(model.max_torques.tolist()))
