"""The gate for meshes before compiled code: one that passes is finite, in range, not empty and of a plausible size.

Collision libraries answer "free" for a mesh with a NaN vertex, and end the process for an index out of range or an
empty one.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.formats.guard import MAX_COORDINATE_MM, points_array
from puncture_twin.planning.geometry.mesh import TriangleMesh

MIN_DIAGONAL_MM = 0.5
"""Smallest bounding box diagonal of a structure: less than any vessel. An organ in metres is below."""
MAX_DIAGONAL_MM = 5_000.0
"""Largest one: a body and its table fit. A body in mm that is declared as cm or m does not."""
FIRST = 16
"""Triangles that nearly always answer whether any has an area, without a kernel."""
MAX_TRIANGLES = 20_000_000
"""Fifty times our finest whole body; more would only exhaust the memory (1.4 GB of corner coordinates)."""

_EXTENT_ALLOWED = (
    f"bounding box diagonal from {MIN_DIAGONAL_MM:g} to {MAX_DIAGONAL_MM:g} mm, "
    f"coordinates within {MAX_COORDINATE_MM:g} mm"
)


def guard_mesh(vertices: ArrayLike, faces: ArrayLike, *, where: str | Path) -> TriangleMesh:
    """Check a mesh: finite, indices in range, of a plausible size, with an area; and return it.

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
    points = points_array(vertices, [], what="vertex", where=where)
    indices = _index_array(faces, len(points), where=where)
    _check_not_huge(points, where=where)
    mesh = _without_unused(points, indices)
    _check_not_tiny(mesh.vertices, where=where)
    if not (_areas(mesh.vertices[mesh.faces[:FIRST]]).any() or mesh.areas.any()):
        what = f"none of the {len(indices)} triangles has an area"
        refuse(what, where, "at least one triangle with an area", "no_area")
    return mesh


def fits(mesh: TriangleMesh) -> bool:
    """Whether a mesh, mm, is no larger than one that `guard_mesh` accepts."""
    return _diagonal(mesh.vertices) <= MAX_DIAGONAL_MM


def _areas(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Twice those of a few triangles, shape (m, 3, 3), mm."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1))


def _index_array(faces: ArrayLike, n_vertices: int, *, where: str | Path) -> NDArray[np.int32]:
    allowed = f"three whole numbers from 0 to {n_vertices - 1} per triangle, 1 to {MAX_TRIANGLES} triangles"
    try:
        raw = np.asarray(faces)
    except ValueError as error:  # what numpy raises for rows of different length
        raise InputError(f"face list is ragged ({error})", where=where, allowed=allowed, code="wrong_shape") from error
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


def _without_unused(points: NDArray[np.float64], indices: NDArray[np.int32]) -> TriangleMesh:
    used = np.zeros(len(points), dtype=bool)
    used[indices.reshape(-1)] = True
    if not used.all():
        points, indices = points[used], (np.cumsum(used, dtype=np.int32) - np.int32(1))[indices]
    points.setflags(write=False)  # nobody else has it: it is taken as it is
    return TriangleMesh(points, indices)


def _diagonal(points: NDArray[np.float64]) -> float:
    columns = (points[:, axis] for axis in range(3))  # one by one: numpy is five times slower with axis=0
    return float(np.linalg.norm([np.ptp(column) for column in columns]))


def _check_not_huge(points: NDArray[np.float64], *, where: str | Path) -> None:
    farthest = float(max(-points.min(), points.max()))
    if farthest > MAX_COORDINATE_MM:
        refuse(f"a coordinate lies {farthest:.6g} mm from the origin", where, _EXTENT_ALLOWED, "too_far")
    diagonal = _diagonal(points)
    if diagonal > MAX_DIAGONAL_MM:
        hint = "looks like mm declared as cm or m, or an outlier vertex"
        refuse(f"bounding box diagonal of {diagonal:.6g} mm: {hint}", where, _EXTENT_ALLOWED, "implausible_size")


def _check_not_tiny(used: NDArray[np.float64], *, where: str | Path) -> None:
    diagonal = _diagonal(used)
    if diagonal < MIN_DIAGONAL_MM:
        hint = "looks like metres declared as mm" if diagonal > 0.0 else "all corners in one place"
        refuse(f"bounding box diagonal of {diagonal:.4g} mm: {hint}", where, _EXTENT_ALLOWED, "implausible_size")
