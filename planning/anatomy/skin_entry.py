"""Where each path from the target crosses the skin, at which angle, and whether what it leaves is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.geometry.crossings import Crossings, crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh

NUDGE = 1e-7
"""Radians by which a ray through an edge or corner is turned when its crossings do not add up."""


@dataclass(frozen=True, eq=False)
class SkinPaths:
    """The skin along n paths; mm, radians, NaN where there is none.

    Attributes:
        entry_ct: Shape (n, 3), where the path from outside first meets the skin for good, seen from the target.
        path_length: Shape (n,), target to entry.
        skin_angle: Shape (n,), between the path and the skin's inward normal.
        reentry_depth: Shape (n,), where the needle would meet skin again, before where its flange waits.
        unknown_depth: Shape (n,), where the path leaves what the scan shows through a face that cuts the body, before
            where the inserted needle's flange is, or where the skin's crossings do not add up.
        view_depth: Shape (n,), where the path leaves the image through a face that cuts the body, however far.
    """

    entry_ct: Floats
    path_length: Floats
    skin_angle: Floats
    reentry_depth: Floats
    unknown_depth: Floats
    view_depth: Floats


def skin_paths(
    skin: Skin, target_ct: Floats, outward_ct: Floats, length: float, farthest: float | None = None
) -> SkinPaths:
    """Follow every path from the target outward.

    Args:
        skin: The body's surface.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: Needle length, tip to flange: how far unknown regions matter to an inserted needle, mm.
        farthest: How far skin matters, mm: to where the flange can be while the tip waits; ``length`` if left out.
    """
    view = view_depth(skin, target_ct, outward_ct)
    found, odd = settled_crossings(skin.mesh, target_ct, outward_ct)
    has = found.count > 0
    first = found.first[has]
    depth, face = np.full(len(outward_ct), np.nan), np.zeros(len(outward_ct), np.int64)
    depth[has], face[has] = found.depth[first], found.face[first]
    again = found.count > 1
    reentry = np.full(len(outward_ct), np.nan)
    reentry[again] = found.depth[found.first[again] + 1]
    reentry[reentry > (length if farthest is None else farthest)] = np.nan
    cut = has & skin.cut_faces[face]
    unknown = np.where(view < length, view, np.nan)
    unknown[cut] = depth[cut]
    if skin.mesh.closed:
        unknown[~odd] = 0.0
    depth[cut] = np.nan
    entry = target_ct + depth[:, None] * outward_ct
    cosine = np.abs(np.einsum("ij,ij->i", _normals(skin.mesh, face, entry), outward_ct))
    angle = np.where(np.isnan(depth), np.nan, np.arccos(np.minimum(cosine, 1)))
    return SkinPaths(entry, depth, angle, reentry, unknown, view)


def settled_crossings(mesh: TriangleMesh, origin: Floats, directions: Floats) -> tuple[Crossings, Bools]:
    """Crossings, and which rays leave the body an odd number of times, as a ray from inside a closed surface must.

    A ray through an edge or corner may count twice or touch without crossing; it is turned by `NUDGE` and asked again.
    """
    found = crossings(mesh, origin, directions)
    odd = found.count % 2 == 1
    if mesh.closed and not odd.all():
        rotated = directions.copy()
        rotated[~odd] = _rotated(directions[~odd])
        found = crossings(mesh, origin, rotated)
        odd = found.count % 2 == 1
    return found, odd


def _rotated(directions: Floats) -> Floats:
    helper = np.eye(3)[np.argmin(np.abs(directions), axis=1)]
    aside = np.cross(directions, helper)
    rotated = directions + NUDGE * aside / np.linalg.norm(aside, axis=1, keepdims=True)
    return np.asarray(rotated / np.linalg.norm(rotated, axis=1, keepdims=True))


def view_depth(skin: Skin, target_ct: Floats, outward_ct: Floats) -> Floats:
    """Where each path leaves the field of view through a face beyond which the body goes on, NaN elsewhere.

    Also in the air: what lies beside the image at that face is a body of which nothing is known.

    Args:
        skin: With its field of view.
        target_ct: Shape (3,), where the paths start, mm.
        outward_ct: Shape (n, 3), unit.

    Raises:
        InputError: The target lies outside the image.
    """
    if skin.field_of_view is None:
        return np.full(len(outward_ct), np.nan)
    out = skin.field_of_view.exit(target_ct, outward_ct)
    return np.where(out.cut, out.depth_mm, np.nan)


def _normals(mesh: TriangleMesh, face: NDArray[np.int64], points: Floats) -> Floats:
    """Unit normals at points of triangles: the corners' normals (area weighted), blended; shape (n, 3)."""
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    areas = np.cross(b - a, c - a)
    at_vertex = np.zeros_like(mesh.vertices)
    for corner in mesh.faces.T:
        np.add.at(at_vertex, corner, areas)
    weights = _corner_weights(mesh.triangles[face], points)
    return _unit(np.einsum("ij,ijk->ik", weights, _unit(at_vertex)[mesh.faces[face]]))


def _corner_weights(triangles: Floats, points: Floats) -> Floats:
    """How much corners count (n, 3) at points of triangles (n, 3, 3): as the areas opposite, in one measure per row."""
    a, b, c = np.moveaxis(triangles, 1, 0)
    normal = np.cross(b - a, c - a)
    parts = [np.cross(c - b, points - b), np.cross(a - c, points - c), np.cross(b - a, points - a)]
    return np.stack([np.einsum("ij,ij->i", part, normal) for part in parts], axis=1)


def _unit(vectors: Floats) -> Floats:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.divide(vectors, lengths, out=np.zeros_like(vectors), where=lengths > 0)
