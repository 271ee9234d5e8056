"""The one gate before compiled code: whatever passes is finite, in range, not empty and of a plausible size.

Collision libraries answer "free" for a mesh with a NaN vertex, and end the process for an index out of range
or an empty one; a registration that mirrors would put every organ on the wrong side. So every transform and set of
points, and every mesh, goes through here once, and inner code trusts what it gets.
"""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.arrays import any_masked, is_frozen
from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.base.text import check_name
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space

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
    """A rigid motion (4, 4), mm, that passed the guard, read-only: finite, a rotation, near the origin.

    Raises InputError: It is not a rotation with a translation; a mirrored one is named so, never repaired.
    """
    matrix = _float_array(T, what="transform", where=where, allowed=_TRANSFORM_ALLOWED)
    if matrix.shape != (4, 4):
        refuse(f"transform has shape {matrix.shape}", where, _TRANSFORM_ALLOWED, "wrong_shape")
    if not np.isfinite(matrix).all():
        refuse("transform has a value that is not finite", where, _TRANSFORM_ALLOWED, "not_finite")
    if not np.array_equal(matrix[3], [0.0, 0.0, 0.0, 1.0]):
        refuse(f"last row of the transform is {matrix[3].tolist()}", where, _TRANSFORM_ALLOWED, "not_rigid")
    R = matrix[:3, :3]
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
    if np.abs(matrix[:3, 3]).max() > MAX_COORDINATE_MM:
        limit = f"a translation within {MAX_COORDINATE_MM:g} mm"
        refuse(f"the transform moves by {matrix[:3, 3].tolist()} mm", where, limit, "too_far")
    matrix.setflags(write=False)
    return matrix


def guard_points(points: Many, names: Sequence[str], *, where: str | Path) -> NDArray[np.float64]:
    """Named points (n, 3), mm, any frame, that passed the guard, read-only: finite, near the origin, each name once.

    Raises InputError: No point, a name is missing, doubled, too long or not printable, a coordinate not finite or far.
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
    with refusing(ValueError, f"{what} is ragged", where, allowed, "wrong_shape"):  # rows of different length
        raw = np.asarray(values)
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


MAX_ROTATION_ENTRY = 1e3
"""Far above 1, so that what is a scaled or sheared matrix is named by its error; far below what overflows."""
MIN_DIAGONAL_MM = 0.5
"""Smallest bounding box diagonal of a structure: less than any vessel. An organ in metres is below."""
MAX_DIAGONAL_MM = 5_000.0
"""Largest diagonal: a body and its table fit. A body in mm that is declared as cm or m does not."""
FIRST_TRIANGLES = 16
"""First triangles, which nearly always answer whether any has an area, without a kernel."""
MAX_TRIANGLES = 20_000_000
"""Fifty times our finest whole body; more would only exhaust the memory (1.4 GB of corner coordinates)."""
_EXTENT_ALLOWED = (
    f"bounding box diagonal from {MIN_DIAGONAL_MM:g} to {MAX_DIAGONAL_MM:g} mm, "
    f"coordinates within {MAX_COORDINATE_MM:g} mm"
)


def guard_mesh(vertices: ArrayLike, faces: ArrayLike, *, where: str | Path) -> TriangleMesh:
    """A checked mesh of vertices (n, 3), mm, any frame, and faces (m, 3).

    Triangles of zero area are kept: their corners belong to the surface. Vertices that no triangle uses are left out,
    after they were checked like the others; the order of the rest, and of the triangles, stays. Raises InputError: not
    finite, an index out of range, an implausible size, or no area at all.
    """
    points = points_array(vertices, [], what="vertex", where=where)
    indices = _index_array(faces, len(points), where=where)
    farthest = float(max(-points.min(), points.max()))
    if farthest > MAX_COORDINATE_MM:
        refuse(f"a coordinate lies {farthest:.6g} mm from the origin", where, _EXTENT_ALLOWED, "too_far")
    diagonal = _diagonal(points)
    if diagonal > MAX_DIAGONAL_MM:
        hint = "looks like mm declared as cm or m, or an outlier vertex"
        refuse(f"bounding box diagonal of {diagonal:.6g} mm: {hint}", where, _EXTENT_ALLOWED, "implausible_size")
    used = np.zeros(len(points), dtype=bool)
    used[indices.reshape(-1)] = True
    if not used.all():
        points, indices = points[used], (np.cumsum(used, dtype=np.int32) - np.int32(1))[indices]
    points.setflags(write=False)  # nobody else has it: it is taken as it is
    mesh = TriangleMesh(points, indices)
    diagonal = _diagonal(mesh.vertices)
    if diagonal < MIN_DIAGONAL_MM:
        hint = "looks like metres declared as mm" if diagonal > 0.0 else "all corners in one place"
        refuse(f"bounding box diagonal of {diagonal:.4g} mm: {hint}", where, _EXTENT_ALLOWED, "implausible_size")
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[:FIRST_TRIANGLES]], 1, 0)
    if not (np.linalg.norm(np.cross(b - a, c - a), axis=1).any() or mesh.areas.any()):
        what = f"none of the {len(indices)} triangles has an area"
        refuse(what, where, "at least one triangle with an area", "no_area")
    return mesh


def fits(mesh: TriangleMesh) -> bool:
    """Whether a mesh, mm, is no larger than one that `guard_mesh` accepts."""
    return _diagonal(mesh.vertices) <= MAX_DIAGONAL_MM


def _index_array(faces: ArrayLike, n_vertices: int, *, where: str | Path) -> NDArray[np.int32]:
    allowed = f"three whole numbers from 0 to {n_vertices - 1} per triangle, 1 to {MAX_TRIANGLES} triangles"
    with refusing(ValueError, "face list is ragged", where, allowed, "wrong_shape"):
        raw = np.asarray(faces)
    if raw.size == 0:
        refuse("no triangle", where, allowed, "empty")
    if raw.ndim != 2 or raw.shape[1] != 3:
        refuse(f"face list has shape {raw.shape}", where, allowed, "wrong_shape")
    if len(raw) > MAX_TRIANGLES:
        refuse(f"{len(raw)} triangles", where, allowed, "too_many")
    whole = raw.dtype.kind in "iu" or (raw.dtype.kind == "f" and np.array_equal(raw, np.trunc(raw)))
    if not whole:  # NaN differs from itself and infinity is out of range, so neither passes
        refuse("a vertex index is not a whole number", where, allowed, "not_whole")
    low, high = raw.min(), raw.max()
    if low < 0 or high >= n_vertices:
        bad = low if low < 0 else high
        row = int(np.argmax((raw == bad).any(axis=1)))
        refuse(f"triangle {row} uses vertex {bad:g}, which is out of range", where, allowed, "index_out_of_range")
    return np.ascontiguousarray(raw, dtype=np.int32)


def _diagonal(points: NDArray[np.float64]) -> float:
    columns = (points[:, axis] for axis in range(3))  # one by one: numpy is five times slower with axis=0
    return float(np.linalg.norm([np.ptp(column) for column in columns]))


MAX_TOKEN_LENGTH = 64
"""Most characters of a token: longer than a double with all of its digits and exponent (24)."""
MAX_VERTICES = 3 * MAX_TRIANGLES
"""Most vertices: as many as the most triangles have corners."""


class RawMesh(NamedTuple):
    """One surface as its file states it; the guard has not seen it yet."""

    vertices: NDArray[np.float64]  # shape (n, 3), in the file's unit and space
    faces: NDArray[np.int64]  # shape (m, 3), indices into ``vertices``
    space: Space | None = None  # what the file says of its axes, None if nothing


def token_array(tokens: list[str], where: str) -> NDArray[np.str_]:
    """Tokens (n,) as an array of their widest one's width. Raises InputError: one is longer than any number or word."""
    longest = max(tokens, key=len, default="")
    if len(longest) > MAX_TOKEN_LENGTH:
        refuse(f"a word of {len(longest)} characters", where, f"numbers of at most {MAX_TOKEN_LENGTH}", "word_too_long")
    return np.array(tokens, dtype=np.str_)


def triangulate(
    corners: NDArray[np.int64], counts: NDArray[np.int64], where: str, *, strips: bool = False
) -> NDArray[np.int64]:
    """Triangles (m, 3) of polygons: each a fan from its first corner, which is exact for convex ones; or of strips.

    Of the vertex indices of all polygons, one after the other, shape (k,), and how many each has, shape (p,), in all k.
    In a strip every three corners that follow one another are a triangle, every second one seen from behind. Raises
    InputError: a polygon of fewer than three corners, or too many triangles.
    """
    if len(counts) == 0:
        refuse("no face", where, "at least one triangle", "empty")
    if counts.min() < 3:
        what = f"face {int(np.argmin(counts))} has {counts.min()} corners"
        refuse(what, where, "3 or more corners per face", "wrong_count")
    if (counts == 3).all():
        return corners.reshape(-1, 3)
    total = int(counts.sum() - 2 * len(counts))
    if total > MAX_TRIANGLES:
        refuse(f"{total} triangles", where, f"at most {MAX_TRIANGLES}", "too_many")
    start = np.repeat(np.cumsum(counts) - counts, counts - 2)
    step = np.arange(total) - np.repeat(np.cumsum(counts - 2) - (counts - 2), counts - 2)
    is_odd = step % 2
    first, second = (start + step + is_odd, start + step + 1 - is_odd) if strips else (start, start + step + 1)
    return np.stack([corners[first], corners[second], corners[start + step + 2]], axis=1)


def join(parts: list[RawMesh]) -> RawMesh:
    """Several parts as one surface, in their order; nothing is welded."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    return RawMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
