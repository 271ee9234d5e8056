"""The stored voxels of a volume, from the bytes of its file: raw, gzipped or as text."""

from __future__ import annotations

import re
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats.volumes.volume_header import VolumeHeader, check_exact_size

DEFLATE_RATIO = 1033
"""Deflate cannot shrink by more than 1032:1 (zlib's technical notes), so a tiny file cannot hold a large volume."""
GZIP_WINDOW = 16 + zlib.MAX_WBITS
"""Tells zlib to expect gzip's header and check sum."""
PART_BYTES = 1 << 20
"""As much is read, and made, at a time."""


def inflated(content: memoryview, promised: int, *, where: Path) -> NDArray[np.uint8]:
    """Inflate gzip data, which may have several members one after the other, padded with zeros.

    Stops one byte after the promised length, so what a bomb would inflate to is never made.

    Args:
        content: The compressed bytes.
        promised: Bytes that the header says they inflate to.

    Returns:
        Shape (promised,).

    Raises:
        InputError: Damaged, truncated, or of another length.
    """
    if promised > len(content) * DEFLATE_RATIO:
        what = f"{len(content)} compressed bytes cannot hold the {promised} bytes that the header states"
        refuse(what, where, "a complete file", "size_mismatch")
    found = np.empty(promised, np.uint8)
    count = 0
    try:
        for part in _parts(content, promised + 1):
            if count + len(part) <= promised:
                found[count : count + len(part)] = np.frombuffer(part, np.uint8)
            count += len(part)
    except (EOFError, zlib.error) as error:
        what = f"the compressed data are damaged or cut short after {count} of {promised} bytes ({error})"
        raise InputError(what, where=where, allowed="a complete gzip file", code="file_damaged") from error
    check_exact_size(count, promised, where=where)
    return found


def first_bytes(content: memoryview, count: int, *, where: Path, allowed: str) -> bytes:
    """The first bytes that gzip data inflate to; fewer where there are no more.

    Raises:
        InputError: No gzip data, or damaged at the beginning.
    """
    try:
        return b"".join(_parts(content, count))
    except (EOFError, zlib.error) as error:
        what = f"not a readable gzip file ({error})"
        raise InputError(what, where=where, allowed=allowed, code="file_damaged") from error


def _parts(content: memoryview, most: int) -> Iterator[bytes]:
    """What gzip data inflate to, in parts: at most so many bytes, and the check sums of all members that end there."""
    at, member = 0, zlib.decompressobj(GZIP_WINDOW)
    while most > 0:
        waiting: bytes | memoryview = member.unconsumed_tail
        if not waiting:
            waiting = content[at : at + PART_BYTES]
            at += len(waiting)
        part = member.decompress(waiting, min(most, PART_BYTES))
        if member.eof:
            at, member = at - len(member.unused_data), zlib.decompressobj(GZIP_WINDOW)
            if at == len(content) or (content[at] == 0 and not any(content[at:])):
                most = len(part)
        elif not part and not waiting:
            raise EOFError("the data end before their end marker")
        most -= len(part)
        if part:
            yield part


INTEGER_TEXT = re.compile(rb"[0-9+\-\s]*")
FLOAT_TEXT = re.compile(rb"[0-9+\-.eE\s]*")
LONGEST_NUMBER = 64
"""Characters; a double with all of its digits and exponent has 24."""
TEXT_BYTES = LONGEST_NUMBER + 1
"""Of one number and the space after it, at most."""


def decoded(content: memoryview, header: VolumeHeader) -> NDArray[Any]:
    """The voxels as stored, in this machine's byte order.

    Returns:
        Shape (ni, nj, nk), axis i running fastest in memory; (layers, ni, nj, nk) where there are several layers.

    Raises:
        InputError: The data are damaged, or shorter or longer than the header says.
    """
    cells, where = header.cells, header.data_path
    data, count = content[cells.start :], header.count * header.layers
    if cells.encoding == "ascii":
        flat = _numbers(bytes(data), count, cells.dtype, where)
    else:
        promised = cells.offset + count * cells.dtype.itemsize
        if cells.encoding == "raw":
            check_exact_size(len(data), promised, where=where)
        whole = data if cells.encoding == "raw" else inflated(data, promised, where=where)
        flat = np.frombuffer(whole, cells.dtype, count, cells.offset)
    shape = header.shape if header.layers == 1 else (header.layers, *header.shape)
    return flat.astype(cells.dtype.newbyteorder("="), copy=False).reshape(shape, order="F")


def _numbers(text: bytes, count: int, dtype: np.dtype[Any], where: Path) -> NDArray[Any]:
    allowed = f"plain numbers of type {dtype}"
    pattern = FLOAT_TEXT if dtype.kind == "f" else INTEGER_TEXT
    if len(text) > count * TEXT_BYTES or pattern.fullmatch(text) is None:
        refuse("the data have values other than numbers", where, allowed, "not_a_number")
    words = text.split()
    check_exact_size(len(words), count, where=where)
    try:
        numbers = [float(word) for word in words] if dtype.kind == "f" else [int(word) for word in words]
        with np.errstate(over="ignore"):  # what becomes infinite is refused
            return np.array(numbers, dtype=dtype)
    except (ValueError, OverflowError) as error:
        what = f"the data have no number of their type ({error})"
        raise InputError(what, where=where, allowed=allowed, code="not_a_number") from error
