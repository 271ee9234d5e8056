"""The stored voxels of a volume, from the bytes of its file: raw, gzipped or as text."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.inflate import inflated
from puncture_twin.planning.formats.volumes.volume_header import VolumeHeader, check_exact_size

INTEGER_TEXT = re.compile(rb"[0-9+\-\s]*")
FLOAT_TEXT = re.compile(rb"[0-9+\-.eE\s]*")
LONGEST_NUMBER = 64
"""Characters; a double with all of its digits and exponent has 24."""
TEXT_BYTES = LONGEST_NUMBER + 1
"""Of one number and the space after it, at most."""


def decoded(content: memoryview, header: VolumeHeader) -> NDArray[Any]:
    """The voxels as stored, in this machine's byte order.

    Args:
        content: The file that holds the voxels.
        header: What the header says of them.

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
        raise InputError("the data hold something else than numbers", where=where, allowed=allowed)
    words = text.split()
    check_exact_size(len(words), count, where=where)
    try:
        numbers = [float(word) for word in words] if dtype.kind == "f" else [int(word) for word in words]
        with np.errstate(over="ignore"):  # what becomes infinite is refused
            return np.array(numbers, dtype=dtype)
    except (ValueError, OverflowError) as error:
        raise InputError(f"the data hold no number of their type ({error})", where=where, allowed=allowed) from error
