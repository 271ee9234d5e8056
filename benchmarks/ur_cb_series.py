"""Make the UR3, UR5 and UR10 of ``meshes/ur`` from example-robot-data's wheel: the same shapes without its 440 MB.

    python benchmarks/ur_cb_series.py example_robot_data-6.0.0-0-py3-none-any.whl meshes/ur

The collision meshes are copied byte by byte. Of the URDFs stay the seven links, their joints and ``tool0``, with every
number as it is; a link is drawn as its collision mesh.
"""

from __future__ import annotations

import argparse
import json
import zipfile
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from ur_e_series import LINKS, manifest_entry

ARMS = ("ur3", "ur5", "ur10")

ROBOTS = "cmeel.prefix/share/example-robot-data/robots/ur_description"
"""Where the wheel has them."""

KEPT = frozenset({"tool0", *(f"{link}_link" for link in LINKS)})
"""Links of the URDF; the others are a second root, a frame without a body, and a 1 cm box at the flange."""


def main() -> None:
    """Parse, make, write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("wheel", type=Path)
    parser.add_argument("out", type=Path)
    arguments = parser.parse_args()
    with zipfile.ZipFile(arguments.wheel) as wheel:
        entries = [entry for name in ARMS for entry in _arm(name, wheel, arguments.wheel.name, arguments.out)]
    path = arguments.out / "manifest.json"
    document = json.loads(path.read_text(encoding="utf-8"))
    made = {entry["path"] for entry in entries}
    document["made_by"] = ["benchmarks/ur_e_series.py", "benchmarks/ur_cb_series.py"]
    document["files"] = [entry for entry in document["files"] if entry["path"] not in made] + entries
    path.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")


def _arm(name: str, wheel: zipfile.ZipFile, package: str, out: Path) -> list[dict[str, Any]]:
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
    written = _urdf(name, ElementTree.fromstring(data))
    entries.append(manifest_entry(out, f"{name}.urdf", written, package, source, data))
    return entries


def _urdf(name: str, source: ElementTree.Element) -> bytes:
    """The package's URDF without what no one here reads; every mesh is ours."""
    robot = ElementTree.Element("robot", name=name)
    for element in source:
        ends = {end.get("link") for tag in ("parent", "child") for end in element.findall(tag)}
        if element.tag == "link" and element.get("name") in KEPT:
            robot.append(_link(name, element))
        if element.tag == "joint" and ends <= KEPT:
            robot.append(element)
    ElementTree.indent(robot, " ")
    return ElementTree.tostring(robot, encoding="utf-8", xml_declaration=True) + b"\n"


def _link(name: str, link: ElementTree.Element) -> ElementTree.Element:
    for mesh in link.iter("mesh"):
        file = mesh.get("filename").rpartition("/")[2].partition(".")[0]
        ours = next(ours for ours, theirs in LINKS.items() if theirs == file)
        mesh.set("filename", f"package://ur/{name}/{ours}.stl")
    return link


if __name__ == "__main__":
    main()
