"""Simple bodies that the pictures need: needle, holder, ball, box, and the corridor of safe directions."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.geometry.mesh import TriangleMesh, box as box
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.twin.report.map_view import step_of

SECTIONS = 24
"""Sides of a round bar."""

LIFT_MM = 1.0
"""How far the corridor's mouth is drawn outside the skin, so that the two surfaces do not flicker."""

KEY = 1e-6
"""rad; corners of cells nearer than this are one corner."""


def bar(start_ct: Floats, end_ct: Floats, radius: float) -> TriangleMesh:
    """A closed round bar between two points, mm."""
    along = np.asarray(end_ct, float) - start_ct
    length = float(np.linalg.norm(along))
    outline = np.array([[0.0, 0.0], [radius, 0.0], [radius, length], [0.0, length]])
    return revolved(outline, SECTIONS).transformed(pose(frame_about(along / length), start_ct))


def ball(centre_ct: Floats, radius: float) -> TriangleMesh:
    """A sphere, mm."""
    latitude = np.linspace(-np.pi / 2.0, np.pi / 2.0, SECTIONS // 2 + 1)
    outline = radius * np.stack([np.cos(latitude), np.sin(latitude)], axis=1)
    outline[[0, -1], 0] = 0.0  # the poles
    return revolved(outline, SECTIONS).transformed(pose(np.eye(3), centre_ct))


def ring(T_ct_ring: Floats, inner: float, outer: float, thickness: float) -> TriangleMesh:
    """A flat ring about the z axis of its frame, two radii and the extent along z, mm."""
    half = thickness / 2.0
    outline = np.array([[inner, -half], [outer, -half], [outer, half], [inner, half]])
    return revolved(outline, 2 * SECTIONS).transformed(np.asarray(T_ct_ring))


def corridor_mouth(candidates: Candidates, case: Any) -> TriangleMesh | None:
    """Patches of the skin where a needle may enter, one for every safe cell of the grid; None when nothing is safe."""
    cells = _cells(candidates, case)
    if cells is None:
        return None
    points, corners = cells
    return TriangleMesh(points, np.concatenate([corners[:, [0, 1, 2]], corners[:, [0, 2, 3]]]))


def corridor_walls(candidates: Candidates, case: Any) -> TriangleMesh | None:
    """The border of the safe directions: triangles from the target to the rim of the mouth."""
    cells = _cells(candidates, case)
    if cells is None:
        return None
    points, corners = cells
    edges = np.sort(np.concatenate([corners[:, [i, (i + 1) % 4]] for i in range(4)]), axis=1)
    edges, uses = np.unique(edges, axis=0, return_counts=True)
    rim = edges[uses == 1]
    long = np.linalg.norm(points[rim[:, 0]] - points[rim[:, 1]], axis=1) > KEY
    rim = rim[long]
    if len(rim) == 0:
        return None
    apex = np.full((len(rim), 1), len(points))
    return TriangleMesh(np.vstack([points, case.target_ct]), np.hstack([apex, rim]))


def _cells(candidates: Candidates, case: Any) -> tuple[Floats, NDArray[np.int64]] | None:
    """Corner points (n, 3), shared between cells, and the four corners (m, 4) of every safe cell."""
    rows = np.flatnonzero(candidates.safe & np.isfinite(candidates.path.length))
    if len(rows) == 0:
        return None
    half = step_of(candidates) / 2
    signs = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    theta = np.clip(candidates.theta[rows, None] + half * signs[:, 0], 0.0, np.pi)
    beta = candidates.beta[rows, None] + half * signs[:, 1]
    turn = round(2 * np.pi / KEY)
    around = np.where(np.sin(theta) < KEY, 0, np.mod(np.round(beta / KEY), turn))  # a pole is one corner
    keys = np.stack([np.round(theta / KEY), around], axis=-1).reshape(-1, 2)
    _, first, shared = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    shared = shared.reshape(-1)
    lengths = np.repeat(candidates.path.length[rows], 4)
    length = np.bincount(shared, weights=lengths) / np.bincount(shared) + LIFT_MM
    T = np.asarray(case.T_ct_entry)
    points = case.target_ct + length[:, None] * (outward(theta.ravel()[first], beta.ravel()[first]) @ T[:3, :3].T)
    return points, shared.reshape(-1, 4)


def revolved(outline: Floats, sections: int) -> TriangleMesh:
    """The closed surface that an outline draws as it is carried once around z.

    Args:
        outline: Shape (k, 2), mm: radius, at least 0, and height of its corners, around the body to the left.
        sections: How many flat sides stand for the circle.

    Returns:
        A mesh whose triangles face outwards, in the frame of the axis.
    """
    angle = 2.0 * np.pi * np.arange(sections) / sections
    radius, height = outline[:, 0, None], outline[:, 1, None]
    points = np.stack(np.broadcast_arrays(radius * np.cos(angle), radius * np.sin(angle), height), axis=-1)
    corner = np.arange(points[..., 0].size).reshape(len(outline), sections)
    corner[outline[:, 0] == 0.0] = corner[outline[:, 0] == 0.0, :1]  # on the axis all are one
    above, aside = np.roll(corner, -1, axis=0), np.roll(corner, -1, axis=1)
    across = np.roll(above, -1, axis=1)
    faces = np.concatenate([np.stack([corner, aside, across], -1), np.stack([corner, across, above], -1)]).reshape(
        -1, 3
    )
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    used, number = np.unique(faces, return_inverse=True)
    return TriangleMesh(points.reshape(-1, 3)[used], number.reshape(-1, 3).astype(np.int32))
