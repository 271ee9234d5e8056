"""Linear transforms of ITK, as text (.tfm, .txt) or HDF5 (.h5): what 3D Slicer, SimpleITK and ANTs write.

Each transform states what ``TransformPoint`` does: y = M (x - c) + c + t, with x and y in LPS mm, M from the parameters
and the centre of rotation c from the fixed ones. A composite applies its last part first. In which frame a transform's
points are, no file says.
Source: ITK, TxtTransformIO, HDF5TransformIO, MatrixOffsetTransformBase, Euler3DTransform (M = Rz Rx Ry, or Rz Ry Rx
where its flag says ZYX), VersorRigid3DTransform, CompositeTransform; Slicer's developer guide, "Transforms": a node's
file goes from its parent.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Collection
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError, refuse, require_extra
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.geometry.rigid import pose

TEXT_ENDINGS, HDF5_ENDINGS = (".tfm", ".txt"), (".h5", ".hdf5")
MAX_TEXT_BYTES = 100_000
"""A linear transform has 15 numbers; a larger text holds another one."""
MAX_HDF5_BYTES = 500_000_000
"""A field of displacements is refused by its name, which has to be read."""
_HEADER = "#Insight Transform File V1.0"
_KEYS = ("Parameters", "FixedParameters")
_LINE_END = re.compile(r"\r\n|\r|\n")
"""Python's `splitlines` takes a vertical tab and six more characters for one too; ITK does not."""
_NUMBER = re.compile(r"[!-^`-~]+")
"""Printed ASCII without the underscore: Python also reads 1_0 and the digits of other scripts."""


def most_bytes(name: str) -> int:
    """Largest size of a transform file, by its ending, bytes."""
    return MAX_HDF5_BYTES if name.lower().endswith(HDF5_ENDINGS) else MAX_TEXT_BYTES


def parse_transform(data: bytes, path: Path) -> Floats:
    """The rigid motion of points (4, 4), mm, that a file states. Raises InputError: another, several, or not rigid."""
    name = str(path)
    if not name.lower().endswith(HDF5_ENDINGS + TEXT_ENDINGS):
        refuse(f"transform file of the kind {path.suffix!r}", path, ALLOWED, "unknown_format")
    read = hdf5_transforms if name.lower().endswith(HDF5_ENDINGS) else _text_transforms
    return guard_transform(linear_motion(read(data, name), name), where=path)


def _text_transforms(data: bytes, where: str) -> list[StatedTransform]:
    """The transforms of a text in its order; a key that is not stated has no numbers."""
    lines = [line.strip() for line in _LINE_END.split(decode_text(data, where)) if line.strip()]
    if not lines or lines[0] != _HEADER:
        refuse("not an ITK transform file", where, ALLOWED, "wrong_format")
    blocks: list[tuple[str, dict[str, str]]] = []
    for line in lines:
        key, mark, value = (part.strip() for part in line.partition(":"))
        if line.startswith("#"):
            continue
        if key == "Transform":
            blocks.append((value, {}))
        elif not blocks or key not in _KEYS or not mark or key in blocks[-1][1]:
            refuse(f"line {line[:60]!r}", where, ALLOWED, "unknown_line")
        else:
            blocks[-1][1][key] = value
    return [StatedTransform(kind, *(_numbers(one.get(key, ""), key, where) for key in _KEYS)) for kind, one in blocks]


def _numbers(stated: str, key: str, where: str) -> Floats:
    try:
        return np.array([float(one if _NUMBER.fullmatch(one) else f"not a number: {one}") for one in stated.split()])
    except ValueError as error:
        what = f"{key} are not numbers ({str(error)[:80]})"
        raise InputError(what, where=where, allowed=ALLOWED, code="not_a_number") from error


def transform_text(T: Floats) -> str:
    """The text file of a motion of points, shape (4, 4), mm; it reads back to the same numbers.

    >>> print(transform_text(np.eye(4)).splitlines()[2])
    Transform: AffineTransform_double_3_3
    """
    numbers = " ".join(map(repr, [*T[:3, :3].ravel().tolist(), *T[:3, 3].tolist()]))
    head = f"{_HEADER}\n#Transform 0\nTransform: AffineTransform_double_3_3\n"
    return f"{head}Parameters: {numbers}\nFixedParameters: 0 0 0\n"


MAX_PARTS = 20
"""A chain of registrations has a handful of parts."""
ALLOWED = (
    "an ITK transform file (.tfm, .h5) with one AffineTransform, Euler3DTransform, VersorRigid3DTransform, "
    "TranslationTransform or IdentityTransform of three dimensions, as Slicer saves a linear transform, or a "
    "CompositeTransform of them"
)
_COMPOSITE = re.compile(r"CompositeTransform_(double|float)_3_3")
_SIZES = {
    "AffineTransform": (12, (3,)), "MatrixOffsetTransformBase": (12, (3,)), "Euler3DTransform": (6, (3, 4)),
    "VersorRigid3DTransform": (6, (3,)), "TranslationTransform": (3, (0,)), "IdentityTransform": (0, (0,)),
}  # fmt: skip
"""Parameters, and fixed parameters; Euler's flag for ZYX is missing in files of ITK 4."""
_LINEAR = re.compile(f"({'|'.join(_SIZES)})_(double|float)_3_3")
_VERSOR_EDGE = 1e-10
"""ITK shortens a versor that is this near to length 1 or above; what it does to points is what a file means."""
_VERSOR_SLACK = 1e-6
"""Longer by more than what single precision rounds: no rotation."""


class StatedTransform(NamedTuple):
    """One transform as a file states it."""

    kind: str  # ITK's name with precision and dimensions, such as ``AffineTransform_double_3_3``
    parameters: Floats  # shape (n,)
    fixed: Floats  # shape (m,): the centre of rotation, mm, LPS; of Euler angles also the flag for their order


def linear_motion(stated: list[StatedTransform], where: str) -> Floats:
    """The motion of points by the transforms of one file, shape (4, 4), mm; whether it is rigid is not checked."""
    if len(stated) > MAX_PARTS + 1:
        refuse(f"{len(stated)} transforms", where, f"at most {MAX_PARTS} parts of a CompositeTransform", "too_many")
    parts = stated[1:] if stated and _COMPOSITE.fullmatch(stated[0].kind) else stated
    if not parts:
        refuse("not a linear transform", where, ALLOWED, "no_linear_transform")
    for part in parts:
        if _LINEAR.fullmatch(part.kind) is None:
            refuse(f"transform of type {part.kind[:60]!r}", where, ALLOWED, "unknown_type")
    if len(parts) > 1 and parts is stated:
        refuse("several transforms: harden them into one", where, ALLOWED, "several_transforms")
    T = np.eye(4)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by the guard
        for part in parts:
            T = T @ _motion(part, where)
    return T


def _motion(stated: StatedTransform, where: str) -> Floats:
    """The motion of points by one part, shape (4, 4)."""
    name = stated.kind.partition("_")[0]
    count, fixed_counts = _SIZES[name]
    for numbers, counts, key in zip((stated.parameters, stated.fixed), ((count,), fixed_counts), _KEYS, strict=True):
        if len(numbers) not in counts:
            allowed = " or ".join(f"{one}" for one in counts) + " numbers"
            refuse(f"{len(numbers)} {key}", where, allowed, "wrong_count")
    if name == "Euler3DTransform":
        x, y, z = (_about(axis, angle) for axis, angle in enumerate(stated.parameters[:3]))
        M = z @ y @ x if stated.fixed[3:].any() else z @ x @ y
    elif name == "VersorRigid3DTransform":
        M = _versor(stated.parameters[:3], where)
    else:
        M = stated.parameters[:9].reshape(3, 3) if count == 12 else np.eye(3)
    shift, centre = np.append(np.zeros(3), stated.parameters)[-3:], np.append(stated.fixed, np.zeros(3))[:3]
    return pose(M, shift + centre - M @ centre)


def _about(axis: int, angle: float) -> Floats:
    c, s = np.cos(angle), np.sin(angle)
    R = np.eye(3)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    R[i, i], R[i, j], R[j, i], R[j, j] = c, -s, s, c
    return R


def _versor(v: Floats, where: str) -> Floats:
    """Rotation of the vector part (x, y, z) of a unit quaternion whose scalar part is not negative."""
    length = float(np.linalg.norm(v))
    if not length <= 1.0 + _VERSOR_SLACK:
        refuse(f"a versor of length {length:.9g}", where, "the vector part of a unit quaternion: at most 1", "not_unit")
    if length >= 1.0 - _VERSOR_EDGE:
        v = v / (length * (1.0 + _VERSOR_EDGE))
    (x, y, z), w = v, np.sqrt(1.0 - v @ v)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    return np.asarray(np.eye(3) + 2.0 * (w * cross + cross @ cross))


MAX_STORED_BYTES = 4096
"""Bytes of one list of numbers: twelve doubles are 96; compressed ones cannot grow to more than a thousand times of
this."""
MAX_NUMBERS = 64
"""Numbers of one list: more than any linear transform has."""
HEAP_HEAD_BYTES = 16
"""Bytes of the head of a collection, and of each object in it."""
_GROUP, _TYPE = "TransformGroup", "TransformType"
_PARAMETERS = ("TransformParameters", "TranformParameters")
_FIXED = ("TransformFixedParameters", "TranformFixedParameters")
_DAMAGED = (OSError, KeyError, ValueError, TypeError, RuntimeError, AttributeError, MemoryError, OverflowError)
"""Exceptions of h5py for bytes that are no whole HDF5."""
_AS_TEXT = (
    ", or the same transform as text: in Slicer, Save with the file format .tfm; "
    "in SimpleITK, WriteTransform(T, 'x.tfm')"
)


def hdf5_transforms(content: bytes, where: str) -> list[StatedTransform]:
    """The transforms of a file in its order, linear or not; lists too long for a linear one come empty.

    A file has a group ``TransformGroup`` with groups ``0``, ``1``, ... of ``TransformType`` (one text),
    ``TransformParameters`` and ``TransformFixedParameters``; files of ITK 4 spell both ``Tranform``. A composite is
    group 0 without parameters, its parts the groups after it. What is read are the bytes that were hashed: nothing
    that points elsewhere is followed. The texts are found by `heap_text`: HDF5's own library never ends on some damaged
    heaps. Needs the extra ``hdf5`` (h5py), which is imported only here.
    """
    require_extra("hdf5", where, else_allowed=_AS_TEXT)
    import h5py

    def own(parent: Any, name: str, kind: type) -> Any:
        """A member of the file itself; a link could name any file of the host, and is refused."""
        if not isinstance(parent.get(name, getlink=True), h5py.HardLink) or not isinstance(parent[name], kind):
            refuse(f"{parent.name}/{name} is a link or of another type", where, ALLOWED, "wrong_format")
        return parent[name]

    def dataset(group: Any, name: str) -> Any:
        data = own(group, name, h5py.Dataset)
        if data.is_virtual or data.external:
            refuse(f"{data.name} is in another file", where, ALLOWED, "data_elsewhere")
        if data.size <= MAX_NUMBERS and data.id.get_storage_size() > MAX_STORED_BYTES:
            refuse(f"{data.name} takes {data.id.get_storage_size()} bytes", where, ALLOWED, "file_size")
        return data

    def text(group: Any, name: str) -> str:
        """The one text of a dataset."""
        if name not in group:
            refuse(f"{group.name} without {name}", where, ALLOWED, "missing_key")
        data = dataset(group, name)
        info = h5py.check_string_dtype(data.dtype)
        if data.size != 1 or info is None:
            refuse(f"{data.name} is not a text", where, ALLOWED, "wrong_type")
        return heap_text(content, data.id.get_offset()) if info.length is None else str(np.ravel(data.asstr()[()])[0])

    def numbers(group: Any, names: tuple[str, ...]) -> Floats:
        """The numbers of a dataset by either of its names; none where there is none or it is too large."""
        there = [name for name in names if name in group]
        if len(there) > 1:
            refuse(f"{group.name} with {' and '.join(there)}", where, ALLOWED, "stated_twice")
        return _list_of(dataset(group, there[0]), where) if there else np.empty(0)

    try:
        with h5py.File(BytesIO(content), "r") as file:
            if _GROUP not in file:
                refuse(f"HDF5 without {_GROUP}", where, ALLOWED, "wrong_format")
            parent = own(file, _GROUP, h5py.Group)
            groups = [own(parent, name, h5py.Group) for name in _numbered(parent, where)]
            return [
                StatedTransform(text(one, _TYPE), numbers(one, _PARAMETERS), numbers(one, _FIXED)) for one in groups
            ]
    except _DAMAGED as error:
        what = f"not a complete HDF5 file ({str(error)[:120]})"
        raise InputError(what, where=where, allowed=ALLOWED, code="file_damaged") from error


def _list_of(data: Any, where: str) -> Floats:
    """The numbers of a dataset; none where they are too many for a linear transform."""
    if data.size > MAX_NUMBERS:
        return np.empty(0)
    if data.dtype not in (np.float64, np.float32) or data.ndim != 1:
        what = f"{data.name} of {data.dtype} with shape {data.shape}"
        refuse(what, where, "a list of floats or doubles", "wrong_type")
    return np.asarray(data[()], dtype=np.float64)


def _numbered(parent: Collection[str], where: str) -> list[str]:
    """The names of a file's transforms, ``0``, ``1``, ...: all that its group holds."""
    if not 0 < len(parent) <= MAX_PARTS + 1:
        allowed = f"1, or at most {MAX_PARTS} parts of a CompositeTransform"
        refuse(f"{len(parent)} transforms", where, allowed, "wrong_count")
    names = [str(number) for number in range(len(parent))]
    if set(parent) != set(names):
        what = f"{_GROUP} with {', '.join(sorted(parent))[:60]}"
        refuse(what, where, f"transforms numbered {', '.join(names)}", "wrong_format")
    return names


def heap_text(content: bytes, offset: int | None) -> str:
    """A text of variable length, from the collection of the global heap that holds it.

    At ``offset`` are its length (4 bytes), the collection's address (8) and the object's number (4).
    Source: HDF5 file format, version 3, III.E "Disk format: global heap", IV.B "variable-length datatypes".
    """
    if offset is None:
        raise ValueError("a text outside contiguous storage")
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
