"""The arm as PyBullet reads it: its URDF with absolute addresses, holder and needle added."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from copy import deepcopy
from pathlib import Path

import numpy as np
import trimesh

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import address_file, collision_links, model_urdf
from puncture_twin.planning.arm.tool import Tool, ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import ArmUrdf
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.mesh import joined
from puncture_twin.twin.world.client import to_m, write_obj

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
    """Write the arm with holder and needle as a URDF that PyBullet can load, and its collision pieces next to it.

    The collision bodies are the planner's own: convex pieces that contain each link.

    Returns:
        The URDF's path.

    Raises:
        InputError: There is no URDF of that model, or it does not say what a moving link weighs.
    """
    urdf = model_urdf(model)
    robot, flange = ET.fromstring(urdf.text), urdf.chain.flange
    _check_weights(urdf)
    _simplify(robot)
    _replace_shapes(robot, model, folder)
    if tool.holder_length_mm > 0:
        _add_cylinder(
            robot, flange, "holder", 0.0, tool.holder_length_mm, tool.holder_diameter_mm, HOLDER_DENSITY_KG_M3
        )
    span = tool.holder_length_mm, tool.shaft_mm
    _add_cylinder(robot, flange, "needle", *span, tool.needle_diameter_mm, NEEDLE_DENSITY_KG_M3)
    if tool.body is not None:
        _add_tool(robot, flange, tool.body, folder)
    path = folder / "arm.urdf"
    ET.ElementTree(robot).write(path, encoding="utf-8", xml_declaration=True)
    return path


def _check_weights(urdf: ArmUrdf) -> None:
    for members in urdf.chain.bodies[1:]:
        if not any(member.link.weighs for member in members):
            what = "it states no mass and inertia above 0, without which nothing can be simulated"
            here = f"{urdf.where}: link '{members[0].link.name}'"
            refuse(what, here, "an <inertial> of every moving link", "no_inertia")


def _simplify(robot: ET.Element) -> None:
    """Leave links, joints and shapes; what states no weight has none."""
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
    """The tool's convex pieces, all of the holder's material."""
    whole = joined(body.pieces)
    solid = trimesh.Trimesh(to_m(whole.vertices), whole.faces, process=False)
    solid.density = HOLDER_DENSITY_KG_M3
    weight, tensor = solid.mass_properties, solid.moment_inertia
    shapes = []
    for number, piece in enumerate(body.pieces):
        path = folder / f"tool_{number}.obj"
        write_obj(piece, path)
        shapes += [
            f'<{kind}><geometry><mesh filename="{path}"/></geometry></{kind}>' for kind in ("visual", "collision")
        ]
    xyz = " ".join(str(float(value)) for value in weight.center_mass)
    names = {"ixx": (0, 0), "iyy": (1, 1), "izz": (2, 2), "ixy": (0, 1), "ixz": (0, 2), "iyz": (1, 2)}
    inertia = " ".join(f'{name}="{tensor[at]}"' for name, at in names.items())
    robot.append(
        ET.fromstring(
            f'<link name="tool"><inertial><origin xyz="{xyz}" rpy="0 0 0"/><mass value="{weight.mass}"/>'
            f"<inertia {inertia}/></inertial>{''.join(shapes)}</link>"
        )
    )
    robot.append(
        ET.fromstring(f'<joint name="tool_joint" type="fixed"><parent link="{flange}"/><child link="tool"/></joint>')
    )


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
    robot.append(
        ET.fromstring(
            f'<link name="{name}"><inertial>{middle}<mass value="{mass}"/><inertia {inertia}/></inertial>'
            f"<visual>{shape}</visual><collision>{shape}</collision></link>"
        )
    )
    robot.append(
        ET.fromstring(
            f'<joint name="{name}_joint" type="fixed"><parent link="{flange}"/><child link="{name}"/>'
            f'<origin xyz="0 0 {to_m(start_mm)}" rpy="0 0 0"/></joint>'
        )
    )
