"""The one gate before compiled code: whatever passes is finite, in range, not empty and of a plausible size.

Collision libraries answer "free" for a mesh with a NaN vertex, and end the process for an index out of range
or an empty one; a registration that mirrors would put every organ on the wrong side. So every transform and set of
points goes through here, every mesh through `mesh_guard`, once, and inner code trusts what it gets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.arrays import any_masked, is_frozen
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.text import check_name

Many = ArrayLike | Sequence[ArrayLike]
"""An array, or a list of them."""

MAX_COORDINATE_MM = 100_000.0
"""Farthest from the origin: no workcell is 100 m wide; beyond, a sentinel value or a broken float is likely."""
ROTATION_TOLERANCE = 1e-5
"""Largest entry of |R^T R - I|: files write 6 to 7 digits; at 500 mm this still is only 0.005 mm."""

_TRANSFORM_ALLOWED = (
    "a rigid 4x4 transform: rotation with determinant +1, translation in mm, last row 0 0 0 1, "
    f"R^T R = 1 to {ROTATION_TOLERANCE:g}"
)


def guard_transform(T: ArrayLike, *, where: str | Path) -> NDArray[np.float64]:
    """A rigid motion that passed the guard: finite, a rotation, near the origin.

    Args:
        T: Shape (4, 4), maps coordinates between two frames, mm.
        where: The file and the place in it, for the error.

    Returns:
        The same numbers, float64, read-only.

    Raises:
        InputError: If it is not a rotation with a translation; a mirrored one is named so, never repaired.
    """
    matrix = _float_array(T, what="transform", where=where, allowed=_TRANSFORM_ALLOWED)
    if matrix.shape != (4, 4):
        refuse(f"transform has shape {matrix.shape}", where, _TRANSFORM_ALLOWED, "wrong_shape")
    if not np.isfinite(matrix).all():
        refuse("transform has a value that is not finite", where, _TRANSFORM_ALLOWED, "not_finite")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        refuse(f"last row of the transform is {matrix[3].tolist()}", where, _TRANSFORM_ALLOWED, "not_rigid")
    _check_rotation(matrix[:3, :3], where=where)
    if np.abs(matrix[:3, 3]).max() > MAX_COORDINATE_MM:
        limit = f"a translation within {MAX_COORDINATE_MM:g} mm"
        refuse(f"the transform moves by {matrix[:3, 3].tolist()} mm", where, limit, "too_far")
    matrix.setflags(write=False)
    return matrix


def guard_points(points: Many, names: Sequence[str], *, where: str | Path) -> NDArray[np.float64]:
    """Named points that passed the guard: finite, near the origin, each name once.

    Args:
        points: Shape (n, 3), mm, any frame.
        names: One per point: unique, not empty.

    Returns:
        Shape (n, 3), float64, mm, read-only.

    Raises:
        InputError: If there is no point, a name is missing, doubled, too long or not printable, or a coordinate is not
            finite or too far.
    """
    allowed = "one printable name per point, not empty, each used once"
    array = points_array(points, names, what="point", where=where)
    if len(names) != len(array):
        refuse(f"{len(names)} names for {len(array)} points", where, allowed, "wrong_count")
    for number, name in enumerate(names, start=1):
        check_name(name, f"point {number}", where=where)
    for name, count in Counter(names).items():
        if count > 1:
            refuse(f"the name {name!r} is used {count} times", where, allowed, "duplicate_name")
    far = np.abs(array).max(axis=1) > MAX_COORDINATE_MM
    if far.any():
        row = int(np.argmax(far))
        message = f"point {names[row]!r} lies at {array[row].tolist()} mm"
        refuse(message, where, f"coordinates within {MAX_COORDINATE_MM:g} mm", "too_far")
    array.setflags(write=False)
    return array


def _float_array(values: Many, *, what: str, where: str | Path, allowed: str) -> NDArray[np.float64]:
    try:
        raw = np.asarray(values)
    except ValueError as error:  # what numpy raises for rows of different length
        raise InputError(f"{what} is ragged ({error})", where=where, allowed=allowed, code="wrong_shape") from error
    if raw.dtype.kind not in "iuf":
        refuse(f"{what} has values of type {raw.dtype}", where, allowed, "wrong_type")
    if any_masked(values):
        refuse(f"{what} has a masked value", where, allowed, "not_finite")
    return raw if is_frozen(raw, np.float64) else np.array(raw, dtype=np.float64, order="C")


def points_array(points: Many, names: Sequence[str], *, what: str, where: str | Path) -> NDArray[np.float64]:
    """Points (n, 3), one or more, all finite; what each is, and its name, are in the error."""
    allowed = f"three finite numbers per {what}, at least one {what}"
    array = _float_array(points, what=f"{what} list", where=where, allowed=allowed)
    if array.size == 0:
        refuse(f"no {what}", where, allowed, "empty")
    if array.ndim != 2 or array.shape[1] != 3:
        refuse(f"{what} list has shape {array.shape}", where, allowed, "wrong_shape")
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argmin(finite.all(axis=1)))
        label = repr(names[row]) if row < len(names) else str(row)
        refuse(f"{what} {label} is not finite: {array[row].tolist()}", where, allowed, "not_finite")
    return array


def _check_rotation(R: NDArray[np.float64], *, where: str | Path) -> None:
    largest = float(np.abs(R).max())
    if not largest <= MAX_ROTATION_ENTRY:  # squares of huge entries are infinite, and their differences NaN
        refuse(f"not a rotation: an entry of {largest:.3g}", where, _TRANSFORM_ALLOWED, "not_rigid")
    determinant = float(np.linalg.det(R))
    if determinant < 0.0:
        what = f"the transform is mirrored (determinant {determinant:.4g}): it swaps left and right"
        refuse(what, where, _TRANSFORM_ALLOWED, "mirrored")
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if not error <= ROTATION_TOLERANCE:
        what = f"not a rotation: R^T R is off by {error:.3g}, determinant {determinant:.6g}"
        refuse(what, where, _TRANSFORM_ALLOWED, "not_rigid")


MAX_ROTATION_ENTRY = 1e3
"""Far above 1, so that what is a scaled or sheared matrix is named by its error; far below what overflows."""
