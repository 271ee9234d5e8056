"""VTK XML PolyData (.vtp): the polygons of all pieces, with arrays of exactly the stated length.

Arrays in ASCII, inline base64, or appended (raw or base64), plain or zlib-compressed (`array_values`). Source: the VTK
file formats document (Kitware), "XML file formats"; the order of header and blocks from its section on binary data.
"""

from __future__ import annotations

import base64
import binascii
import re
import zlib
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.formats.guard import MAX_TRIANGLES, MAX_VERTICES, RawMesh, join, token_array, triangulate
from puncture_twin.planning.geometry.spaces import Space

_ALLOWED = "a complete VTKFile of type PolyData whose arrays are as long as it states"
_APPENDED = re.compile(rb"<AppendedData[^>]*>")
_APPENDED_END = b"</AppendedData>"
_COMPRESSORS = {None: False, "vtkZLibDataCompressor": True}
_BYTE_ORDERS = {"LittleEndian": "<", "BigEndian": ">"}
_SPACES = {b"LPS\0": Space.LPS, b"RAS\0": Space.RAS}
_HEADER_TYPES = {"UInt32": "u4", "UInt64": "u8"}


def read_vtp(data: bytes, where: str) -> RawMesh:
    """The polygons and triangle strips of a VTP file; polygons are cut into fans; points and lines carry no surface.

    Raises InputError: it is cut, or an array is shorter or longer than stated.
    """
    written, appended = _split_appended(data, where)
    if b"<!" in written.replace(b"<!--", b""):
        refuse("a document type or CDATA section", where, "VTK's own XML, without either", "xml_doctype")
    kinds = (ElementTree.ParseError, ValueError, LookupError)  # no XML, or an unknown text encoding
    with refusing(kinds, "XML cannot be read", where, _ALLOWED, "xml_damaged"):
        root = ElementTree.fromstring(written)
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        refuse(f"{root.tag} of type {root.get('type')}", where, _ALLOWED, "wrong_format")
    section = root.find("AppendedData")
    appended_form = "raw" if section is None else section.get("encoding", "")
    order, header = root.get("byte_order", ""), root.get("header_type", "UInt32")
    compressor = root.get("compressor")
    if order not in _BYTE_ORDERS or header not in _HEADER_TYPES or appended_form not in ("raw", "base64"):
        what = f"byte_order {order!r}, header_type {header!r}, appended {appended_form!r}"
        refuse(what, where, "LittleEndian or BigEndian, UInt32 or UInt64, raw or base64", "unsupported_feature")
    if compressor not in _COMPRESSORS:
        refuse(f"compressor {compressor!r}", where, "none or vtkZLibDataCompressor", "unsupported_feature")
    header_type, compressed = np.dtype(_BYTE_ORDERS[order] + _HEADER_TYPES[header]), _COMPRESSORS[compressor]
    encoding = Encoding(_BYTE_ORDERS[order], header_type, compressed, appended, appended_form == "base64")
    parts = [_piece(one, encoding, f"{where}, piece {i}") for i, one in enumerate(root.findall("PolyData/Piece"))]
    if not (filled := [part for part in parts if part is not None]):
        refuse("no polygon in any piece", where, _ALLOWED, "empty")
    return join(filled)._replace(space=_space(root, encoding, where))


def _space(root: ElementTree.Element, encoding: Encoding, where: str) -> Space | None:
    """The space that Slicer states: a field named SPACE with the letters LPS or RAS and a closing zero."""
    fields = root.findall("PolyData/FieldData/Array[@Name='SPACE']")
    if not fields:
        return None
    letters = ElementTree.Element("DataArray", {**fields[0].attrib, "type": "UInt8"})
    letters.text = fields[0].text
    text = array_values(letters, len(Space.LPS) + 1, encoding, f"{where}, field SPACE").tobytes()
    if text not in _SPACES or len(fields) > 1:
        refuse(f"field SPACE is {text!r}", where, "LPS or RAS, once", "unknown_space")
    return _SPACES[text]


def _split_appended(data: bytes, where: str) -> tuple[bytes, bytes]:
    """The XML without its appended data, which may be raw bytes, and those data from after the underscore."""
    start = _APPENDED.search(data)
    if start is None:
        return data, b""
    end = data.rfind(_APPENDED_END)
    mark = data.find(b"_", start.end())
    if end < 0 or not start.end() <= mark < end or data[start.end() : mark].strip():
        refuse("AppendedData without its mark or end: the file is cut", where, _ALLOWED, "file_cut")
    return data[: start.end()] + data[end:], data[mark + 1 : end]


def _piece(piece: ElementTree.Element, encoding: Encoding, where: str) -> RawMesh | None:
    """One piece; None if it states no polygon at all, as empty pieces of a parallel writer do."""
    counts = {name: _stated(piece, f"NumberOf{name}", where) for name in ("Polys", "Strips")}
    if not any(counts.values()):
        return None
    n_points = _stated(piece, "NumberOfPoints", where)
    if n_points > MAX_VERTICES or max(counts.values()) > MAX_TRIANGLES:
        what = f"{n_points} points and {max(counts.values())} polygons"
        refuse(what, where, f"at most {MAX_VERTICES} points and {MAX_TRIANGLES} polygons", "too_many")
    points = _values(piece, "Points/DataArray", 3 * n_points, encoding, where)
    components = _one(piece, "Points/DataArray", where).get("NumberOfComponents")
    if components != "3":
        refuse(f"points with {components} components", where, "3", "wrong_shape")
    faces = [_triangles(piece, name, count, n_points, encoding, where) for name, count in counts.items() if count]
    return RawMesh(points.reshape(-1, 3).astype(np.float64), np.concatenate(faces))


def _triangles(
    piece: ElementTree.Element, cells: str, count: int, n_points: int, encoding: Encoding, where: str
) -> NDArray[np.int64]:
    """The triangles (m, 3) of so many cells of a kind, ``Polys`` or ``Strips``."""
    offsets = _whole(piece, cells, "offsets", count, encoding, where)
    if offsets.min() < 3 or offsets.max() > MAX_VERTICES or (np.diff(offsets) < 3).any():
        refuse("offsets do not rise by 3 or more per polygon", where, _ALLOWED, "bad_offsets")
    corners = _whole(piece, cells, "connectivity", int(offsets[-1]), encoding, where)
    if corners.min() < 0 or corners.max() >= n_points:
        what = f"vertex indices {corners.min()} to {corners.max()}"
        refuse(what, where, f"0 to {n_points - 1}", "index_out_of_range")
    return triangulate(corners, np.diff(offsets, prepend=0), where, strips=cells == "Strips")


def _whole(
    piece: ElementTree.Element, cells: str, name: str, count: int, encoding: Encoding, where: str
) -> NDArray[np.int64]:
    values = _values(piece, f"{cells}/DataArray[@Name='{name}']", count, encoding, where)
    if values.dtype.kind not in "iu":
        refuse(f"{name} of type {values.dtype}", where, "whole numbers", "wrong_type")
    return values.astype(np.int64)


def _values(piece: ElementTree.Element, path: str, count: int, encoding: Encoding, where: str) -> NDArray[Any]:
    return array_values(_one(piece, path, where), count, encoding, f"{where}, {path}")


def _one(piece: ElementTree.Element, path: str, where: str) -> ElementTree.Element:
    elements = piece.findall(path)
    if len(elements) != 1:
        refuse(f"{len(elements)} arrays {path}", where, "exactly one", "wrong_count")
    return elements[0]


def _stated(piece: ElementTree.Element, name: str, where: str) -> int:
    text = piece.get(name, "0")
    if not (text.isascii() and text.isdigit() and len(text) <= 12):
        refuse(f"{name} is {text[:20]!r}", where, "a whole number from 0", "not_whole")
    return int(text)


_TYPES = {
    "Float32": "f4",
    "Float64": "f8",
    **{f"{sign}Int{bits}": f"{kind}{bits // 8}" for sign, kind in (("", "i"), ("U", "u")) for bits in (8, 16, 32, 64)},
}
_ALLOWED_ARRAYS = "an array as long as the file states, complete, in ascii, binary or appended form"


class Encoding(NamedTuple):
    """Encoding of a file's arrays."""

    byte_order: str
    header_type: np.dtype[Any]  # the type of the sizes before each array
    compressed: bool  # whether binary arrays are blocks of zlib
    appended: bytes  # the bytes after the underscore of the appended section
    appended_base64: bool  # whether those are base64


def array_values(element: ElementTree.Element, count: int, encoding: Encoding, where: str) -> NDArray[Any]:
    """The numbers of an array, shape (count,), of its own type."""
    kind = element.get("type", "")
    if kind not in _TYPES:
        refuse(f"type {kind[:20]!r}", where, ", ".join(_TYPES), "unknown_type")
    dtype = np.dtype(encoding.byte_order + _TYPES[kind])
    form = element.get("format")
    if form == "ascii":
        values = _from_text(element.text or "", dtype, where)
    elif form in ("binary", "appended"):
        raw = _from_binary(_stream(element, form, encoding, where), count * dtype.itemsize, encoding, where)
        values = np.frombuffer(raw, dtype)
    else:
        refuse(f"format {form!r}", where, _ALLOWED_ARRAYS, "unsupported_feature")
    if len(values) != count:
        refuse(f"{len(values)} numbers instead of {count}", where, _ALLOWED_ARRAYS, "size_mismatch")
    return values


class _Stream(NamedTuple):
    data: bytes
    base64: bool


def _stream(element: ElementTree.Element, form: str, encoding: Encoding, where: str) -> _Stream:
    if form == "binary":
        return _Stream((element.text or "").strip().encode(), base64=True)
    offset = element.get("offset", "")
    if not (offset.isascii() and offset.isdigit() and len(offset) <= 15) or int(offset) >= len(encoding.appended):
        what = f"offset {offset[:20]!r} into {len(encoding.appended)} appended bytes"
        refuse(what, where, _ALLOWED_ARRAYS, "index_out_of_range")
    return _Stream(encoding.appended[int(offset) :], encoding.appended_base64)


def _from_text(text: str, dtype: np.dtype[Any], where: str) -> NDArray[Any]:
    what = f"not a number of type {dtype}"
    with refusing((ValueError, OverflowError), what, where, _ALLOWED_ARRAYS, "not_a_number"):
        if dtype.kind == "f":
            return token_array(text.split(), where).astype(np.float64)
        return np.array([int(token) for token in text.split()], dtype=dtype)


def _from_binary(stream: _Stream, size: int, encoding: Encoding, where: str) -> bytes:
    """Bytes of an array. Header: size, or number and size of blocks, of a partial last one, of each compressed."""
    header_type, step = encoding.header_type, encoding.header_type.itemsize
    first = int(np.frombuffer(_take(stream, 0, step, where), header_type)[0])
    if encoding.compressed:
        return _decompressed(stream, size, first, header_type, where)
    if first != size:
        refuse(f"array of {first} bytes instead of {size}", where, _ALLOWED_ARRAYS, "size_mismatch")
    return _take(stream, 0, step + size, where)[step:]


def _decompressed(stream: _Stream, size: int, n_blocks: int, header_type: np.dtype[Any], where: str) -> bytes:
    step = header_type.itemsize
    if n_blocks > len(stream.data) or (n_blocks == 0) != (size == 0):
        refuse(f"{n_blocks} compressed blocks", where, _ALLOWED_ARRAYS, "size_mismatch")
    header = np.frombuffer(_take(stream, 0, (3 + n_blocks) * step, where), header_type)
    block, last, packed = int(header[1]), int(header[2]), [int(each) for each in header[3:]]
    sizes = [block] * n_blocks
    if last and n_blocks:
        sizes[-1] = last
    if sum(sizes) != size:
        refuse(f"blocks of {sum(sizes)} bytes instead of {size}", where, _ALLOWED_ARRAYS, "size_mismatch")
    body = _take(stream, _stored_length(stream, len(header) * step), sum(packed), where)
    out, position = [], 0
    for expected, length in zip(sizes, packed, strict=True):
        unpacker = zlib.decompressobj()
        with refusing(zlib.error, "compressed block is damaged", where, _ALLOWED_ARRAYS, "file_damaged"):
            out.append(unpacker.decompress(body[position : position + length], expected + 1))  # no bomb is inflated
        if len(out[-1]) != expected or not unpacker.eof:
            what = f"compressed block of {len(out[-1])} bytes instead of {expected}, or cut"
            refuse(what, where, _ALLOWED_ARRAYS, "size_mismatch")
        position += length
    return b"".join(out)


def _stored_length(stream: _Stream, size: int) -> int:
    return 4 * ((size + 2) // 3) if stream.base64 else size


def _take(stream: _Stream, start: int, size: int, where: str) -> bytes:
    """Decoded bytes; in base64 they start a group of their own at character ``start``."""
    end = start + _stored_length(stream, size)
    if end > len(stream.data):
        refuse(f"array data end at byte {len(stream.data)} of {end}", where, _ALLOWED_ARRAYS, "file_cut")
    if not stream.base64:
        return stream.data[start:end]
    with refusing(binascii.Error, "base64 data is damaged", where, _ALLOWED_ARRAYS, "file_damaged"):
        decoded = base64.b64decode(stream.data[start:end], validate=True)
    if len(decoded) < size:
        refuse(f"base64 data of {len(decoded)} bytes instead of {size}", where, _ALLOWED_ARRAYS, "size_mismatch")
    return decoded[:size]
