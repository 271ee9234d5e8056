"""Transforms of ITK in HDF5 (.h5): the default of 3D Slicer for all transforms, and of ANTs for composites.

A file has a group ``TransformGroup`` with groups ``0``, ``1``, ... of ``TransformType`` (one text),
``TransformParameters`` and ``TransformFixedParameters``; files of ITK 4 spell both ``Tranform``. A composite is group 0
without parameters, its parts the groups after it. What is read are the bytes that were hashed: nothing that points
elsewhere is followed. The texts are found by `heap_text`: HDF5's own library never ends on some damaged heaps.
Source: ITK, HDF5TransformIO. Needs the extra ``hdf5`` (h5py), which is imported only here.
"""

from __future__ import annotations

import struct
from io import BytesIO
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.extras import require_extra
from puncture_twin.planning.formats.itk_linear import ALLOWED, MAX_PARTS, StatedTransform
from puncture_twin.planning.formats.raw_mesh import refuse

MAX_STORED_BYTES = 4096
"""Of one list of numbers: twelve doubles are 96; compressed ones cannot grow to more than a thousand times of this."""
MAX_NUMBERS = 64
"""Of one list: more than any linear transform has."""
HEAP_HEAD_BYTES = 16
"""Of a collection, and of each object in it."""
_GROUP, _TYPE = "TransformGroup", "TransformType"
_PARAMETERS = ("TransformParameters", "TranformParameters")
_FIXED = ("TransformFixedParameters", "TranformFixedParameters")
_DAMAGED = (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, MemoryError, OverflowError)
"""What h5py raises for bytes that are no whole HDF5."""
_AS_TEXT = (
    ", or the same transform as text: in Slicer, Save with the file format .tfm; "
    "in SimpleITK, WriteTransform(T, 'x.tfm')"
)


def hdf5_transforms(data: bytes, where: str) -> list[StatedTransform]:
    """The transforms of a file in its order, linear or not; lists too long for a linear one come empty.

    Args:
        data: The whole file.
        where: Its name, for errors.

    Raises:
        InputError: Without h5py; or no whole HDF5 file of ITK's transforms.
    """
    require_extra("hdf5", where, else_allowed=_AS_TEXT)
    import h5py

    try:
        with h5py.File(BytesIO(data), "r") as file:
            return [_transform(_Members(h5py, group, data, where), where) for group in _groups(h5py, file, where)]
    except _DAMAGED as error:
        raise InputError(f"no whole HDF5 file ({str(error)[:120]})", where=where, allowed=ALLOWED) from error


def _groups(h5py: Any, file: Any, where: str) -> list[Any]:
    """The groups of the transforms by their numbers."""
    if _GROUP not in file:
        refuse(f"HDF5 without {_GROUP}", where, ALLOWED)
    parent = _own(h5py, file, _GROUP, h5py.Group, where)
    if not 0 < len(parent) <= MAX_PARTS + 1:
        refuse(f"{len(parent)} transforms", where, f"1, or at most {MAX_PARTS} parts of a CompositeTransform")
    names = [str(number) for number in range(len(parent))]
    if set(parent) != set(names):
        refuse(f"{_GROUP} with {', '.join(sorted(parent))[:60]}", where, f"transforms numbered {', '.join(names)}")
    return [_own(h5py, parent, name, h5py.Group, where) for name in names]


def _own(h5py: Any, parent: Any, name: str, kind: type, where: str) -> Any:
    """A member that is in the file itself; links could name any file of the host."""
    if not isinstance(parent.get(name, getlink=True), h5py.HardLink) or not isinstance(parent[name], kind):
        refuse(f"{parent.name}/{name} is a link or of another sort", where, ALLOWED)
    return parent[name]


class _Members:
    """What one transform's group holds."""

    def __init__(self, h5py: Any, group: Any, content: bytes, where: str) -> None:
        self._h5py, self._group, self._content, self._where = h5py, group, content, where

    def text(self, name: str) -> str:
        """The one text of a dataset."""
        if name not in self._group:
            refuse(f"{self._group.name} without {name}", self._where, ALLOWED)
        data = self._dataset(name)
        info = self._h5py.check_string_dtype(data.dtype)
        if data.size != 1 or info is None:
            refuse(f"{data.name} is no text", self._where, ALLOWED)
        if info.length is None:
            return heap_text(self._content, data.id.get_offset())
        return str(np.ravel(data.asstr()[()])[0])

    def numbers(self, names: tuple[str, ...]) -> Floats:
        """The numbers of a dataset by either of its names; none where there is none or it is too large."""
        there = [name for name in names if name in self._group]
        if len(there) > 1:
            refuse(f"{self._group.name} with {' and '.join(there)}", self._where, ALLOWED)
        data = self._dataset(there[0]) if there else None
        if data is None or data.size > MAX_NUMBERS:
            return np.empty(0)
        if data.dtype not in (np.float64, np.float32) or data.ndim != 1:
            refuse(f"{data.name} of {data.dtype} with shape {data.shape}", self._where, "a list of floats or doubles")
        return np.asarray(data[()], dtype=np.float64)

    def _dataset(self, name: str) -> Any:
        data = _own(self._h5py, self._group, name, self._h5py.Dataset, self._where)
        if data.is_virtual or data.external:
            refuse(f"{data.name} lies in another file", self._where, ALLOWED)
        if data.size <= MAX_NUMBERS and data.id.get_storage_size() > MAX_STORED_BYTES:
            refuse(f"{data.name} takes {data.id.get_storage_size()} bytes", self._where, ALLOWED)
        return data


def heap_text(content: bytes, offset: int | None) -> str:
    """A text of variable length, from the collection of the global heap that holds it.

    Args:
        content: The whole file.
        offset: Where the element stands: length (4 bytes), the collection's address (8), the object's number (4).

    Raises:
        ValueError: It is not there.
    Source: HDF5 file format, version 3, III.E "Disk format: global heap", IV.B "variable-length datatypes".
    """
    if offset is None:
        raise ValueError("a text outside of contiguous storage")
    length, start, wanted = _unpacked("<IQI", content, offset)
    magic, version, size = _unpacked("<4sB3xQ", content, start)
    if magic != b"GCOL" or version != 1 or start + size > len(content):
        raise ValueError("no heap where a text should be")
    place = start + HEAP_HEAD_BYTES
    while place + HEAP_HEAD_BYTES <= start + size:
        number, _, stored = _unpacked("<HH4xQ", content, place)
        place += HEAP_HEAD_BYTES
        if number in (0, wanted):  # 0: what is free, up to the end
            break
        place += -(-stored // 8) * 8
    if number != wanted or length > stored or stored > MAX_STORED_BYTES or place + stored > start + size:
        raise ValueError("a text is not in its heap")
    return content[place : place + length].split(b"\0")[0].decode("ascii")


def _unpacked(layout: str, content: bytes, start: int) -> tuple[Any, ...]:
    if start + struct.calcsize(layout) > len(content):
        raise ValueError("an address beyond the end")
    return struct.unpack_from(layout, content, start)


def _transform(members: _Members, where: str) -> StatedTransform:
    return StatedTransform(members.text(_TYPE), members.numbers(_PARAMETERS), members.numbers(_FIXED))
