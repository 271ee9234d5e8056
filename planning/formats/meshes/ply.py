"""PLY, ASCII and binary of both byte orders: as many vertices and faces as the header states, or an error.

The numbers of an ASCII file are turned into a binary body of doubles, so that one reader serves both forms.
Source: G. Turk, "The PLY Polygon File Format", 1994.
"""

import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse, refusing
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
_HEADER_END, _MAX_HEADER_BYTES = re.compile(rb"^[ \t]*end_header[ \t\r]*\n", re.MULTILINE), 100_000
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


class _Lists(NamedTuple):
    counts: NDArray[np.int64]
    values: NDArray[np.float64]


_Columns = dict[str, NDArray[Any] | _Lists]


def read_ply(data: bytes, where: str) -> RawMesh:
    """The faces of a PLY file; polygons are cut into fans, other elements are passed over.

    Raises InputError: header and data do not fit each other, or there are no faces.
    """
    elements, body = _split(data, where)
    cursor = _Cursor(body, where)
    vertices: NDArray[np.float64] | None = None
    faces: _Lists | None = None
    for element in elements:
        columns = cursor.take(element)
        if element.name == "vertex":
            axes = [columns.get(axis) for axis in "xyz"]
            if any(axis is None or isinstance(axis, _Lists) for axis in axes):
                refuse("vertices without x, y and z", where, _ALLOWED, "bad_header")
            vertices = np.stack([np.asarray(axis, dtype=np.float64) for axis in axes], axis=1)
        elif element.name == "face":
            if element.rows == 0:
                refuse("no face", where, "at least one face", "empty")
            faces = _faces(columns, where)
        elif element.name == "tristrips" and element.rows:
            refuse("triangle strips", where, "an element face with lists of vertex indices", "unsupported_feature")
    if rest := body[cursor.position :].strip():
        refuse(f"{len(rest)} bytes after the stated data", where, _ALLOWED, "size_mismatch")
    if vertices is None or faces is None:
        refuse("no element vertex, or no element face", where, _ALLOWED, "bad_header")
    return RawMesh(vertices, triangulate(faces.values.astype(np.int64), faces.counts, where))


def _split(data: bytes, where: str) -> tuple[list[_Element], bytes]:
    """The elements that the header states, and their data, in binary."""
    end = _HEADER_END.search(data, 0, _MAX_HEADER_BYTES)
    if not data.startswith(b"ply") or end is None:
        refuse("no complete header", where, _ALLOWED, "bad_header")
    lines = [line.decode("latin-1").split() for line in data[: end.start()].splitlines()]
    lines = [line for line in lines if line and line[0] not in ("comment", "obj_info")]
    formats = [line[1] for line in lines if line[0] == "format" and len(line) == 3]
    if lines[0] != ["ply"] or len(formats) != 1 or formats[0] not in _FORMATS:
        refuse(f"format {formats}", where, "one of " + ", ".join(_FORMATS), "unsupported_feature")
    is_ascii, body = formats[0] == "ascii", data[end.end() :]
    elements = _elements(lines, _FORMATS[formats[0]], is_ascii=is_ascii, where=where)
    if not is_ascii:
        return elements, body
    if not body.endswith(b"\n"):
        what = "the last line has no line end: the file may be truncated"
        refuse(what, where, "a line end after every line", "file_cut")
    tokens = token_array(decode_text(body, where).split(), where)
    with refusing(ValueError, "the data have no number", where, _ALLOWED, "not_a_number"):
        return elements, tokens.astype("<f8").tobytes()


def _elements(lines: list[list[str]], order: str, *, is_ascii: bool, where: str) -> list[_Element]:
    def dtype(kind: str) -> np.dtype[Any]:
        if kind not in _TYPES:
            refuse(f"property type {kind[:20]!r}", where, ", ".join(_TYPES), "unknown_type")
        return np.dtype("<f8" if is_ascii else order + _TYPES[kind])

    elements: list[_Element] = []
    for line in lines:
        match line:
            case ["element", name, rows] if rows.isascii() and rows.isdigit() and len(rows) <= 13:
                elements.append(_Element(name, min(int(rows), _MAX_ROWS), []))
            case ["property", "list", count_type, kind, name] if elements:
                count_dtype = dtype(count_type)
                elements[-1].properties.append(_Property(name, dtype(kind), count_dtype))
            case ["property", kind, name] if elements:
                elements[-1].properties.append(_Property(name, dtype(kind), None))
            case ["ply"] | ["format", _, _]:
                pass
            case _:
                refuse(f"header line {' '.join(line)[:60]!r}", where, _ALLOWED, "bad_header")
    names = [element.name for element in elements]
    for each in [names, *([p.name for p in element.properties] for element in elements)]:
        if len(set(each)) != len(each) or not each:
            refuse(f"header names {each} are repeated or missing", where, _ALLOWED, "bad_header")
    return elements


@dataclass
class _Cursor:
    """Reader that takes element after element from the body."""

    body: bytes
    where: str
    position: int = 0

    def take(self, element: _Element) -> _Columns:
        """The columns of an element, by property name."""
        smallest = sum((p.count_dtype or p.dtype).itemsize for p in element.properties)
        left = len(self.body) - self.position
        if smallest * element.rows > left:
            what = f"{element.rows} x {element.name} take at least {smallest * element.rows} bytes, but {left} are left"
            refuse(what, self.where, _ALLOWED, "file_cut")
        return (self._take_even(element) or self._take_row_by_row(element)) if element.rows else {}

    def _length(self, prop: _Property, position: int) -> tuple[int, int]:
        """Count of a property's numbers at a position, and where they start."""
        start, length = position, 1
        if prop.count_dtype is not None:
            start += prop.count_dtype.itemsize
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

    def _take_even(self, element: _Element) -> _Columns | None:
        """Read all rows at once, if each has lists as long as the first row's; None otherwise."""
        fields: list[Any] = []
        lengths, position = [], self.position
        for number, prop in enumerate(element.properties):
            length, start = self._length(prop, position)
            position = start + length * prop.dtype.itemsize
            lengths.append(length)
            if prop.count_dtype is not None:
                fields.append((f"n{number}", prop.count_dtype))
            fields.append((f"v{number}", prop.dtype, () if prop.count_dtype is None else (length,)))
        row = np.dtype(fields)
        if row.itemsize * element.rows > len(self.body) - self.position:
            return None
        table = np.frombuffer(self.body, row, element.rows, self.position)
        columns: _Columns = {}
        for number, (prop, length) in enumerate(zip(element.properties, lengths, strict=True)):
            values = table[f"v{number}"]
            if prop.count_dtype is None:
                columns[prop.name] = values
            elif (table[f"n{number}"] != length).any():
                return None
            else:
                counts = np.full(element.rows, length, dtype=np.int64)
                columns[prop.name] = _Lists(counts, values.astype(np.float64).reshape(-1))
        self.position += row.itemsize * element.rows
        return columns

    def _take_row_by_row(self, element: _Element) -> _Columns:
        chunks: list[list[NDArray[Any]]] = [[] for _ in element.properties]
        for _ in range(element.rows):
            for prop, column in zip(element.properties, chunks, strict=True):
                length, start = self._length(prop, self.position)
                column.append(np.frombuffer(self.body, prop.dtype, length, start))
                self.position = start + length * prop.dtype.itemsize
        columns: _Columns = {}
        for prop, column in zip(element.properties, chunks, strict=True):
            values = np.concatenate(column).astype(np.float64)
            counts = np.array([len(each) for each in column], dtype=np.int64)
            columns[prop.name] = values if prop.count_dtype is None else _Lists(counts, values)
        return columns


def _faces(columns: _Columns, where: str) -> _Lists:
    lists = [columns[name] for name in _INDEX_NAMES if name in columns]
    if len(lists) != 1 or not isinstance(lists[0], _Lists):
        refuse("faces without one list of vertex indices", where, " or ".join(_INDEX_NAMES), "bad_header")
    values = lists[0].values
    if not (np.isfinite(values) & (values == np.trunc(values)) & (np.abs(values) < _MAX_ROWS)).all():
        refuse("a vertex index is not a whole number", where, "indices from 0", "not_whole")
    return lists[0]
