"""The one gate before compiled code: whatever passes is finite, in range, not empty and of a plausible size.

Collision libraries answer "free" for a mesh with a NaN vertex, and end the process for an index out of range
or an empty one; a registration that mirrors would put every organ on the wrong side. So every mesh, transform
and set of points goes through here, once, and inner code trusts what it gets.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.text_names import check_name
from puncture_twin.planning.geometry.mesh import TriangleMesh

MIN_DIAGONAL_MM = 0.5
"""Smallest bounding box diagonal of a structure: less than any vessel. An organ in metres is below."""
MAX_DIAGONAL_MM = 5_000.0
"""Largest one: a body and its table fit. A body in mm that is declared as cm or m does not."""
MAX_COORDINATE_MM = 100_000.0
"""Farthest from the origin: no room is 100 m wide; beyond, a sentinel value or a broken float is likely."""
MAX_TRIANGLES = 20_000_000
"""Fifty times our finest whole body; more would only exhaust the memory (1.4 GB of corner coordinates)."""
ROTATION_TOLERANCE = 1e-5
"""Largest entry of |R^T R - I|: files write 6 to 7 digits; at 500 mm this still is only 0.005 mm."""

_EXTENT_ALLOWED = (
    f"bounding box diagonal from {MIN_DIAGONAL_MM:g} to {MAX_DIAGONAL_MM:g} mm, "
    f"coordinates within {MAX_COORDINATE_MM:g} mm"
)
_TRANSFORM_ALLOWED = (
    "a rigid 4x4 transform: rotation with determinant +1, translation in mm, last row 0 0 0 1, "
    f"R^T R = 1 to {ROTATION_TOLERANCE:g}"
)


def guard_mesh(vertices: ArrayLike, faces: ArrayLike, *, where: str | Path) -> TriangleMesh:
    """A mesh that may be trusted, or an error.

    Triangles of zero area are all kept: their corners still belong to the surface, and dropping them would
    change counts; ``mesh_files.mesh_warnings`` counts them. Only a mesh without any area is refused.
    Vertices that no triangle uses are left out, after they were checked like the others, so that the bounds
    are those of the surface; the order of the rest, and of the triangles, stays.

    Args:
        vertices: Shape (n, 3), mm, any frame.
        faces: Shape (m, 3), whole numbers, indices into ``vertices``.
        where: The file and the place in it, for the error.

    Raises:
        InputError: If it is empty, not finite, out of range, without area, or of an implausible size.
    """
    points = _points_array(vertices, [], what="vertex", where=where)
    indices = _index_array(faces, len(points), where=where)
    _check_not_huge(points, where=where)
    surface = _without_unused(points, indices)
    _check_not_tiny(surface.points, where=where)
    if not _any_area(surface):
        _refuse(f"none of the {len(indices)} triangles has an area", where, "at least one triangle with an area")
    return TriangleMesh(surface.points, surface.indices)


def fits(mesh: TriangleMesh) -> bool:
    """Whether a mesh, mm, is no larger than one that `guard_mesh` accepts."""
    return _diagonal(mesh.vertices) <= MAX_DIAGONAL_MM


def guard_transform(T: ArrayLike, *, where: str | Path) -> NDArray[np.float64]:
    """A rigid motion that may be trusted, or an error.

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
        _refuse(f"transform has shape {matrix.shape}", where, _TRANSFORM_ALLOWED)
    if not np.isfinite(matrix).all():
        _refuse("transform holds a value that is not finite", where, _TRANSFORM_ALLOWED)
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        _refuse(f"last row of the transform is {matrix[3].tolist()}", where, _TRANSFORM_ALLOWED)
    _check_rotation(matrix[:3, :3], where=where)
    if np.abs(matrix[:3, 3]).max() > MAX_COORDINATE_MM:
        limit = f"a translation within {MAX_COORDINATE_MM:g} mm"
        _refuse(f"the transform moves by {matrix[:3, 3].tolist()} mm", where, limit)
    matrix.setflags(write=False)
    return matrix


def guard_points(points: ArrayLike, names: Sequence[str], *, where: str | Path) -> NDArray[np.float64]:
    """Named points that may be trusted, or an error.

    Args:
        points: Shape (n, 3), mm, any frame.
        names: One per point: unique, not empty.
        where: The file, for the error.

    Returns:
        Shape (n, 3), float64, mm, read-only.

    Raises:
        InputError: If there is no point, a name is missing, doubled, too long or not printable, or a coordinate is not
            finite or too far.
    """
    allowed = "one printable name per point, not empty and used once"
    array = _points_array(points, names, what="point", where=where)
    if len(names) != len(array):
        _refuse(f"{len(names)} names for {len(array)} points", where, allowed)
    for number, name in enumerate(names, start=1):
        check_name(name, f"point {number}", where=where)
    for name, count in Counter(names).items():
        if count > 1:
            _refuse(f"the name {name!r} is used {count} times", where, allowed)
    far = np.abs(array).max(axis=1) > MAX_COORDINATE_MM
    if far.any():
        row = int(np.argmax(far))
        message = f"point {names[row]!r} lies at {array[row].tolist()} mm"
        _refuse(message, where, f"coordinates within {MAX_COORDINATE_MM:g} mm")
    array.setflags(write=False)
    return array


def twice_areas(points: NDArray[np.float64], indices: NDArray[np.int32]) -> NDArray[np.float64]:
    """Twice the area of each triangle, shape (m,), mm^2, for vertices (n, 3) in mm and indices (m, 3)."""
    a, b, c = points[indices[:, 0]], points[indices[:, 1]], points[indices[:, 2]]
    areas: NDArray[np.float64] = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return areas


class _Surface(NamedTuple):
    points: NDArray[np.float64]
    indices: NDArray[np.int32]


def _refuse(what: str, where: str | Path, allowed: str) -> NoReturn:
    raise InputError(what, where=where, allowed=allowed)


def _float_array(values: ArrayLike, *, what: str, where: str | Path, allowed: str) -> NDArray[np.float64]:
    try:
        raw = np.asarray(values)
    except ValueError as error:  # what numpy raises for rows of different length
        raise InputError(f"{what} is ragged ({error})", where=where, allowed=allowed) from error
    if raw.dtype.kind not in "iuf":
        _refuse(f"{what} holds values of type {raw.dtype}", where, allowed)
    return np.array(raw, dtype=np.float64, order="C")


def _points_array(points: ArrayLike, names: Sequence[str], *, what: str, where: str | Path) -> NDArray[np.float64]:
    allowed = f"three finite numbers per {what}, at least one {what}"
    array = _float_array(points, what=f"{what} list", where=where, allowed=allowed)
    if array.size == 0:
        _refuse(f"no {what}", where, allowed)
    if array.ndim != 2 or array.shape[1] != 3:
        _refuse(f"{what} list has shape {array.shape}", where, allowed)
    finite = np.isfinite(array)
    if not finite.all():
        row = int(np.argmin(finite.all(axis=1)))
        label = repr(names[row]) if row < len(names) else str(row)
        _refuse(f"{what} {label} is not finite: {array[row].tolist()}", where, allowed)
    return array


def _index_array(faces: ArrayLike, n_vertices: int, *, where: str | Path) -> NDArray[np.int32]:
    allowed = f"three whole numbers from 0 to {n_vertices - 1} per triangle, 1 to {MAX_TRIANGLES} triangles"
    try:
        raw = np.asarray(faces)
    except ValueError as error:  # what numpy raises for rows of different length
        raise InputError(f"face list is ragged ({error})", where=where, allowed=allowed) from error
    if raw.size == 0:
        _refuse("no triangle", where, allowed)
    if raw.ndim != 2 or raw.shape[1] != 3:
        _refuse(f"face list has shape {raw.shape}", where, allowed)
    if len(raw) > MAX_TRIANGLES:
        _refuse(f"{len(raw)} triangles", where, allowed)
    whole = raw.dtype.kind in "iu" or (raw.dtype.kind == "f" and np.array_equal(raw, np.trunc(raw)))
    if not whole:  # NaN differs from itself and infinity is out of range, so neither passes
        _refuse("a vertex index is not a whole number", where, allowed)
    low, high = raw.min(), raw.max()
    if low < 0 or high >= n_vertices:
        bad = low if low < 0 else high
        row = int(np.argmax((raw == bad).any(axis=1)))
        _refuse(f"triangle {row} uses vertex {bad:g}, which is out of range", where, allowed)
    return np.ascontiguousarray(raw, dtype=np.int32)


def _without_unused(points: NDArray[np.float64], indices: NDArray[np.int32]) -> _Surface:
    used = np.zeros(len(points), dtype=bool)
    used[indices.reshape(-1)] = True
    if used.all():
        return _Surface(points, indices)
    renumbered = np.cumsum(used, dtype=np.int32) - np.int32(1)
    return _Surface(points[used], renumbered[indices])


def _diagonal(points: NDArray[np.float64]) -> float:
    columns = (points[:, axis] for axis in range(3))  # one by one: numpy is five times slower with axis=0
    return float(np.linalg.norm([np.ptp(column) for column in columns]))


def _check_not_huge(points: NDArray[np.float64], *, where: str | Path) -> None:
    farthest = float(max(-points.min(), points.max()))
    if farthest > MAX_COORDINATE_MM:
        _refuse(f"a coordinate lies {farthest:.6g} mm from the origin", where, _EXTENT_ALLOWED)
    diagonal = _diagonal(points)
    if diagonal > MAX_DIAGONAL_MM:
        hint = "looks like mm declared as cm or m, or a stray vertex"
        _refuse(f"bounding box diagonal of {diagonal:.6g} mm: {hint}", where, _EXTENT_ALLOWED)


def _check_not_tiny(used: NDArray[np.float64], *, where: str | Path) -> None:
    diagonal = _diagonal(used)
    if diagonal < MIN_DIAGONAL_MM:
        hint = "looks like metres declared as mm" if diagonal > 0.0 else "all corners in one place"
        _refuse(f"bounding box diagonal of {diagonal:.4g} mm: {hint}", where, _EXTENT_ALLOWED)


def _any_area(surface: _Surface) -> bool:
    """Whether any triangle has an area: looked at in chunks, since the first nearly always answers."""
    step = 4096
    chunks = (surface.indices[i : i + step] for i in range(0, len(surface.indices), step))
    return any(bool((twice_areas(surface.points, chunk) > 0.0).any()) for chunk in chunks)


def _check_rotation(R: NDArray[np.float64], *, where: str | Path) -> None:
    largest = float(np.abs(R).max())
    if not largest <= MAX_ROTATION_ENTRY:  # squares of huge entries are infinite, and their differences NaN
        _refuse(f"not a rotation: an entry of {largest:.3g}", where, _TRANSFORM_ALLOWED)
    determinant = float(np.linalg.det(R))
    if determinant < 0.0:
        what = f"the transform is mirrored (determinant {determinant:.4g}): it exchanges left and right"
        _refuse(what, where, _TRANSFORM_ALLOWED)
    error = float(np.abs(R.T @ R - np.eye(3)).max())
    if not error <= ROTATION_TOLERANCE:
        what = f"not a rotation: R^T R is off by {error:.3g}, determinant {determinant:.6g}"
        _refuse(what, where, _TRANSFORM_ALLOWED)


MAX_ROTATION_ENTRY = 1e3
"""Far above 1, so that what is a scaled or sheared matrix is named by its error; far below what overflows."""
