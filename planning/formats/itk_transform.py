"""Linear transforms of ITK, as text (.tfm, .txt) or HDF5 (.h5): what 3D Slicer, SimpleITK and ANTs write.

Which frame a transform's points are in, no file says.
Source: ITK, TxtTransformIO; Slicer's developer guide, "Transforms": a node's file goes from its parent.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.input_file import decode_text
from puncture_twin.planning.formats.guard import guard_transform
from puncture_twin.planning.formats.itk_hdf5 import hdf5_transforms
from puncture_twin.planning.formats.itk_linear import ALLOWED, StatedTransform, linear_motion
from puncture_twin.planning.formats.raw_mesh import refuse

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
    """How large a transform file may be, by its ending."""
    return MAX_HDF5_BYTES if name.lower().endswith(HDF5_ENDINGS) else MAX_TEXT_BYTES


def parse_transform(data: bytes, path: Path) -> Floats:
    """The rigid motion of a file: what it does to a point, shape (4, 4), mm.

    Args:
        data: The whole file.
        path: Its name.

    Raises:
        InputError: Another format or kind of transform, several of them, or one that is not rigid.
    """
    name = str(path)
    if name.lower().endswith(HDF5_ENDINGS):
        stated = hdf5_transforms(data, name)
    elif name.lower().endswith(TEXT_ENDINGS):
        stated = _text_transforms(data, name)
    else:
        raise InputError(f"transform file of the kind {path.suffix!r}", where=path, allowed=ALLOWED)
    return guard_transform(linear_motion(stated, name), where=path)


def _text_transforms(data: bytes, where: str) -> list[StatedTransform]:
    """The transforms of a text, in its order."""
    lines = [line.strip() for line in _LINE_END.split(decode_text(data, where)) if line.strip()]
    if not lines or lines[0] != _HEADER:
        refuse("no ITK transform file", where, ALLOWED)
    return [StatedTransform(kind, *(_numbers(one, key, where) for key in _KEYS)) for kind, one in _blocks(lines, where)]


def _blocks(lines: list[str], where: str) -> list[tuple[str, dict[str, str]]]:
    """The kind of each transform, and its values by their keys."""
    blocks: list[tuple[str, dict[str, str]]] = []
    for line in lines:
        key, mark, value = (part.strip() for part in line.partition(":"))
        if line.startswith("#"):
            continue
        if key == "Transform":
            blocks.append((value, {}))
        elif not blocks or key not in _KEYS or not mark or key in blocks[-1][1]:
            refuse(f"line {line[:60]!r}", where, ALLOWED)
        else:
            blocks[-1][1][key] = value
    return blocks


def _numbers(stated: dict[str, str], key: str, where: str) -> Floats:
    words = stated.get(key, "").split()
    try:
        return np.array([float(word if _NUMBER.fullmatch(word) else f"no number {word}") for word in words])
    except ValueError as error:
        raise InputError(f"{key} are no numbers ({str(error)[:80]})", where=where, allowed=ALLOWED) from error


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
