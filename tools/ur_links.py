"""Make ``meshes/ur`` from three wheels: link shapes as STL, a small URDF for each arm, and their manifest.

    python -m tools.ur_links AIRO COMPAS EXAMPLE meshes/ur

airo_models-0.0.12-py3-none-any.whl has the UR3e and UR5e, compas_fab-2.0.1-py3-none-any.whl the UR10e. Their shapes
are the collision meshes as they ship, triangle by triangle; origins, masses and joints are the numbers of the packages'
own URDFs, the turned ``base_link_inertia`` taken together with ``base_link``, ``flange`` with ``tool0``.

example_robot_data-6.0.0-0-py3-none-any.whl has the UR3, UR5 and UR10: the same shapes without its 440 MB. The collision
meshes are copied byte by byte. Of the URDFs stay the seven links, their joints and ``tool0``, with every number as it
is; a link is drawn as its collision mesh.
"""

from __future__ import annotations

import argparse
import hashlib
import io
import json
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import trimesh

LINKS = {
    "base": "base",
    "shoulder": "shoulder",
    "upper_arm": "upperarm",
    "forearm": "forearm",
    "wrist_1": "wrist1",
    "wrist_2": "wrist2",
    "wrist_3": "wrist3",
}
"""Link to the packages' name of its mesh file."""

JOINTS = (
    *("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint"),
    "wrist_3_joint",
)

ARMS = {
    "ur3e": (0, "airo_models/arms/ur3e/ur3e.urdf", "airo_models/arms/ur3e/collision/{}.obj"),
    "ur5e": (0, "airo_models/arms/ur5e/ur5e.urdf", "airo_models/arms/ur5e/collision/{}.obj"),
    "ur10e": (
        1,
        "compas_fab/data/robot_library/ur10e_robot/urdf/robot_description.urdf",
        "compas_fab/data/robot_library/ur10e_robot/ur_description/meshes/ur10e/collision/{}.stl",
    ),
}
"""Arm to its wheel, URDF and meshes."""

CB_ARMS = ("ur3", "ur5", "ur10")

ROBOTS = "cmeel.prefix/share/example-robot-data/robots/ur_description"
"""Where the wheel has them."""

KEPT = frozenset({"tool0", *(f"{link}_link" for link in LINKS)})
"""Links of those URDFs; the others are a second root, a frame without a body, and a 1 cm box at the flange."""

UNBOUND = 'xmlns:drake="https://drake.mit.edu"'
"""The URDFs of airo-models use this prefix and do not declare it."""


def main() -> None:
    """Parse, make, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name in ("airo", "compas", "example", "out"):
        parser.add_argument(name, type=Path)
    arguments = parser.parse_args()
    wheels, files = (arguments.airo, arguments.compas), []
    for name, (which, urdf, mesh) in ARMS.items():
        with zipfile.ZipFile(wheels[which]) as wheel:
            files += _e_series(name, wheel, wheels[which].name, urdf, mesh, arguments.out)
    with zipfile.ZipFile(arguments.example) as wheel:
        for name in CB_ARMS:
            files += _cb_series(name, wheel, arguments.example.name, arguments.out)
    document = {"schema": 1, "made_by": "tools/ur_links.py", "licence": "LICENSE", "files": files}
    (arguments.out / "manifest.json").write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _e_series(name: str, wheel: zipfile.ZipFile, package: str, urdf: str, mesh: str, out: Path) -> list[dict[str, Any]]:
    """Write one arm's files; their entries."""
    (out / name).mkdir(parents=True, exist_ok=True)
    entries = []
    for link, file in LINKS.items():
        data = wheel.read(mesh.format(file))
        shape = trimesh.load_mesh(io.BytesIO(data), file_type=mesh.rsplit(".", 1)[1], process=False)
        written = trimesh.exchange.stl.export_stl(shape)
        entries.append(manifest_entry(out, f"{name}/{link}.stl", written, package, mesh.format(file), data))
        entries[-1]["triangles"] = len(shape.faces)
    data = wheel.read(urdf)
    written = _urdf(name, ElementTree.fromstring(data.decode().replace("<robot ", f"<robot {UNBOUND} ", 1)))
    entries.append(manifest_entry(out, f"{name}.urdf", written, package, urdf, data))
    return entries


def manifest_entry(out: Path, path: str, written: bytes, package: str, source: str, data: bytes) -> dict[str, Any]:
    """Write one file; where it comes from, and both hashes."""
    (out / path).write_bytes(written)
    return {
        "path": path,
        "unit": "m",
        "package": package,
        "source": source,
        "source_sha256": hashlib.sha256(data).hexdigest(),
        "bytes": len(written),
        "sha256": hashlib.sha256(written).hexdigest(),
    }


def _urdf(name: str, source: ElementTree.Element) -> bytes:
    """The package's numbers as a URDF of seven links, six joints and ``tool0``."""
    links = {link.get("name"): link for link in source.findall("link")}
    joints = {joint.get("name"): joint for joint in source.findall("joint")}
    robot = ElementTree.Element("robot", name=name)
    for link in LINKS:
        _link(robot, name, link, links["base_link_inertia" if link == "base" else f"{link}_link"])
    for at, joint in enumerate(JOINTS):
        _joint(robot, joints[joint], at)
    ElementTree.SubElement(robot, "link", name="tool0")
    fixed = ElementTree.SubElement(robot, "joint", name="wrist_3_link-tool0_fixed_joint", type="fixed")
    ElementTree.SubElement(fixed, "origin", rpy="0 0 0", xyz="0 0 0")
    ElementTree.SubElement(fixed, "parent", link="wrist_3_link")
    ElementTree.SubElement(fixed, "child", link="tool0")
    ElementTree.indent(robot, " ")
    return ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n"


def _link(robot: ElementTree.Element, name: str, link: str, source: ElementTree.Element) -> None:
    """One link with its mesh, twice, and its mass. The base's two half turns cancel."""
    element = ElementTree.SubElement(robot, "link", name=f"{link}_link")
    origin = {"rpy": "0 0 0", "xyz": "0 0 0"} if link == "base" else _origin(source.find("visual"))
    for kind in ("visual", "collision"):
        part = ElementTree.SubElement(element, kind)
        ElementTree.SubElement(part, "origin", origin)
        geometry = ElementTree.SubElement(part, "geometry")
        ElementTree.SubElement(geometry, "mesh", filename=f"package://ur/{name}/{link}.stl")
    inertial, known = ElementTree.SubElement(element, "inertial"), source.find("inertial")
    ElementTree.SubElement(inertial, "mass", value=known.find("mass").get("value"))
    ElementTree.SubElement(inertial, "origin", _origin(known))
    ElementTree.SubElement(inertial, "inertia", dict(sorted(known.find("inertia").attrib.items())))


def _joint(robot: ElementTree.Element, source: ElementTree.Element, at: int) -> None:
    """One joint. The first starts from ``base_link_inertia``, half a turn from ``base_link``."""
    names = [f"{link}_link" for link in LINKS]
    joint = ElementTree.SubElement(robot, "joint", name=source.get("name"), type="revolute")
    origin = _origin(source)
    ElementTree.SubElement(joint, "origin", {**origin, "rpy": f"0 0 {np.pi!r}"} if at == 0 else origin)
    ElementTree.SubElement(joint, "parent", link=names[at])
    ElementTree.SubElement(joint, "child", link=names[at + 1])
    ElementTree.SubElement(joint, "axis", xyz="0 0 1")
    limit = source.find("limit").attrib
    ElementTree.SubElement(joint, "limit", {key: limit[key] for key in ("effort", "lower", "upper", "velocity")})
    ElementTree.SubElement(joint, "dynamics", damping="0", friction="0")


def _origin(element: ElementTree.Element) -> dict[str, str]:
    origin = element.find("origin")
    return {key: origin.get(key) for key in ("rpy", "xyz")}


def _cb_series(name: str, wheel: zipfile.ZipFile, package: str, out: Path) -> list[dict[str, Any]]:
    """Write one arm's files; their entries."""
    (out / name).mkdir(parents=True, exist_ok=True)
    entries = []
    for link, file in LINKS.items():
        source = f"{ROBOTS}/meshes/{name}/collision/{file}.stl"
        data = wheel.read(source)
        entries.append(manifest_entry(out, f"{name}/{link}.stl", data, package, source, data))
        entries[-1]["triangles"] = int.from_bytes(data[80:84], "little")
    source = f"{ROBOTS}/urdf/{name}_robot.urdf"
    data = wheel.read(source)
    written = _cb_urdf(name, ElementTree.fromstring(data))
    entries.append(manifest_entry(out, f"{name}.urdf", written, package, source, data))
    return entries


def _cb_urdf(name: str, source: ElementTree.Element) -> bytes:
    """The package's URDF without what no one here reads; every mesh is ours."""
    robot = ElementTree.Element("robot", name=name)
    for element in source:
        ends = {end.get("link") for tag in ("parent", "child") for end in element.findall(tag)}
        if element.tag == "link" and element.get("name") in KEPT:
            robot.append(_cb_link(name, element))
        if element.tag == "joint" and ends <= KEPT:
            robot.append(element)
    ElementTree.indent(robot, " ")
    return ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n"


def _cb_link(name: str, link: ElementTree.Element) -> ElementTree.Element:
    for mesh in link.iter("mesh"):
        file = mesh.get("filename").rpartition("/")[2].partition(".")[0]
        ours = next(ours for ours, theirs in LINKS.items() if theirs == file)
        mesh.set("filename", f"package://ur/{name}/{ours}.stl")
    return link


if __name__ == "__main__":
    main()
