"""PLY, ASCII and binary of both byte orders: as many vertices and faces as the header states, or an error; and written.

The numbers of an ASCII file are turned into a binary body of doubles, so that one reader serves both forms.
Source: G. Turk, "The PLY Polygon File Format", 1994.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.formats.guard import RawMesh, token_array, triangulate

_TYPES = {
    **dict.fromkeys(("char", "int8"), "i1"),
    **dict.fromkeys(("uchar", "uint8"), "u1"),
    **dict.fromkeys(("short", "int16"), "i2"),
    **dict.fromkeys(("ushort", "uint16"), "u2"),
    **dict.fromkeys(("int", "int32"), "i4"),
    **dict.fromkeys(("uint", "uint32"), "u4"),
    **dict.fromkeys(("float", "float32"), "f4"),
    **dict.fromkeys(("double", "float64"), "f8"),
}
_FORMATS = {"ascii": "<", "binary_little_endian": "<", "binary_big_endian": ">"}
_INDEX_NAMES = ("vertex_indices", "vertex_index")
_MAX_HEADER_BYTES = 100_000
_MAX_ROWS = 2**40
"""Beyond any file; keeps the size arithmetic exact."""
_ALLOWED = "a PLY header (ply, format, element, property, end_header) and exactly the data that it states"


class _Property(NamedTuple):
    name: str
    dtype: np.dtype[Any]
    count_dtype: np.dtype[Any] | None  # None: a single number; else a list, and this is the type of its length


class _Element(NamedTuple):
    name: str
    rows: int
    properties: list[_Property]


class _Header(NamedTuple):
    is_ascii: bool
    elements: list[_Element]
    body_start: int


class _Lists(NamedTuple):
    counts: NDArray[np.int64]
    values: NDArray[np.float64]


def read_ply(data: bytes, where: str) -> RawMesh:
    """The faces of a PLY file; polygons are cut into fans, other elements are passed over.

    Raises:
        InputError: If header and data do not fit each other, or there are no faces.
    """
    header = _header(data, where)
    body = data[header.body_start :]
    cursor = _Cursor(_ascii_as_doubles(body, where) if header.is_ascii else body, where)
    vertices: NDArray[np.float64] | None = None
    faces: _Lists | None = None
    for element in header.elements:
        columns = cursor.take(element)
        if element.name == "vertex":
            vertices = _vertices(columns, where)
        elif element.name == "face":
            if element.rows == 0:
                refuse("no face", where, "at least one face", "empty")
            faces = _faces(columns, where)
        elif element.name == "tristrips" and element.rows:
            refuse("triangle strips", where, "an element face with lists of vertex indices", "unsupported_feature")
    cursor.check_end()
    if vertices is None or faces is None:
        refuse("no element vertex, or no element face", where, _ALLOWED, "bad_header")
    return RawMesh(vertices, triangulate(faces.values.astype(np.int64), faces.counts, where))


def _header(data: bytes, where: str) -> _Header:
    end = data.find(b"end_header", 0, _MAX_HEADER_BYTES)
    line_end = data.find(b"\n", end)
    if not data.startswith(b"ply") or end < 0 or line_end < 0:
        refuse("no complete header", where, _ALLOWED, "bad_header")
    lines = [line.split() for line in data[:end].decode("latin-1").splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    formats = [line[1] for line in lines if line[0] == "format" and len(line) == 3]
    if lines[0] != ["ply"] or len(formats) != 1 or formats[0] not in _FORMATS:
        refuse(f"format {formats}", where, "one of " + ", ".join(_FORMATS), "unsupported_feature")
    elements = _elements(lines, _FORMATS[formats[0]], is_ascii=formats[0] == "ascii", where=where)
    return _Header(formats[0] == "ascii", elements, line_end + 1)


def _elements(lines: list[list[str]], order: str, *, is_ascii: bool, where: str) -> list[_Element]:
    elements: list[_Element] = []
    for line in lines:
        match line:
            case ["element", name, rows] if rows.isascii() and rows.isdigit() and len(rows) <= 13:
                elements.append(_Element(name, min(int(rows), _MAX_ROWS), []))
            case ["property", "list", count_type, kind, name] if elements:
                count_dtype = _dtype(count_type, order, is_ascii, where)
                elements[-1].properties.append(_Property(name, _dtype(kind, order, is_ascii, where), count_dtype))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(_Property(name, _dtype(kind, order, is_ascii, where), None))
            case ["ply"] | ["format", _, _]:
                pass
            case _:
                refuse(f"header line {' '.join(line)[:60]!r}", where, _ALLOWED, "bad_header")
    names = [element.name for element in elements]
    for each in [names, *([p.name for p in element.properties] for element in elements)]:
        if len(set(each)) != len(each) or not each:
            refuse(f"header names {each} are repeated or missing", where, _ALLOWED, "bad_header")
    return elements


def _dtype(kind: str, order: str, is_ascii: bool, where: str) -> np.dtype[Any]:
    if kind not in _TYPES:
        refuse(f"property type {kind[:20]!r}", where, ", ".join(_TYPES), "unknown_type")
    return np.dtype("<f8" if is_ascii else order + _TYPES[kind])


def _ascii_as_doubles(body: bytes, where: str) -> bytes:
    if not body.endswith(b"\n"):
        refuse(
            "the last line has no line end: the file may be truncated", where, "a line end after every line", "file_cut"
        )
    tokens = token_array(decode_text(body, where).split(), where)
    try:
        return tokens.astype("<f8").tobytes()
    except ValueError as error:
        what = f"the data have no number ({error})"
        raise InputError(what, where=where, allowed=_ALLOWED, code="not_a_number") from error


@dataclass
class _Cursor:
    """Takes element after element from the body."""

    body: bytes
    where: str
    position: int = 0

    def take(self, element: _Element) -> dict[str, NDArray[Any] | _Lists]:
        """The columns of an element, by property name."""
        smallest = sum((p.count_dtype or p.dtype).itemsize for p in element.properties)
        left = len(self.body) - self.position
        if smallest * element.rows > left:
            what = f"{element.rows} x {element.name} take at least {smallest * element.rows} bytes, but {left} are left"
            refuse(what, self.where, _ALLOWED, "file_cut")
        if element.rows == 0:
            return {}
        lengths = self._first_row(element)
        even = self._take_even(element, lengths)
        return even if even is not None else self._take_row_by_row(element)

    def check_end(self) -> None:
        """Refuse anything but white space behind the last element."""
        rest = self.body[self.position :].strip()
        if rest:
            refuse(f"{len(rest)} bytes after the stated data", self.where, _ALLOWED, "size_mismatch")

    def _first_row(self, element: _Element) -> list[int]:
        position, lengths = self.position, []
        for prop in element.properties:
            length, position = self._length(prop, position)
            lengths.append(length)
            position += length * prop.dtype.itemsize
        return lengths

    def _length(self, prop: _Property, position: int) -> tuple[int, int]:
        """How many numbers a property has at a position, and where they start."""
        if prop.count_dtype is None:
            start, length = position, 1
        else:
            start = position + prop.count_dtype.itemsize
            if start > len(self.body):
                refuse(f"data ends inside {prop.name}", self.where, _ALLOWED, "file_cut")
            stated = np.frombuffer(self.body, prop.count_dtype, 1, position)[0]
            if not 0 <= stated <= len(self.body) or stated != int(stated):
                what = f"{prop.name} of length {stated}"
                refuse(what, self.where, "whole lengths from 0, inside the file", "out_of_range")
            length = int(stated)
        if start + length * prop.dtype.itemsize > len(self.body):
            refuse(f"data ends inside {prop.name}", self.where, _ALLOWED, "file_cut")
        return length, start

    def _take_even(self, element: _Element, lengths: list[int]) -> dict[str, NDArray[Any] | _Lists] | None:
        """Read all rows at once, if each has lists as long as the first row's; None otherwise."""
        fields: list[tuple[str, Any]] = []
        for number, (prop, length) in enumerate(zip(element.properties, lengths, strict=True)):
            if prop.count_dtype is None:
                fields.append((f"v{number}", prop.dtype))
            else:
                fields += [(f"n{number}", prop.count_dtype), (f"v{number}", prop.dtype, (length,))]  # type: ignore[list-item]  # numpy takes both forms
        row = np.dtype(fields)
        if row.itemsize * element.rows > len(self.body) - self.position:
            return None
        table = np.frombuffer(self.body, row, element.rows, self.position)
        columns: dict[str, NDArray[Any] | _Lists] = {}
        for number, (prop, length) in enumerate(zip(element.properties, lengths, strict=True)):
            if prop.count_dtype is None:
                columns[prop.name] = table[f"v{number}"]
            elif (table[f"n{number}"] != length).any():
                return None
            else:
                counts = np.full(element.rows, length, dtype=np.int64)
                columns[prop.name] = _Lists(counts, table[f"v{number}"].astype(np.float64).reshape(-1))
        self.position += row.itemsize * element.rows
        return columns

    def _take_row_by_row(self, element: _Element) -> dict[str, NDArray[Any] | _Lists]:
        chunks: list[list[NDArray[Any]]] = [[] for _ in element.properties]
        for _ in range(element.rows):
            for prop, column in zip(element.properties, chunks, strict=True):
                length, start = self._length(prop, self.position)
                column.append(np.frombuffer(self.body, prop.dtype, length, start))
                self.position = start + length * prop.dtype.itemsize
        columns: dict[str, NDArray[Any] | _Lists] = {}
        for prop, column in zip(element.properties, chunks, strict=True):
            values = np.concatenate(column).astype(np.float64)
            counts = np.array([len(each) for each in column], dtype=np.int64)
            columns[prop.name] = values if prop.count_dtype is None else _Lists(counts, values)
        return columns


def _vertices(columns: dict[str, NDArray[Any] | _Lists], where: str) -> NDArray[np.float64]:
    axes = [columns.get(axis) for axis in "xyz"]
    if any(axis is None or isinstance(axis, _Lists) for axis in axes):
        refuse("vertices without x, y and z", where, _ALLOWED, "bad_header")
    return np.stack([np.asarray(axis, dtype=np.float64) for axis in axes], axis=1)


def _faces(columns: dict[str, NDArray[Any] | _Lists], where: str) -> _Lists:
    lists = [columns[name] for name in _INDEX_NAMES if name in columns]
    if len(lists) != 1 or not isinstance(lists[0], _Lists):
        refuse("faces without one list of vertex indices", where, " or ".join(_INDEX_NAMES), "bad_header")
    values = lists[0].values
    if not (np.isfinite(values) & (values == np.trunc(values)) & (np.abs(values) < _MAX_ROWS)).all():
        refuse("a vertex index is not a whole number", where, "indices from 0", "not_whole")
    return lists[0]
