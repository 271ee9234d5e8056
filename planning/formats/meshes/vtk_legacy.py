"""Legacy VTK files (.vtk) of type POLYDATA, ASCII and binary: as many points and polygons as they state, or an error.

Slicer saves models so (file version 4.2); VTK 9 writes version 5.1, whose cells are offsets and connectivity. Binary
numbers are big endian. Source: VTK file formats (Kitware), "Simple legacy formats".
"""

from __future__ import annotations

import re
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.formats.guard import MAX_TOKEN_LENGTH, MAX_TRIANGLES, MAX_VERTICES, RawMesh, triangulate

_ALLOWED = "a legacy VTK file, ASCII or BINARY, of DATASET POLYDATA whose points and polygons are as many as it states"
_VERSION = re.compile(rb"# vtk DataFile Version ([1-5])\.\d\s*")
_TYPES = {
    "unsigned_char": ">u1", "char": ">i1", "signed_char": ">i1", "unsigned_short": ">u2", "short": ">i2",
    "unsigned_int": ">u4", "int": ">i4", "unsigned_long": ">u8", "long": ">i8", "vtkidtype": ">i4",
    "vtktypeint64": ">i8", "vtktypeuint64": ">u8", "float": ">f4", "double": ">f8",
}  # fmt: skip
"""Number types by their names in lower case, as stored in a binary file."""
_SURFACES = ("POLYGONS", "TRIANGLE_STRIPS")
_CELLS = ("VERTICES", "LINES", *_SURFACES)
_NOTES = ("METADATA", "INFORMATION")
_OFFSETS_SINCE = 5
"""The major version from which on cells are offsets and connectivity."""
_DATA = ("POINT_DATA", "CELL_DATA")
"""Keywords that end the surface: numbers about it follow, which are not read."""


class _Polygons(NamedTuple):
    """Corners of all polygons, one after the other, and how many each has."""

    corners: NDArray[np.int64]
    counts: NDArray[np.int64]


def read_vtk(data: bytes, where: str) -> RawMesh:
    """The polygons and triangle strips of a legacy VTK file; polygons become fans; lines and lone points no surface.

    Raises InputError: it is cut, of another kind, or has fewer numbers than it states.
    """
    cursor = _Cursor(data, where)
    version = _VERSION.fullmatch(cursor.line())
    cursor.line()  # the title, which anything may be
    form = cursor.line().strip().upper()
    if version is None or form not in (b"ASCII", b"BINARY"):
        refuse("not a legacy VTK file", where, _ALLOWED, "wrong_format")
    cursor.is_ascii = form == b"ASCII"
    if cursor.words() != ["DATASET", "POLYDATA"]:
        refuse("the data set is not POLYDATA", where, _ALLOWED, "wrong_format")
    offsets = int(version[1]) >= _OFFSETS_SINCE
    points: NDArray[np.float64] | None = None
    surfaces: dict[str, _Polygons] = {}
    while (words := cursor.words()) and words[0] not in _DATA:
        key = words[0]
        if key == "POINTS" and points is None:
            count, kind = _count(words, 1, MAX_VERTICES, where), words[2] if len(words) == 3 else ""
            points = cursor.numbers(3 * count, kind).astype(np.float64).reshape(-1, 3)
        elif key in _CELLS:
            cells = _cells(cursor, words, offsets=offsets, where=where)
            if key in _SURFACES and len(cells.counts):
                surfaces.setdefault(key, cells)
        elif key == "FIELD":
            _pass_over(cursor, words, where)
        else:
            refuse(f"unknown line {' '.join(words)[:60]!r}", where, _ALLOWED, "unknown_line")
    if points is None or not surfaces:
        refuse("no points or no polygons: the file is truncated, or has no surface", where, _ALLOWED, "empty")
    corners = np.concatenate([cells.corners for cells in surfaces.values()])
    if corners.min() < 0 or corners.max() >= len(points):
        what = f"vertex indices {corners.min()} to {corners.max()}"
        refuse(what, where, f"0 to {len(points) - 1}", "index_out_of_range")
    parts = [triangulate(*cells, where, strips=key != _SURFACES[0]) for key, cells in surfaces.items()]
    return RawMesh(points, np.concatenate(parts))


def _cells(cursor: _Cursor, words: list[str], *, offsets: bool, where: str) -> _Polygons:
    first, size = _count(words, 1, MAX_TRIANGLES, where), _count(words, 2, 4 * MAX_TRIANGLES, where)
    if offsets:
        ends = cursor.named_numbers("OFFSETS", first).astype(np.int64)
        corners = cursor.named_numbers("CONNECTIVITY", size).astype(np.int64)
        if first == 0:
            return _Polygons(corners[:0], corners[:0])
        if ends[0] != 0 or ends[-1] != size or (np.diff(ends) < 1).any():
            refuse("offsets do not rise from 0 to the number of corners", where, _ALLOWED, "bad_offsets")
        return _Polygons(corners, np.diff(ends))
    table = cursor.numbers(size, "int").astype(np.int64)
    starts = np.empty(first, np.int64)
    if size == 4 * first and (table[::4] == 3).all():
        starts[:] = 4 * np.arange(first)
    else:
        at = 0
        for cell in range(len(starts)):
            if not 0 <= at < len(table) or table[at] < 1:
                refuse(f"cell {cell} is cut, or has no corner", where, _ALLOWED, "file_cut")
            starts[cell] = at
            at += int(table[at]) + 1
        if at != len(table):
            refuse(f"cells of {at} numbers instead of {len(table)}", where, _ALLOWED, "size_mismatch")
    counts = table[starts]
    if int(counts.sum()) + first != size:
        refuse(f"{first} cells that do not match their {size} numbers", where, _ALLOWED, "size_mismatch")
    keep = np.ones(size, bool)
    keep[starts] = False
    return _Polygons(table[keep], counts)


def _pass_over(cursor: _Cursor, words: list[str], where: str) -> None:
    """Skip a field of arrays."""
    for _ in range(_count(words, 2, 1000, where)):
        array = cursor.words()
        if len(array) != 4:
            refuse(f"field array {' '.join(array)[:60]!r}", where, _ALLOWED, "unknown_line")
        count = _count(array, 1, 1000, where) * _count(array, 2, 3 * MAX_VERTICES, where)
        if array[3] == "STRING":
            _ = [cursor.words() if cursor.is_ascii else cursor.text() for _text in range(min(count, 1000))]
        else:
            cursor.numbers(count, array[3])


def _count(words: list[str], index: int, most: int, where: str) -> int:
    text = words[index] if index < len(words) else ""
    if not (text.isascii() and text.isdigit() and len(text) <= 12 and int(text) <= most):
        what = f"count {text[:20]!r} in {' '.join(words)[:60]!r}"
        refuse(what, where, f"a whole number from 0 to {most}", "out_of_range")
    return int(text)


class _Cursor:
    """Reader of lines and numbers, one after the other, and never beyond the end."""

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where, self._at = data, where, 0
        self.is_ascii = False

    def line(self) -> bytes:
        """The next line without its end; empty at the end of the file."""
        end = self._data.find(b"\n", self._at)
        end = len(self._data) if end < 0 else end
        line = self._data[self._at : end]
        self._at = end + 1
        return line.rstrip(b"\r")

    def words(self) -> list[str]:
        """Words of the next line that is not empty, in capitals, as VTK tells no case; none at the end of the file.

        What is noted of an array is passed over: it ends with an empty line.
        """
        while self._at < len(self._data):
            words = self.line().decode("ascii", "replace").upper().split()
            if words and words[0] not in _NOTES:
                return words
            while words and self.line().strip():
                pass
        return []

    def numbers(self, count: int, kind: str) -> NDArray[Any]:
        """The next numbers, of a type of the format."""
        if kind.lower() not in _TYPES:
            refuse(f"numbers of type {kind[:20]!r}", self._where, ", ".join(_TYPES), "unknown_type")
        dtype = np.dtype(_TYPES[kind.lower()])
        if self.is_ascii:
            return self._from_text(count, np.dtype(np.float64 if dtype.kind == "f" else np.int64))
        size = count * dtype.itemsize
        if self._at + size > len(self._data):
            what = f"{count} numbers of {size} bytes do not fit into the file: it is truncated"
            refuse(what, self._where, _ALLOWED, "file_cut")
        values = np.frombuffer(self._data, dtype, count, self._at)
        self._at += size
        return values

    def text(self) -> bytes:
        """The next text of a binary file: the first two bits say of how many bytes, 8 to 1, its length is."""
        size = 8 >> (self._data[self._at] >> 6) if self._at < len(self._data) else 8
        length = int.from_bytes(self._data[self._at : self._at + size], "big") & (1 << 8 * size - 2) - 1
        start, self._at = self._at + size, self._at + size + length
        if self._at > len(self._data):
            refuse("a text does not fit into the file: it is truncated", self._where, _ALLOWED, "file_cut")
        return self._data[start : self._at]

    def named_numbers(self, key: str, count: int) -> NDArray[Any]:
        """The numbers of an array with a line of its own: its name and type."""
        words = self.words()
        if len(words) != 2 or words[0] != key:
            refuse(f"{' '.join(words)[:60]!r} instead of {key}", self._where, _ALLOWED, "unknown_line")
        if words[1] in ("FLOAT", "DOUBLE"):
            refuse(f"{key} of type {words[1]}", self._where, "whole numbers", "wrong_type")
        return self.numbers(count, words[1])

    def _from_text(self, count: int, dtype: np.dtype[Any]) -> NDArray[Any]:
        words: list[bytes] = []
        while len(words) < count and self._at < len(self._data):
            words += self.line().split()
        if len(words) != count or max(map(len, words), default=0) > MAX_TOKEN_LENGTH:
            refuse(f"{len(words)} numbers instead of {count}", self._where, _ALLOWED, "size_mismatch")
        if self._at > len(self._data):  # its last number may be the beginning of one
            refuse("the last line has no end: the file is cut", self._where, _ALLOWED, "file_cut")
        with refusing((ValueError, OverflowError), "not a number", self._where, _ALLOWED, "not_a_number"):
            return np.array(words, dtype=np.bytes_).astype(dtype)
