"""STL, binary and ASCII: every facet that the file promises, or an error.

The binary form states its number of facets, so its size must fit to the byte. The ASCII form states nothing: every
facet must be complete and the one solid must be closed by ``endsolid``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.formats.raw_mesh import RawMesh

_HEADER_BYTES = 84
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_BINARY_ALLOWED = "a binary STL of 84 + 50 n bytes, n as its header states it, at least 1"
_ASCII_ALLOWED = "one solid of complete facets, closed by endsolid"
_KEYWORDS = {0: "facet", 1: "normal", 5: "outer", 6: "loop", 7: "vertex", 11: "vertex", 15: "vertex"} | {
    19: "endloop",
    20: "endfacet",
}
_TOKENS_PER_FACET = 21
_COORDINATE_TOKENS = [8, 9, 10, 12, 13, 14, 16, 17, 18]


def read_stl(data: bytes, where: str) -> RawMesh:
    """The triangles of an STL file, three vertices of their own each.

    Raises:
        InputError: If it is cut, has a false count, or is not STL.
    """
    looks_ascii = data[:512].lstrip().lower().startswith(b"solid") and b"facet" in data[:2048].lower()
    if looks_ascii and not _binary_size_fits(data):
        return _read_ascii(data, where)
    return _read_binary(data, where)


def _binary_size_fits(data: bytes) -> bool:
    return len(data) >= _HEADER_BYTES and len(data) == _HEADER_BYTES + 50 * _stated_count(data)


def _stated_count(data: bytes) -> int:
    return int.from_bytes(data[80:84], "little")


def _read_binary(data: bytes, where: str) -> RawMesh:
    if len(data) < _HEADER_BYTES:
        refuse(f"STL of {len(data)} bytes is shorter than its header", where, _BINARY_ALLOWED, "file_cut")
    count = _stated_count(data)
    if not _binary_size_fits(data) or count == 0:
        needed = _HEADER_BYTES + 50 * count
        what = f"header states {count} triangles, which take {needed} bytes, but the file has {len(data)}"
        refuse(what, where, _BINARY_ALLOWED, "size_mismatch")
    facets = np.frombuffer(data, dtype=_FACET, offset=_HEADER_BYTES)
    return _from_corners(facets["corners"].astype(np.float64))


def _read_ascii(data: bytes, where: str) -> RawMesh:
    lines = decode_text(data, where).strip().splitlines()
    if lines[-1].split()[0].lower() != "endsolid":
        refuse(f"the last line is {lines[-1][:40]!r}: the file is cut", where, _ASCII_ALLOWED, "file_cut")
    tokens = " ".join(lines[1:-1]).lower().split()
    if "endsolid" in tokens:
        refuse("several solids: a truncated file could lose some", where, _ASCII_ALLOWED, "several_solids")
    if len(tokens) == 0:
        refuse("the solid has no facet", where, _ASCII_ALLOWED, "empty")
    _check_keywords(tokens, where)
    if len(tokens) % _TOKENS_PER_FACET:
        refuse(f"facet {len(tokens) // _TOKENS_PER_FACET} is not complete", where, _ASCII_ALLOWED, "file_cut")
    columns = [tokens[column::_TOKENS_PER_FACET] for column in _COORDINATE_TOKENS]
    try:
        corners = np.array([[float(token) for token in column] for column in columns])
    except ValueError as error:
        what = f"a coordinate is not a number ({error})"
        raise InputError(what, where=where, allowed=_ASCII_ALLOWED, code="not_a_number") from error
    return _from_corners(corners.T.reshape(-1, 3, 3))


def _check_keywords(tokens: list[str], where: str) -> None:
    """Every facet has the same words at the same places; the first that has not is named."""
    wrong = [
        (facet, place, found, keyword)
        for place, keyword in _KEYWORDS.items()
        for facet, found in enumerate(tokens[place::_TOKENS_PER_FACET])
        if found != keyword
    ]
    if wrong:
        facet, _, found, keyword = min(wrong)
        refuse(f"facet {facet}: {found[:20]!r} instead of {keyword!r}", where, _ASCII_ALLOWED, "unknown_line")


def _from_corners(corners: NDArray[np.float64]) -> RawMesh:
    return RawMesh(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int64).reshape(-1, 3))
