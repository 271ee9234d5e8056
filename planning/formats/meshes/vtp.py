"""VTK XML PolyData (.vtp): the polygons of all pieces, with arrays of exactly the stated length.

Arrays in ASCII, inline base64, or appended (raw or base64), plain or zlib-compressed. Source: the VTK file formats
document (Kitware), "XML file formats"; the order of header and blocks from its section on binary data.
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.mesh_guard import MAX_TRIANGLES
from puncture_twin.planning.formats.meshes.vtk_arrays import Encoding, array_values
from puncture_twin.planning.formats.raw_mesh import MAX_VERTICES, RawMesh, join, refuse, triangulate
from puncture_twin.planning.geometry.spaces import Space

_ALLOWED = "a complete VTKFile of type PolyData whose arrays are as long as it states"
_APPENDED = re.compile(rb"<AppendedData[^>]*>")
_APPENDED_END = b"</AppendedData>"
_COMPRESSORS = {None: False, "vtkZLibDataCompressor": True}
_BYTE_ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
_SPACES = {b"LPS\0": Space.LPS, b"RAS\0": Space.RAS}
_HEADER_TYPES = {"UInt32": "u4", "UInt64": "u8"}


class _Split(NamedTuple):
    text: bytes
    appended: bytes


def read_vtp(data: bytes, where: str) -> RawMesh:
    """The polygons of a VTP file; polygons are cut into fans; points and lines in it carry no surface.

    Args:
        data: The whole file.
        where: Its name, for the error.

    Raises:
        InputError: If it is cut, an array is shorter or longer than stated, or it holds triangle strips.
    """
    split = _split_appended(data, where)
    if b"<!" in split.text.replace(b"<!--", b""):
        refuse("a document type or CDATA section", where, "VTK's own XML, without either")
    try:
        root = ElementTree.fromstring(split.text)
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # no XML, or an unknown text encoding
        raise InputError(f"XML cannot be read ({error})", where=where, allowed=_ALLOWED) from error
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        refuse(f"{root.tag} of type {root.get('type')}", where, _ALLOWED)
    encoding = _encoding(root, split.appended, where)
    pieces = root.findall("PolyData/Piece")
    parts = [_piece(piece, encoding, f"{where}, piece {i}") for i, piece in enumerate(pieces)]
    filled = [part for part in parts if part is not None]
    if not filled:
        refuse("no polygon in any piece", where, _ALLOWED)
    return join(filled)._replace(space=_space(root, encoding, where))


def _space(root: ElementTree.Element, encoding: Encoding, where: str) -> Space | None:
    """What Slicer writes of the axes: a field named SPACE with the letters LPS or RAS and the zero that ends them."""
    fields = root.findall("PolyData/FieldData/Array[@Name='SPACE']")
    if not fields:
        return None
    letters = ElementTree.Element("DataArray", {**fields[0].attrib, "type": "UInt8"})
    letters.text = fields[0].text
    text = array_values(letters, len(Space.LPS) + 1, encoding, f"{where}, field SPACE").tobytes()
    if text not in _SPACES or len(fields) > 1:
        refuse(f"field SPACE is {text!r}", where, "LPS or RAS, once")
    return _SPACES[text]


def _split_appended(data: bytes, where: str) -> _Split:
    """The XML without its appended data, which may be raw bytes, and those data from after the underscore."""
    start = _APPENDED.search(data)
    if start is None:
        return _Split(data, b"")
    end = data.rfind(_APPENDED_END)
    mark = data.find(b"_", start.end())
    if end < 0 or not start.end() <= mark < end or data[start.end() : mark].strip():
        refuse("AppendedData without its mark or end: the file is cut", where, _ALLOWED)
    return _Split(data[: start.end()] + data[end:], data[mark + 1 : end])


def _encoding(root: ElementTree.Element, appended: bytes, where: str) -> Encoding:
    section = root.find("AppendedData")
    appended_form = "raw" if section is None else section.get("encoding", "")
    order, header = root.get("byte_order", ""), root.get("header_type", "UInt32")
    compressor = root.get("compressor")
    if order not in _BYTE_ORDERS or header not in _HEADER_TYPES or appended_form not in ("raw", "base64"):
        what = f"byte_order {order!r}, header_type {header!r}, appended {appended_form!r}"
        refuse(what, where, "LittleEndian or BigEndian, UInt32 or UInt64, raw or base64")
    if compressor not in _COMPRESSORS:
        refuse(f"compressor {compressor!r}", where, "none or vtkZLibDataCompressor")
    return Encoding(
        byte_order=_BYTE_ORDERS[order],
        header_type=np.dtype(_BYTE_ORDERS[order] + _HEADER_TYPES[header]),
        compressed=_COMPRESSORS[compressor],
        appended=appended,
        appended_base64=appended_form == "base64",
    )


def _piece(piece: ElementTree.Element, encoding: Encoding, where: str) -> RawMesh | None:
    """One piece; None if it states no polygon at all, as empty pieces of a parallel writer do."""
    if _stated(piece, "NumberOfStrips", where):
        refuse("triangle strips", where, "polygons")
    n_polygons = _stated(piece, "NumberOfPolys", where)
    if n_polygons == 0:
        return None
    n_points = _stated(piece, "NumberOfPoints", where)
    if n_points > MAX_VERTICES or n_polygons > MAX_TRIANGLES:
        what = f"{n_points} points and {n_polygons} polygons"
        refuse(what, where, f"at most {MAX_VERTICES} points and {MAX_TRIANGLES} polygons")
    points = _values(piece, "Points/DataArray", 3 * n_points, encoding, where)
    components = _one(piece, "Points/DataArray", where).get("NumberOfComponents")
    if components != "3":
        refuse(f"points with {components} components", where, "3")
    offsets = _whole(piece, "offsets", n_polygons, encoding, where)
    if offsets.min() < 3 or offsets.max() > MAX_VERTICES or (np.diff(offsets) < 3).any():
        refuse("offsets do not rise by 3 or more per polygon", where, _ALLOWED)
    counts = np.diff(offsets, prepend=0)
    corners = _whole(piece, "connectivity", int(offsets[-1]), encoding, where)
    if corners.min() < 0 or corners.max() >= n_points:
        refuse(f"vertex indices {corners.min()} to {corners.max()}", where, f"0 to {n_points - 1}")
    return RawMesh(points.reshape(-1, 3).astype(np.float64), triangulate(corners, counts, where))


def _whole(piece: ElementTree.Element, name: str, count: int, encoding: Encoding, where: str) -> NDArray[np.int64]:
    values = _values(piece, f"Polys/DataArray[@Name='{name}']", count, encoding, where)
    if values.dtype.kind not in "iu":
        refuse(f"{name} of type {values.dtype}", where, "whole numbers")
    return values.astype(np.int64)


def _values(piece: ElementTree.Element, path: str, count: int, encoding: Encoding, where: str) -> NDArray[Any]:
    return array_values(_one(piece, path, where), count, encoding, f"{where}, {path}")


def _one(piece: ElementTree.Element, path: str, where: str) -> ElementTree.Element:
    found = piece.findall(path)
    if len(found) != 1:
        refuse(f"{len(found)} arrays {path}", where, "exactly one")
    return found[0]


def _stated(piece: ElementTree.Element, name: str, where: str) -> int:
    text = piece.get(name, "0")
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        refuse(f"{name} is {text[:20]!r}", where, "a whole number from 0")
    return int(text)
