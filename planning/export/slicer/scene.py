"""A Slicer scene (.mrml): a node for each file, with how it is shown and where it is stored.

A transform node's file is read as the way from its parent; scalars are shown only where the display names a color node.
Source: Slicer, Libs/MRML/Core: vtkMRMLDisplayNode, vtkMRMLStorageNode, vtkMRMLTransformStorageNode.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal
from xml.etree import ElementTree

Kind = Literal["MarkupsLine", "MarkupsFiducial", "Model", "LinearTransform"]
_STORAGE = {
    "MarkupsLine": "MarkupsJsonStorage",
    "MarkupsFiducial": "MarkupsJsonStorage",
    "Model": "ModelStorage",
    "LinearTransform": "TransformStorage",
}
_DISPLAY = {"MarkupsLine": "MarkupsDisplay", "MarkupsFiducial": "MarkupsDisplay", "Model": "ModelDisplay"}
_SHOWN = {
    "ModelDisplay": {
        "visibility": "true",
        "opacity": "0.6",
        "scalarVisibility": "true",
        "activeScalarName": "window",
        "colorNodeID": "vtkMRMLColorTableNodeFileViridis.txt",
        "scalarRangeFlag": "UseData",
        "backfaceCulling": "false",
    },
    "MarkupsDisplay": {"visibility": "true", "color": "1 0.5 0"},
}


@dataclass(frozen=True)
class SceneNode:
    """What a scene shows.

    Attributes:
        kind: Of the node, by Slicer's name.
        name: As Slicer lists it.
        file: Where it is stored, beside the scene.
    """

    kind: Kind
    name: str
    file: str


def scene_text(nodes: Sequence[SceneNode]) -> str:
    """The scene's file."""
    root = ElementTree.Element("MRML", version="Slicer4.4.0", userTags="")
    count: Counter[str] = Counter()

    def add(tag: str, name: str, **more: str) -> str:
        count[tag] += 1
        number = f"vtkMRML{tag}Node{count[tag]}"
        ElementTree.SubElement(root, tag, {"id": number, "name": name, **more})
        return number

    for node in nodes:
        display = _DISPLAY.get(node.kind)
        refers = f"storage:{add(_STORAGE[node.kind], f'{node.name} storage', fileName=node.file)};"
        if display is not None:
            refers = f"display:{add(display, f'{node.name} display', **_SHOWN[display])};{refers}"
        add(node.kind, node.name, references=refers)
    ElementTree.indent(root)
    return f'<?xml version="1.0" encoding="UTF-8"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def scene_references(text: str) -> tuple[set[str], set[str]]:
    """The files that a scene names, and the nodes that it refers to but does not hold."""
    nodes = list(ElementTree.fromstring(text))
    present = {node.get("id", "") for node in nodes}
    parts = [part for node in nodes for part in node.get("references", "").split(";") if part]
    return {node.attrib["fileName"] for node in nodes if "fileName" in node.attrib}, {
        number for part in parts for number in part.partition(":")[2].split() if number not in present
    }
