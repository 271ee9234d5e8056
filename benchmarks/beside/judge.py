"""What a safe needle truly passes: its axis against the true surfaces, triangle by triangle, without the product."""

from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

STEP_MM = 0.5
PER_MM2 = 1.5
"""Samples of a surface: on average less than a millimetre apart."""


class Passed(NamedTuple):
    """What the axis of one needle passes: how deep within a part, and beyond the trunk's skin, and how far."""

    part: str
    row: int
    deepest_mm: float
    long_mm: float


def crossings(mesh, origin, directions):
    """Where rays from one point cross a surface, shape (rows, triangles), NaN elsewhere; + where they leave it."""
    a, b, c = np.moveaxis(np.asarray(mesh.vertices)[np.asarray(mesh.faces)] - origin, 1, 0)
    normal = np.cross(b - a, c - a)
    leaves = directions @ normal.T
    with np.errstate(divide="ignore", invalid="ignore"):
        at, way = np.sum(a * normal, axis=1) / leaves, np.sign(leaves)
    sides = [way * (directions @ np.cross(p, q).T) for p, q in ((a, b), (b, c), (c, a))]  # of each edge's plane
    return np.where((np.minimum.reduce(sides) >= 0) & (at > 0), at, np.nan), way


def inside(mesh, origin, directions, depths):
    """Whether points along rays lie in a closed surface, shape (rows, depths): by the crossings beyond each."""
    found = np.zeros((len(directions), len(depths)), int)
    for rows in np.array_split(np.arange(len(directions)), max(1, len(directions) // 20)):
        at, way = crossings(mesh, origin, directions[rows])
        for one, (where, sign) in enumerate(zip(at, way, strict=True)):
            known = np.isfinite(where)
            order = np.argsort(where[known])
            beyond = np.concatenate([np.cumsum(sign[known][order][::-1])[::-1], [0.0]])
            found[rows[one]] = beyond[np.searchsorted(where[known][order], depths, side="right")]
    return found != 0


class Distances:
    """Distances from a surface, by samples of it: never too short, too long by a fraction of a millimetre."""

    def __init__(self, mesh):
        one = trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)
        count = int(np.clip(PER_MM2 * one.area, 1000, 400_000))
        self.tree = cKDTree(np.concatenate([trimesh.sample.sample_surface(one, count, seed=0)[0], mesh.vertices]))

    def __call__(self, points, most_mm=np.inf):
        """Of points (..., 3); infinite where it is more than is asked for."""
        return self.tree.query(points, distance_upper_bound=most_mm)[0]


def passed(parts, skin, origin, directions, lengths):
    """What needles from an origin pass outside of the trunk, of parts by name; lengths (n,) along directions (n, 3)."""
    found = []
    if not len(directions):
        return found
    depths = np.arange(0.0, lengths.max(), STEP_MM)
    outside = ~inside(skin, origin, directions, depths) & (depths <= lengths[:, None])
    to_skin = Distances(skin)
    for name, mesh in parts.items():
        within = inside(mesh, origin, directions, depths) & outside
        rows = np.flatnonzero(within.any(axis=1))
        to_part = Distances(mesh) if len(rows) else None
        for row in rows:
            points = origin + depths[within[row], None] * directions[row]
            deepest = np.minimum(to_part(points), to_skin(points)).max()
            found.append(Passed(name, int(row), float(deepest), float(STEP_MM * within[row].sum())))
    return found


def lacks(mesh, origin, directions, lengths, wanted_mm):
    """By how much needles from the target to the skin lack clearance, mm, shape (n,); 0 where they do not."""
    to, depths = Distances(mesh), np.arange(0.0, lengths.max(initial=0.0), STEP_MM)
    on = depths < lengths[:, None]
    within = (inside(mesh, origin, directions, depths) & on).any(axis=1)
    points = (origin + depths[row, None] * way for row, way in zip(on, directions, strict=True))
    near = np.array([to(some, wanted_mm).min() for some in points])
    return np.where(within, wanted_mm, np.maximum(0.0, wanted_mm - near))
