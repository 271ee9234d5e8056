"""Linear transforms as ITK parametrises them, and the one matrix that they are together.

Each states what ``TransformPoint`` does: y = M (x - c) + c + t, with x and y in LPS mm, M from the parameters and the
centre of rotation c from the fixed ones. A composite applies its last part first.
Source: ITK, MatrixOffsetTransformBase, Euler3DTransform (M = Rz Rx Ry, or Rz Ry Rx where its flag says ZYX),
VersorRigid3DTransform, CompositeTransform.
"""

from __future__ import annotations

import re
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.raw_mesh import refuse
from puncture_twin.planning.geometry.rigid import pose

MAX_PARTS = 20
"""A chain of registrations has a handful of parts."""
ALLOWED = (
    "an ITK transform file (.tfm, .h5) with one AffineTransform, Euler3DTransform or VersorRigid3DTransform of three "
    "dimensions, as Slicer saves a linear transform, or a CompositeTransform of them"
)
_COMPOSITE = re.compile(r"CompositeTransform_(double|float)_3_3")
_LINEAR = re.compile(
    r"(AffineTransform|MatrixOffsetTransformBase|Euler3DTransform|VersorRigid3DTransform)_(double|float)_3_3"
)
_SIZES = {"Euler3DTransform": (6, (3, 4)), "VersorRigid3DTransform": (6, (3,))}
"""Parameters, and fixed parameters; Euler's flag for ZYX is missing in files of ITK 4."""
_MATRIX_SIZES = (12, (3,))
_VERSOR_EDGE = 1e-10
"""ITK shortens a versor that is this near to length 1 or above; what it does to points is what a file means."""
_VERSOR_SLACK = 1e-6
"""Longer by more than what single precision rounds: no rotation."""


class StatedTransform(NamedTuple):
    """One transform as a file states it.

    Attributes:
        kind: ITK's name with precision and dimensions, such as ``AffineTransform_double_3_3``.
        parameters: Shape (n,).
        fixed: Shape (m,): the centre of rotation, mm, LPS; of Euler angles also the flag for their order.
    """

    kind: str
    parameters: Floats
    fixed: Floats


def linear_motion(stated: list[StatedTransform], where: str) -> Floats:
    """What the transforms of one file do to a point, shape (4, 4), mm; whether it is rigid is not looked at.

    Raises:
        InputError: None, several that are no composite, or one of another kind or with other parameters.
    """
    if len(stated) > MAX_PARTS + 1:
        refuse(f"{len(stated)} transforms", where, f"at most {MAX_PARTS} parts of a CompositeTransform")
    parts = stated[1:] if stated and _COMPOSITE.fullmatch(stated[0].kind) else stated
    if not parts:
        refuse("no linear transform", where, ALLOWED)
    T = np.eye(4)
    for part in parts:
        _check_kind(part.kind, where)
    if len(parts) > 1 and parts is stated:
        refuse("several transforms: harden them into one", where, ALLOWED)
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is refused by the guard
        for part in parts:
            T = T @ _motion(part, where)
    return T


def _check_kind(kind: str, where: str) -> None:
    if _LINEAR.fullmatch(kind) is None:
        refuse(f"transform of type {kind[:60]!r}", where, ALLOWED)


def _motion(stated: StatedTransform, where: str) -> Floats:
    """Of one part, shape (4, 4)."""
    name = stated.kind.partition("_")[0]
    count, fixed_counts = _SIZES.get(name, _MATRIX_SIZES)
    _check_count(stated.parameters, (count,), "Parameters", where)
    _check_count(stated.fixed, fixed_counts, "FixedParameters", where)
    if name == "Euler3DTransform":
        M = _euler(stated.parameters[:3], zyx=bool(stated.fixed[3:].any()))
    elif name == "VersorRigid3DTransform":
        M = _versor(stated.parameters[:3], where)
    else:
        M = stated.parameters[:9].reshape(3, 3)
    centre = stated.fixed[:3]
    return pose(M, stated.parameters[-3:] + centre - M @ centre)


def _check_count(numbers: Floats, counts: tuple[int, ...], key: str, where: str) -> None:
    if len(numbers) not in counts:
        refuse(f"{len(numbers)} {key}", where, " or ".join(f"{count}" for count in counts) + " numbers")


def _euler(angles: Floats, *, zyx: bool) -> Floats:
    """Rotation of the angles about x, y and z, rad."""
    x, y, z = (_about(axis, angle) for axis, angle in enumerate(angles))
    product: Floats = z @ y @ x if zyx else z @ x @ y
    return product


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
        refuse(f"a versor of length {length:.9g}", where, "the vector part of a unit quaternion: at most 1")
    if length >= 1.0 - _VERSOR_EDGE:
        v = v / (length * (1.0 + _VERSOR_EDGE))
    (x, y, z), w = v, np.sqrt(1.0 - v @ v)
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    R: Floats = np.eye(3) + 2.0 * (w * cross + cross @ cross)
    return R
