"""A mesh file's contents before unit, space and the guard: the common result of the readers of mesh files."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.mesh_guard import MAX_TRIANGLES
from puncture_twin.planning.geometry.spaces import Space

MAX_TOKEN_LENGTH = 64
"""Longer than a double with all of its digits and exponent (24)."""
MAX_VERTICES = 3 * MAX_TRIANGLES
"""As many as the most triangles have corners."""


class RawMesh(NamedTuple):
    """One surface as its file states it; the guard has not seen it yet.

    Attributes:
        vertices: Shape (n, 3), in the file's unit and space.
        faces: Shape (m, 3), indices into ``vertices``.
        space: What the file says of its axes, None if nothing.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    space: Space | None = None


def token_array(tokens: list[str], where: str) -> NDArray[np.str_]:
    """Tokens as an array of their widest one's width, shape (n,), which one endless token must not blow up.

    Raises:
        InputError: If a token is longer than any number or keyword.
    """
    longest = max(tokens, key=len, default="")
    if len(longest) > MAX_TOKEN_LENGTH:
        refuse(f"a word of {len(longest)} characters", where, f"numbers of at most {MAX_TOKEN_LENGTH}", "word_too_long")
    return np.array(tokens, dtype=np.str_)


def triangulate(corners: NDArray[np.int64], counts: NDArray[np.int64], where: str) -> NDArray[np.int64]:
    """Triangles of polygons: each a fan from its first corner, which is exact for convex ones.

    Args:
        corners: Shape (k,), the vertex indices of all polygons, one after the other.
        counts: Shape (p,), how many of them each polygon has; they sum to k.

    Returns:
        Shape (m, 3): count - 2 triangles per polygon, in the order of the polygons.

    Raises:
        InputError: If a polygon has fewer than three corners, or the triangles are too many.
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
    first = np.cumsum(counts) - counts
    triangle_first = np.cumsum(counts - 2) - (counts - 2)
    polygon = np.repeat(np.arange(len(counts)), counts - 2)
    step = np.arange(total) - triangle_first[polygon]
    start = first[polygon]
    return np.stack([corners[start], corners[start + step + 1], corners[start + step + 2]], axis=1)


def join(parts: list[RawMesh]) -> RawMesh:
    """Several parts as one surface, in their order; nothing is welded."""
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts[:-1]])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=True)]
    return RawMesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
