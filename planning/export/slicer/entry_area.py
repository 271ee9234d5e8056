"""The skin through which safe paths enter, as a surface between the entries of neighbouring directions."""

from __future__ import annotations

from dataclasses import dataclass
from xml.etree import ElementTree

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.case.angle_grid import AngleGrid
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.selection.windows import find_windows

STEEPEST = 4.0
"""An edge longer than so many steps along the sphere is a jump between parts of the skin: 76 degrees from square."""


@dataclass(frozen=True, eq=False)
class EntryArea:
    """Triangles on the skin, each between three safe directions of one window.

    Attributes:
        points_ct: Shape (n, 3), LPS mm: where the paths enter.
        faces: Shape (m, 3), indices of points.
        window: Shape (n,), the number of each point's window.
        safe_cone_deg: Shape (n,), degrees by which each direction may err all round; 0 where nothing is known.
    """

    points_ct: Floats
    faces: Ints
    window: Ints
    safe_cone_deg: Floats


def entry_area(found: Candidates) -> EntryArea:
    """The area of a search; without triangles where no four neighbouring directions are safe."""
    windows = find_windows(found).of_row
    faces = np.zeros((0, 3), np.int64) if found.grid is None else _faces(found, found.grid, windows)
    rows, corners = np.unique(faces, return_inverse=True)
    cones = np.nan_to_num(np.degrees(found.safe_cone[rows]))
    return EntryArea(found.path.entry_ct[rows], corners.reshape(-1, 3).astype(np.int64), windows[rows], cones)


def _faces(found: Candidates, grid: AngleGrid, windows: Ints) -> Ints:
    """Two triangles for each cell of the grid whose four corners are safe, in one window and near to each other."""
    rows = np.arange(len(grid)).reshape(len(grid.theta), len(grid.beta))
    if grid.full_circle:
        rows = np.concatenate([rows, rows[:, :1]], axis=1)
    a, b, c, d = (part.ravel() for part in (rows[:-1, :-1], rows[1:, :-1], rows[1:, 1:], rows[:-1, 1:]))
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    whole = (windows[faces] > 0).all(axis=1) & (windows[faces] == windows[faces[:, :1]]).all(axis=1)
    faces = faces[whole]
    corners = found.path.entry_ct[faces]
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    span = np.sqrt(2.0) * grid.step * found.path.length[faces].max(axis=1)
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
    """Windows and safe cones of the points of such a file, as they were written."""
    arrays = ElementTree.fromstring(text).findall("PolyData/Piece/PointData/DataArray")
    window, cone = ((one.text or "").split() for one in arrays)
    return np.array(window, dtype=np.int64), np.array(cone, dtype=np.float64)


def _array(parent: ElementTree.Element, name: str, kind: str, values: Floats | Ints, **more: str) -> None:
    array = ElementTree.SubElement(parent, "DataArray", type=kind, Name=name, format="ascii")
    for key, value in more.items():
        array.set(key, value)
    array.text = " ".join(map(repr, values.ravel().tolist()))
