"""The arm's URDF with holder and needle on its flange, as ROS reads it: metres, z along the needle."""

from __future__ import annotations

from xml.etree import ElementTree

from puncture_twin.planning.arm.links import resolve_package, urdf_path
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.export.moveit.messages import FLANGE_FRAME, M_PER_MM

TIP_FRAME = "needle_tip"


def urdf_with_needle(model: UrModel, tool: Tool) -> str:
    """The URDF's text; its meshes are named by absolute addresses of this installation.

    Raises:
        InputError: Nobody has the shapes of such a model.
    """
    robot = ElementTree.parse(urdf_path(model)).getroot()
    for mesh in robot.iter("mesh"):
        mesh.set("filename", resolve_package(mesh.get("filename", "")).as_uri())
    start = tool.needle_length_mm - tool.shaft_mm
    if start > 0:
        _add_cylinder(robot, "needle_holder", 0.0, start, tool.holder_diameter_mm)
    _add_cylinder(robot, "needle", start, tool.shaft_mm, tool.needle_diameter_mm)
    ElementTree.SubElement(robot, "link", name=TIP_FRAME)
    _fix(robot, TIP_FRAME, tool.needle_length_mm)
    ElementTree.indent(robot, " ")
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_cylinder(robot: ElementTree.Element, name: str, start_mm: float, length_mm: float, diameter_mm: float) -> None:
    link = ElementTree.SubElement(robot, "link", name=name)
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(part, "origin", rpy="0 0 0", xyz=f"0 0 {_metres(length_mm / 2)}")
        shape = {"radius": _metres(diameter_mm / 2), "length": _metres(length_mm)}
        ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), "cylinder", shape)
    _fix(robot, name, start_mm)


def _fix(robot: ElementTree.Element, name: str, at_mm: float) -> None:
    """Bolt a link to the flange."""
    joint = ElementTree.SubElement(robot, "joint", name=f"{FLANGE_FRAME}-{name}", type="fixed")
    ElementTree.SubElement(joint, "parent", link=FLANGE_FRAME)
    ElementTree.SubElement(joint, "child", link=name)
    ElementTree.SubElement(joint, "origin", rpy="0 0 0", xyz=f"0 0 {_metres(at_mm)}")


def _metres(mm: float) -> str:
    return f"{mm * M_PER_MM:.9f}"
