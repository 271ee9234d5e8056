"""How a list of markers lies on the skin: signed gaps, their common height, and what is left over."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.triangle_distance import squared_distance

MARKER_ON_SKIN_MM = 30.0
"""A skin marker's centre lies within its own height of the skin; one farther off stands on a frame, or is misread."""


@dataclass(frozen=True, eq=False)
class SkinFit:
    """Markers against the skin.

    Attributes:
        gaps_mm: Shape (n,), distance from the skin, negative inside the body (of an open skin that is not known).
        normals_ct: Shape (n, 3), unit vectors out of the skin at its nearest triangle.
    """

    gaps_mm: Floats
    normals_ct: Floats

    @property
    def on_skin(self) -> bool:
        """Whether every marker is within its own height of the skin."""
        return bool(np.all(np.abs(self.gaps_mm) <= MARKER_ON_SKIN_MM))

    @property
    def scatter_mm(self) -> float:
        """Root mean square of what is left of the gaps by the best common height of the markers, n - 1 degrees."""
        height = np.clip(self.gaps_mm.mean(), 0.0, MARKER_ON_SKIN_MM)
        return float(np.sqrt(np.sum((self.gaps_mm - height) ** 2) / (len(self.gaps_mm) - 1)))


def skin_fit(points_ct: Floats, skin: Skin) -> SkinFit:
    """Measure markers from the skin; where the body was cut there is none.

    Args:
        points_ct: Shape (n, 3), mm.
        skin: Of the case.
    """
    triangles = skin.mesh.triangles[~skin.cut_faces]
    centres = triangles.mean(axis=1)
    reach = np.linalg.norm(triangles - centres[:, None], axis=2).max()
    outward = _orientation(skin)
    gaps, normals = np.empty(len(points_ct)), np.empty((len(points_ct), 3))
    for row, point in enumerate(points_ct):
        from_centres = np.linalg.norm(centres - point, axis=1)
        near = triangles[from_centres <= from_centres.min() + reach]  # holds the nearest one
        squares = squared_distance(point, near)
        inside = side_of(skin.mesh, point) is Side.INSIDE
        gaps[row] = np.sqrt(squares.min()) * (-1.0 if inside else 1.0)
        normals[row] = outward * _normal(near[int(np.argmin(squares))])
    return SkinFit(gaps, normals)


def kept_skin_fit(points_ct: Floats, skin: Skin, cache: Cache) -> SkinFit:
    """`skin_fit`, from the cache where it is there; no target decides it."""
    cut = hashlib.sha256(skin.cut_faces.tobytes()).hexdigest()
    made_from = {"what": "skin fit", "skin": skin.mesh.digest, "cut": cut, "points": points_ct.tolist()}
    stored = cache.arrays(made_from, lambda: vars(skin_fit(points_ct, skin)), by=__name__)
    return SkinFit(**stored)


def _orientation(skin: Skin) -> float:
    """1 where the triangles' normals point out of the body, -1 where they point into it."""
    a, b, c = np.moveaxis(skin.mesh.triangles - skin.mesh.bounds.mean(axis=0), 1, 0)
    return 1.0 if np.einsum("ij,ij->", a, np.cross(b, c)) >= 0 else -1.0


def _normal(triangle: Floats) -> Floats:
    normal = np.cross(triangle[1] - triangle[0], triangle[2] - triangle[0])
    length = np.linalg.norm(normal)
    return np.asarray(normal / length) if length > 0 else np.array([0.0, 0.0, 1.0])
