"""A case and a chosen path as files for 3D Slicer, read back and found equal: scene, path, markers, entry area.

The entry area is the skin through which safe paths enter, as a surface between entries of neighbouring directions.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple
from xml.etree import ElementTree

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import AngleGrid
from puncture_twin.planning.formats.itk_transform import parse_transform, transform_text
from puncture_twin.planning.formats.meshes.vtp import read_vtp
from puncture_twin.planning.formats.points import parse_points
from puncture_twin.planning.geometry.rigid import inverse
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.placement import Placement
from puncture_twin.planning.search.candidates import Candidates

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


class SceneNode(NamedTuple):
    """One node of a scene, stored in a file next to the scene."""

    kind: Kind
    name: str
    file: str


def scene_text(nodes: Sequence[SceneNode]) -> str:
    """The scene as MRML text."""
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
    named = {number for part in parts for number in part.partition(":")[2].split()}
    return {node.attrib["fileName"] for node in nodes if "fileName" in node.attrib}, named - present


SLICER = "slicer"
"""Name of the format ``slicer``."""
PATH, MARKERS, AREA = "path.mrk.json", "markers.mrk.json", "safe_entry.vtp"
TRANSFORM, SCENE = "ct_to_robot.tfm", "scene.mrml"
NAMES = (PATH, MARKERS, AREA, TRANSFORM, SCENE)
SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/Schema/"
    "markups-schema-v1.0.3.json#"
)
_AXES = [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]


@dataclass(frozen=True, eq=False)
class SceneContent:
    """Content of the files for Slicer."""

    name: str
    entry_ct: Floats  # shape (3,), where the path enters the skin, mm
    area: EntryArea
    placement: Placement | None


class SlicerFiles(NamedTuple):
    """The files by their names, and notes for whoever opens them."""

    texts: Mapping[str, str]
    notes: tuple[str, ...]


def slicer_files(case: Case, drawn: SceneContent) -> SlicerFiles:
    """The files of a case and a path. Raises InputError: a case in a frame of its own, which Slicer has no name for."""
    if case.space is Space.LOCAL:
        refuse('space "local": Slicer knows LPS and RAS', case.path, "a case of a patient", "local_space")
    ends = np.stack([drawn.entry_ct, case.target_ct])
    texts = {PATH: markups_text("Line", drawn.name, ("entry", "target"), ends)}
    nodes, notes = [SceneNode("MarkupsLine", drawn.name, PATH)], []
    _read_points(texts[PATH], PATH, ("entry", "target"), ends)
    if drawn.placement is None:
        notes.append("the case does not place the robot: no transform, no markers")
    else:
        T_ct_base = inverse(drawn.placement.T_base_ct)
        texts[TRANSFORM] = transform_text(T_ct_base)
        nodes.append(SceneNode("LinearTransform", "ct_to_robot", TRANSFORM))
        notes.append(f"{TRANSFORM}: from base to CT in LPS, as Slicer saves a transform from the CT to the robot")
        _same(parse_transform(texts[TRANSFORM].encode(), Path(TRANSFORM)), T_ct_base, TRANSFORM)
    if drawn.placement is not None and drawn.placement.registration is not None:
        markers = drawn.placement.registration.markers
        texts[MARKERS] = markups_text("Fiducial", "markers", markers.names, markers.points_ct)
        nodes.append(SceneNode("MarkupsFiducial", "markers", MARKERS))
        _read_points(texts[MARKERS], MARKERS, markers.names, markers.points_ct)
    if len(drawn.area.faces):
        texts[AREA] = text = area_vtp(drawn.area)
        read, (window, cone) = read_vtp(text.encode(), AREA), area_scalars(text)
        if read.space is not Space.LPS:
            raise RuntimeError(f"{AREA} does not read back as LPS")
        written = (drawn.area.points_ct, drawn.area.faces, drawn.area.window, drawn.area.safe_cone_deg)
        for one, other in zip((read.vertices, read.faces, window, cone), written, strict=True):
            _same(one, other, AREA)
        nodes.append(SceneNode("Model", "safe entry", AREA))
    else:
        notes.append("no four neighbouring directions are safe: no entry area")
    texts[SCENE] = scene_text(nodes)
    files, missing = scene_references(texts[SCENE])
    if missing or not files <= texts.keys():
        raise RuntimeError(f"{SCENE} refers to {sorted(missing | files - texts.keys())}")
    return SlicerFiles(texts, tuple(notes))


def _read_points(text: str, name: str, labels: tuple[str, ...], points_ct: Floats) -> None:
    read = parse_points(text.encode(), Path(name), default_space=Space.LPS)
    if read.names != labels or read.space is not Space.LPS:
        raise RuntimeError(f"{name} reads back as {read.names}")
    _same(read.points, points_ct, name)


def _same(read: object, written: object, name: str) -> None:
    if not np.array_equal(np.asarray(read), np.asarray(written)):
        raise RuntimeError(f"{name} does not read back as it was written")


def markups_text(kind: Literal["Fiducial", "Line"], name: str, labels: Sequence[str], points_ct: Floats) -> str:
    """One markup of points (n, 3), LPS mm, as JSON text; a line has two."""
    alike = {"orientation": _AXES, "selected": True, "locked": True, "visibility": True, "positionStatus": "defined"}
    points = [
        {"id": str(number), "label": label, "position": position, **alike}
        for number, (label, position) in enumerate(zip(labels, points_ct.tolist(), strict=True), start=1)
    ]
    space = {"coordinateSystem": "LPS", "coordinateUnits": "mm"}
    fixed = {"locked": True, "fixedNumberOfControlPoints": True, "labelFormat": "%N-%d"}
    markup = {"type": kind, "name": name, **space, **fixed, "controlPoints": points}
    return json.dumps({"@schema": SCHEMA, "markups": [markup]}, indent=1, ensure_ascii=False) + "\n"


STEEPEST = 4.0
"""An edge longer than so many steps along the sphere is a jump between parts of the skin: 76 degrees from square."""


@dataclass(frozen=True, eq=False)
class EntryArea:
    """Triangles on the skin, each between three safe directions of one window."""

    points_ct: Floats  # shape (n, 3), LPS mm: where the paths enter
    faces: Ints  # shape (m, 3), indices of points
    window: Ints  # shape (n,), the number of each point's window
    safe_cone_deg: Floats  # shape (n,), degrees by which each direction may err all round; 0 where nothing is known


def entry_area(candidates: Candidates) -> EntryArea:
    """The area of a search; without triangles where no four neighbouring directions are safe."""
    windows = candidates.windows.of_row
    faces = np.zeros((0, 3), np.int64) if candidates.grid is None else _faces(candidates, candidates.grid, windows)
    rows, corners = np.unique(faces, return_inverse=True)
    cones = np.nan_to_num(np.degrees(candidates.safe_cone[rows]))
    return EntryArea(candidates.path.entry_ct[rows], corners.reshape(-1, 3).astype(np.int64), windows[rows], cones)


def _faces(candidates: Candidates, grid: AngleGrid, windows: Ints) -> Ints:
    """Two triangles for each cell of the grid whose four corners are safe, in one window and near to each other."""
    rows = np.arange(len(grid)).reshape(len(grid.theta), len(grid.beta))
    if grid.full_circle:
        rows = np.concatenate([rows, rows[:, :1]], axis=1)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    faces = faces[(windows[faces] > 0).all(axis=1) & (windows[faces] == windows[faces[:, :1]]).all(axis=1)]
    corners = candidates.path.entry_ct[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    span = np.sqrt(2.0) * grid.step * candidates.path.length[faces].max(axis=1)
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return np.asarray(faces[(edges <= STEEPEST * span) & (area > 0)])


def area_vtp(area: EntryArea) -> str:
    """The area as VTK XML PolyData in ASCII, with the field by which Slicer knows LPS."""
    form = {"version": "1.0", "byte_order": "LittleEndian", "header_type": "UInt64"}
    root = ElementTree.Element("VTKFile", {"type": "PolyData", **form})
    data = ElementTree.SubElement(root, "PolyData")
    fields = ElementTree.SubElement(data, "FieldData")
    space = ElementTree.SubElement(fields, "Array", type="String", Name="SPACE", NumberOfTuples="1", format="ascii")
    space.text = " ".join(str(code) for code in b"LPS\0")
    counts = {"NumberOfPoints": str(len(area.points_ct)), "NumberOfPolys": str(len(area.faces))}
    none = dict.fromkeys(("NumberOfVerts", "NumberOfLines", "NumberOfStrips"), "0")
    piece = ElementTree.SubElement(data, "Piece", counts | none)
    scalars = ElementTree.SubElement(piece, "PointData", Scalars="window")
    _array(scalars, "window", "Int64", area.window)
    _array(scalars, "safe_cone_deg", "Float64", area.safe_cone_deg)
    _array(ElementTree.SubElement(piece, "Points"), "Points", "Float64", area.points_ct, NumberOfComponents="3")
    polygons = ElementTree.SubElement(piece, "Polys")
    _array(polygons, "connectivity", "Int64", area.faces)
    _array(polygons, "offsets", "Int64", 3 * np.arange(1, len(area.faces) + 1))
    return f'<?xml version="1.0"?>\n{ElementTree.tostring(root, encoding="unicode")}\n'


def area_scalars(text: str) -> tuple[Ints, Floats]:
    """Windows and safe cones of the points of an area's file, as they were written."""
    arrays = ElementTree.fromstring(text).findall("PolyData/Piece/PointData/DataArray")
    window, cone = ((one.text or "").split() for one in arrays)
    return np.array(window, dtype=np.int64), np.array(cone, dtype=np.float64)


def _array(parent: ElementTree.Element, name: str, kind: str, values: Floats | Ints, **more: str) -> None:
    array = ElementTree.SubElement(parent, "DataArray", type=kind, Name=name, format="ascii")
    for key, value in more.items():
        array.set(key, value)
    array.text = " ".join(map(repr, values.ravel().tolist()))
