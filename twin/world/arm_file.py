"""The arm as PyBullet reads it: its URDF with absolute addresses, holder and needle added."""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import collision_links, resolve_package, urdf_link_poses, urdf_path
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.twin.world.surface_file import write_obj
from puncture_twin.twin.world.units import to_m

HOLDER_DENSITY_KG_M3 = 1200.0
"""A printed holder, solid ABS or similar."""

NEEDLE_DENSITY_KG_M3 = 7900.0
"""Stainless steel, taken as solid."""


def write_arm_urdf(model: UrModel, tool: Tool, folder: Path) -> Path:
    """Write the arm with holder and needle as a URDF that PyBullet can load, and its collision pieces beside it.

    The collision bodies are the planner's own: convex pieces that contain each link.

    Args:
        model: The arm.
        tool: What the flange carries.
        folder: Where to write; the links' meshes stay where they are and are named by absolute paths.

    Returns:
        The URDF's path.

    Raises:
        InputError: There is no URDF of that model.
    """
    robot = ET.parse(urdf_path(model)).getroot()
    for mesh in robot.iter("mesh"):
        mesh.set("filename", str(resolve_package(mesh.get("filename", ""))))
    _replace_collisions(robot, model, folder)
    _weigh_frames(robot)
    if tool.holder_length_mm > 0:
        _add_cylinder(robot, "holder", 0.0, tool.holder_length_mm, tool.holder_diameter_mm, HOLDER_DENSITY_KG_M3)
    _add_cylinder(robot, "needle", tool.holder_length_mm, tool.shaft_mm, tool.needle_diameter_mm, NEEDLE_DENSITY_KG_M3)
    path = folder / "arm.urdf"
    ET.ElementTree(robot).write(path, encoding="utf-8", xml_declaration=True)
    return path


def _weigh_frames(robot: ET.Element) -> None:
    """Say of links without inertia, which are mere frames, that they weigh nothing: PyBullet would give them 1 kg."""
    for link in robot.findall("link"):
        if link.find("inertial") is None:
            nothing = '<mass value="0"/><inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
            link.append(ET.fromstring(f"<inertial>{nothing}</inertial>"))


def _replace_collisions(robot: ET.Element, model: UrModel, folder: Path) -> None:
    """Give every link the planner's convex pieces, moved from our link frames to the URDF's: a constant motion."""
    T_urdflink_link = np.linalg.inv(urdf_link_poses(model, np.zeros(6))) @ link_poses(model, np.zeros(6))
    elements = {element.get("name"): element for element in robot.findall("link")}
    for link, T in zip(collision_links(model), T_urdflink_link, strict=True):
        element = elements[f"{link.name}_link"]
        for collision in element.findall("collision"):
            element.remove(collision)
        for number, piece in enumerate(link.pieces):
            path = folder / f"{link.name}_{number}.obj"
            write_obj(piece.transformed(T), path)
            geometry = ET.SubElement(ET.SubElement(element, "collision"), "geometry")
            ET.SubElement(geometry, "mesh", filename=str(path))


def _add_cylinder(
    robot: ET.Element, name: str, start_mm: float, length_mm: float, diameter_mm: float, density: float
) -> None:
    """A cylinder on tool0's z axis, its link frame at its flange end."""
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
            f'<joint name="{name}_joint" type="fixed"><parent link="tool0"/><child link="{name}"/>'
            f'<origin xyz="0 0 {to_m(start_mm)}" rpy="0 0 0"/></joint>'
        )
    )
