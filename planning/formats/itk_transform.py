"""Linear transforms of ITK, as text (.tfm, .txt): what 3D Slicer, SimpleITK and ANTs write.

A file states what ``TransformPoint`` does: y = M (x - c) + c + t, with x and y in LPS mm; the parameters are M by rows
and then t, the fixed parameters the centre c. Which frame x is in, no file says.
Source: ITK, MatrixOffsetTransformBase; Slicer's developer guide, "Transforms": a node's file goes from its parent.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.formats.raw_mesh import decode_text, refuse
from puncture_twin.planning.geometry.rigid import pose

MAX_FILE_BYTES = 100_000
"""A linear transform has 15 numbers; a larger file holds another one."""
ENDINGS = (".tfm", ".txt")
_HEADER = "#Insight Transform File V1.0"
_LINEAR = re.compile(r"(AffineTransform|MatrixOffsetTransformBase)_(double|float)_3_3")
_ALLOWED = (
    "an ITK transform file (.tfm) with one AffineTransform of three dimensions, as Slicer saves a linear transform"
)
_SAVE_AS_TFM = (
    "the same transform as text: in Slicer, Save with the file format .tfm; in SimpleITK, WriteTransform(T, 'x.tfm')"
)


def parse_transform(data: bytes, path: Path) -> Floats:
    """The rigid motion of a file: what it does to a point, shape (4, 4), mm.

    Args:
        data: The whole file.
        path: Its name.

    Raises:
        InputError: Another format or kind of transform, several of them, or one that is not rigid.
    """
    if not path.name.lower().endswith(ENDINGS):
        binary = path.suffix.lower() in (".h5", ".hdf5", ".mat")
        allowed = _SAVE_AS_TFM if binary else _ALLOWED
        raise InputError(f"transform file of the kind {path.suffix!r}", where=path, allowed=allowed)
    name = str(path)
    lines = [line.strip() for line in decode_text(data, name).splitlines() if line.strip()]
    if not lines or lines[0] != _HEADER:
        refuse("no ITK transform file", name, _ALLOWED)
    stated = _stated(lines[1:], name)
    kind = stated.get("Transform", "")
    if _LINEAR.fullmatch(kind) is None:
        refuse(f"transform of type {kind[:60]!r}", name, _ALLOWED)
    numbers, centre = _numbers(stated, "Parameters", 12, name), _numbers(stated, "FixedParameters", 3, name)
    M = numbers[:9].reshape(3, 3)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused
        T = pose(M, numbers[9:] + centre - M @ centre)
    return guard_transform(T, where=path)


def _stated(lines: list[str], where: str) -> dict[str, str]:
    """The values of the one transform by their keys."""
    stated: dict[str, str] = {}
    for line in lines:
        if line.startswith("#"):
            continue
        key, mark, value = line.partition(":")
        if not mark or key in stated:
            what = "several transforms: harden them into one" if key == "Transform" else f"line {line[:60]!r}"
            refuse(what, where, _ALLOWED)
        stated[key] = value.strip()
    return stated


def _numbers(stated: dict[str, str], key: str, count: int, where: str) -> Floats:
    words = stated.get(key, "").split()
    if len(words) != count or any("_" in word for word in words):
        refuse(f"{len(words)} {key}", where, f"{count} numbers")
    try:
        return np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"{key} are no numbers ({error})", where=where, allowed=_ALLOWED) from error


def transform_text(T: Floats) -> str:
    """The file of a motion that does this to a point, shape (4, 4), mm; it reads back to the same numbers.

    >>> print(transform_text(np.eye(4)).splitlines()[2])
    Transform: AffineTransform_double_3_3
    """
    numbers = " ".join(map(repr, [*T[:3, :3].ravel().tolist(), *T[:3, 3].tolist()]))
    return (
        f"{_HEADER}\n#Transform 0\nTransform: AffineTransform_double_3_3\nParameters: {numbers}\n"
        "FixedParameters: 0 0 0\n"
    )
