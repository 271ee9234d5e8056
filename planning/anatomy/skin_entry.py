"""Where each path from the target crosses the skin, at which angle, and whether what it leaves is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.skin import Skin
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.containment import settled_crossings
from puncture_twin.planning.geometry.creases import smooth_normals


@dataclass(frozen=True, eq=False)
class SkinPaths:
    """The skin along n paths; mm, radians, NaN where there is none.

    Attributes:
        entry_ct: Shape (n, 3), where the path from outside first meets the skin for good, seen from the target.
        path_length: Shape (n,), target to entry.
        skin_angle: Shape (n,), between the path and the skin's inward normal.
        reentry_depth: Shape (n,), where the needle would meet skin again, before where its flange waits.
        unknown_depth: Shape (n,), where the path leaves the body through a cut, or 0 where the skin's crossings do not
            add up.
    """

    entry_ct: Floats
    path_length: Floats
    skin_angle: Floats
    reentry_depth: Floats
    unknown_depth: Floats


def skin_paths(skin: Skin, target_ct: Floats, outward_ct: Floats, farthest: float) -> SkinPaths:
    """Follow every path from the target outward.

    Args:
        skin: The body's surface.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        farthest: How far skin matters, mm: to where the flange can be while the tip waits.
    """
    found, settled = settled_crossings(skin.mesh, target_ct, outward_ct)
    has = found.count > 0
    first = found.first[has]
    depth, face = np.full(len(outward_ct), np.nan), np.zeros(len(outward_ct), np.int64)
    depth[has], face[has] = found.depth[first], found.face[first]
    again = found.count > 1
    reentry = np.full(len(outward_ct), np.nan)
    reentry[again] = found.depth[found.first[again] + 1]
    reentry[reentry > farthest] = np.nan
    cut = has & skin.cut_faces[face]
    unknown = np.where(cut, depth, np.nan)
    if skin.mesh.closed:
        unknown[~settled] = 0.0
    depth[cut] = np.nan
    entry = target_ct + depth[:, None] * outward_ct
    cosine = np.abs(np.einsum("ij,ij->i", smooth_normals(skin.mesh, face, entry), outward_ct))
    angle = np.where(np.isnan(depth), np.nan, np.arccos(np.minimum(cosine, 1)))
    return SkinPaths(entry, depth, angle, reentry, unknown)
