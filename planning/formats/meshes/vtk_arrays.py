"""One DataArray of a VTK XML file: its numbers, exactly as many as stated, from any of the encodings."""

from __future__ import annotations

import base64
import binascii
import zlib
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.raw_mesh import refuse, token_array

_TYPES = {
    "Float32": "f4",
    "Float64": "f8",
    **{f"{sign}Int{bits}": f"{kind}{bits // 8}" for sign, kind in (("", "i"), ("U", "u")) for bits in (8, 16, 32, 64)},
}
_ALLOWED = "an array as long as the file states, complete, in ascii, binary or appended form"


class Encoding(NamedTuple):
    """How the arrays of a file are written.

    Attributes:
        byte_order: "<" or ">".
        header_type: The type of the sizes before each array.
        compressed: Whether binary arrays are blocks of zlib.
        appended: The bytes after the underscore of the appended section.
        appended_base64: Whether those are base64.
    """

    byte_order: str
    header_type: np.dtype[Any]
    compressed: bool
    appended: bytes
    appended_base64: bool


def array_values(element: ElementTree.Element, count: int, encoding: Encoding, where: str) -> NDArray[Any]:
    """The numbers of an array.

    Args:
        element: The DataArray.
        count: How many the file states elsewhere.
        encoding: How binary arrays are written.
        where: The file and the array, for the error.

    Returns:
        Shape (count,), of the array's own type.

    Raises:
        InputError: If there are more or fewer, or they cannot be decoded.
    """
    kind = element.get("type", "")
    if kind not in _TYPES:
        refuse(f"type {kind[:20]!r}", where, ", ".join(_TYPES))
    dtype = np.dtype(encoding.byte_order + _TYPES[kind])
    form = element.get("format")
    if form == "ascii":
        values = _from_text(element.text or "", dtype, where)
    elif form in ("binary", "appended"):
        raw = _from_binary(_stream(element, form, encoding, where), count * dtype.itemsize, encoding, where)
        values = np.frombuffer(raw, dtype)
    else:
        refuse(f"format {form!r}", where, _ALLOWED)
    if len(values) != count:
        refuse(f"{len(values)} numbers instead of {count}", where, _ALLOWED)
    return values


class _Stream(NamedTuple):
    data: bytes
    base64: bool


def _stream(element: ElementTree.Element, form: str, encoding: Encoding, where: str) -> _Stream:
    if form == "binary":
        return _Stream((element.text or "").strip().encode(), base64=True)
    offset = element.get("offset", "")
    if not (offset.isascii() and offset.isdigit() and len(offset) <= 15) or int(offset) >= len(encoding.appended):
        refuse(f"offset {offset[:20]!r} into {len(encoding.appended)} appended bytes", where, _ALLOWED)
    return _Stream(encoding.appended[int(offset) :], encoding.appended_base64)


def _from_text(text: str, dtype: np.dtype[Any], where: str) -> NDArray[Any]:
    try:
        if dtype.kind == "f":
            return token_array(text.split(), where).astype(np.float64)
        return np.array([int(token) for token in text.split()], dtype=dtype)
    except (ValueError, OverflowError) as error:
        raise InputError(f"no number of type {dtype} ({error})", where=where, allowed=_ALLOWED) from error


def _from_binary(stream: _Stream, size: int, encoding: Encoding, where: str) -> bytes:
    if encoding.compressed:
        return _decompressed(stream, size, encoding.header_type, where)
    header = encoding.header_type.itemsize
    stated = int(np.frombuffer(_take(stream, 0, header, where), encoding.header_type)[0])
    if stated != size:
        refuse(f"array of {stated} bytes instead of {size}", where, _ALLOWED)
    return _take(stream, 0, header + size, where)[header:]


def _decompressed(stream: _Stream, size: int, header_type: np.dtype[Any], where: str) -> bytes:
    """Header: number of blocks, size of a block, of the last one if it is partial, then each compressed size."""
    step = header_type.itemsize
    n_blocks = int(np.frombuffer(_take(stream, 0, step, where), header_type)[0])
    if n_blocks > len(stream.data) or (n_blocks == 0) != (size == 0):
        refuse(f"{n_blocks} compressed blocks", where, _ALLOWED)
    header = np.frombuffer(_take(stream, 0, (3 + n_blocks) * step, where), header_type)
    block, last, packed = int(header[1]), int(header[2]), [int(each) for each in header[3:]]
    sizes = [block] * n_blocks
    if last and n_blocks:
        sizes[-1] = last
    if sum(sizes) != size:
        refuse(f"blocks of {sum(sizes)} bytes instead of {size}", where, _ALLOWED)
    start = _encoded_length(len(header) * step) if stream.base64 else len(header) * step
    body = _take(stream, start, sum(packed), where)
    out, position = [], 0
    for expected, length in zip(sizes, packed, strict=True):
        out.append(_inflate(body[position : position + length], expected, where))
        position += length
    return b"".join(out)


def _inflate(data: bytes, size: int, where: str) -> bytes:
    """One block of zlib, never more bytes than stated."""
    unpacker = zlib.decompressobj()
    try:
        block = unpacker.decompress(data, size + 1)
    except zlib.error as error:
        raise InputError(f"compressed block is damaged ({error})", where=where, allowed=_ALLOWED) from error
    if len(block) != size or not unpacker.eof:
        refuse(f"compressed block of {len(block)} bytes instead of {size}, or cut", where, _ALLOWED)
    return block


def _encoded_length(size: int) -> int:
    return 4 * ((size + 2) // 3)


def _take(stream: _Stream, start: int, size: int, where: str) -> bytes:
    """Decoded bytes; in base64 they start a group of their own at character ``start``."""
    end = start + (_encoded_length(size) if stream.base64 else size)
    if end > len(stream.data):
        refuse(f"array data end at byte {len(stream.data)} of {end}", where, _ALLOWED)
    if not stream.base64:
        return stream.data[start:end]
    try:
        decoded = base64.b64decode(stream.data[start:end], validate=True)
    except binascii.Error as error:
        raise InputError(f"base64 data is damaged ({error})", where=where, allowed=_ALLOWED) from error
    if len(decoded) < size:
        refuse(f"base64 data of {len(decoded)} bytes instead of {size}", where, _ALLOWED)
    return decoded[:size]
