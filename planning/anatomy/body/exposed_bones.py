"""Bones of limbs that lie across the trunk: air is about them on more sides than about any bone of the trunk.

A rib lies below skin that is nearly flat: of a sphere about it, a little larger than its distance from the air, less
than a quarter is air, however it runs. A forearm is round and lies upon the trunk: two fifths and more are. So are a
hand's and an upper arm's, bent or straight, alone or in pairs.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.detached_parts import MIN_BONE_ML
from puncture_twin.planning.base.arrays import Bools, Floats

SPHERE = 1.6
"""Radius of the sphere, as a multiple of the bone's distance from the air: .19 of it is air behind flat skin."""
EXPOSED, PARTLY = 0.30, 0.26
"""Shares of air. Bones of a real trunk have .27 at most where they are as near to the air; those of random forearms
.35 and more in the median. What is partly exposed and continues an exposed bone belongs to it."""
DEEPEST_MM, DEEPEST_FRACTION = 60.0, 0.45
"""From a limb's bone to the air, and as a fraction of what the trunk's middle has: a spine lies deeper."""
GAP_MM = 16.0
"""Bones of one limb are so near to each other, at a wrist or an elbow."""
LEAST_LENGTH_MM = 40.0
"""Diagonal of the box about the exposed bone of one limb. A nose's and a spinous process's are shorter."""
DIRECTIONS = 200
"""Points of the sphere; the fraction is right to some .02."""

FULL = np.ones((3, 3, 3), bool)


class Exposed(NamedTuple):
    """The bones of one limb.

    Attributes:
        voxels: Shape (n, 3), indices.
        depth_mm: Shape (n,), of each, to the nearest air.
    """

    voxels: NDArray[np.int64]
    depth_mm: Floats


def exposed_bones(bone: Bools, body: Bools, spacing_mm: Floats) -> list[Exposed]:
    """Bones about which there is air on more sides than about a bone of the trunk.

    Args:
        bone: Shape (nx, ny, nz).
        body: Same shape; beyond the border it goes on.
        spacing_mm: Shape (3,).
    """
    padded = np.pad(body, 1, mode="edge")
    depth = scipy.ndimage.distance_transform_edt(padded, sampling=spacing_mm)[1:-1, 1:-1, 1:-1]
    near = bone & body & (depth <= min(DEEPEST_MM, DEEPEST_FRACTION * float(depth.max())))
    index = np.argwhere(near)
    fraction = np.zeros(body.shape)
    fraction[near] = _air_about(index, depth[near], body, spacing_mm)
    groups = _groups(fraction >= PARTLY, spacing_mm)
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    found = []
    for number in np.unique(groups[fraction >= EXPOSED]):
        at = np.argwhere((groups == number) & (fraction >= EXPOSED))
        if len(at) * voxel_ml >= MIN_BONE_ML and np.linalg.norm(np.ptp(at, axis=0) * spacing_mm) >= LEAST_LENGTH_MM:
            whole = groups == number
            found.append(Exposed(np.argwhere(whole), depth[whole]))
    return found


def _groups(mask: Bools, spacing_mm: Floats) -> NDArray[np.int32]:
    """Numbers of voxels that hold together across gaps of ``GAP_MM``, 0 outside of the mask."""
    if not mask.any():
        return np.zeros(mask.shape, np.int32)
    gap = scipy.ndimage.distance_transform_edt(~mask, sampling=spacing_mm)
    labels, _ = scipy.ndimage.label(gap <= GAP_MM / 2.0, FULL)
    return np.asarray(np.where(mask, labels, 0), dtype=np.int32)


def _air_about(index: NDArray[np.int64], depth_mm: Floats, body: Bools, spacing_mm: Floats) -> Floats:
    """How much of a sphere about each voxel (n, 3) is air; 0..1."""
    step = np.arange(DIRECTIONS) + 0.5
    z = 1.0 - 2.0 * step / DIRECTIONS
    angle, wide = np.pi * (1.0 + 5.0**0.5) * step, np.sqrt(1.0 - z * z)  # golden angle
    sphere = np.stack([wide * np.cos(angle), wide * np.sin(angle), z], axis=1)
    last = np.array(body.shape) - 1
    air = np.zeros(len(index))
    for direction in sphere:
        at = np.clip(np.rint(index + SPHERE * depth_mm[:, None] * direction / spacing_mm).astype(int), 0, last)
        air += ~body[tuple(at.T)]
    return air / DIRECTIONS
