"""The arm's URDF with holder and needle on its flange, as ROS reads it: metres, z along the needle."""

from __future__ import annotations

from pathlib import Path
from xml.etree import ElementTree

from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.model_urdf import address_file, model_urdf
from puncture_twin.planning.arm.tool import Tool, ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.export.moveit.messages import M_PER_MM

TIP_FRAME = "needle_tip"


def urdf_with_needle(model: UrModel, tool: Tool) -> str:
    """The URDF's text; its meshes are named by absolute addresses of this installation.

    Raises:
        InputError: Nobody has the shapes of such a model.
    """
    urdf = model_urdf(model)
    robot, flange = ElementTree.fromstring(urdf.text), urdf.chain.flange
    for mesh in robot.iter("mesh"):
        file = address_file(urdf, mesh.get("filename", ""))
        mesh.set("filename", Path(file).as_uri() if Path(file).is_absolute() else file)
    start = tool.needle_length_mm - tool.shaft_mm
    if start > 0:
        _add_cylinder(robot, flange, "needle_holder", 0.0, start, tool.holder_diameter_mm)
    _add_cylinder(robot, flange, "needle", start, tool.shaft_mm, tool.needle_diameter_mm)
    if tool.body is not None:
        _add_mesh(robot, flange, tool.body)
    ElementTree.SubElement(robot, "link", name=TIP_FRAME)
    _fix(robot, flange, TIP_FRAME, tool.needle_length_mm)
    ElementTree.indent(robot, " ")
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_cylinder(
    robot: ElementTree.Element, flange: str, name: str, start_mm: float, length_mm: float, diameter_mm: float
) -> None:
    link = ElementTree.SubElement(robot, "link", name=name)
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(part, "origin", rpy="0 0 0", xyz=f"0 0 {_metres(length_mm / 2)}")
        shape = {"radius": _metres(diameter_mm / 2), "length": _metres(length_mm)}
        ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), "cylinder", shape)
    _fix(robot, flange, name, start_mm)


def _add_mesh(robot: ElementTree.Element, flange: str, body: ToolBody) -> None:
    """The tool's own file, scaled to metres."""
    link = ElementTree.SubElement(robot, "link", name="tool")
    T, scale = body.T_flange_file, f"{body.unit_mm * M_PER_MM:.9g}"
    rpy = " ".join(f"{angle:.12g}" for angle in Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(link, kind)
        ElementTree.SubElement(part, "origin", rpy=rpy, xyz=" ".join(_metres(value) for value in T[:3, 3]))
        mesh = {"filename": body.file.resolve().as_uri(), "scale": " ".join([scale] * 3)}
        ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), "mesh", mesh)
    _fix(robot, flange, "tool", 0.0)


def _fix(robot: ElementTree.Element, flange: str, name: str, at_mm: float) -> None:
    """Bolt a link to the flange."""
    joint = ElementTree.SubElement(robot, "joint", name=f"{flange}-{name}", type="fixed")
    ElementTree.SubElement(joint, "parent", link=flange)
    ElementTree.SubElement(joint, "child", link=name)
    ElementTree.SubElement(joint, "origin", rpy="0 0 0", xyz=f"0 0 {_metres(at_mm)}")


def _metres(mm: float) -> str:
    return f"{mm * M_PER_MM:.9f}"
