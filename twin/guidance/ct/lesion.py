"""The middle of a soft lesion: voxels weighed by how far they have its value and not that of its surroundings."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.twin.guidance.ct.metal import centroid, spacing_mm

RIM_MM = 4.0
"""Beyond a segmentation, so far the surroundings are looked at."""


def read_lesion(volume: Volume, mask: NDArray[np.bool_]) -> Floats:
    """The middle of what a segmentation outlines, by the values in and around it, shape (3,), LPS mm.

    Args:
        volume: The CT.
        mask: Shape of the CT: the lesion's voxels.

    Raises:
        InputError: An empty mask.
    """
    found = ndimage.find_objects(mask.astype(np.uint8))
    if not found:
        raise InputError("the lesion has no voxel", where=volume.path, allowed="a lesion larger than a voxel")
    spacing = spacing_mm(volume)
    around = np.ceil(RIM_MM / spacing).astype(int) + 1
    low = np.maximum(np.array([one.start for one in found[0]]) - around, 0)
    high = np.minimum(np.array([one.stop for one in found[0]]) + around, mask.shape)
    box = (slice(low[0], high[0]), slice(low[1], high[1]), slice(low[2], high[2]))
    values, inside = volume.values[box].astype(np.float64), mask[box]
    distance = ndimage.distance_transform_edt(~inside, spacing)
    core = ndimage.distance_transform_edt(inside, spacing) > spacing.max()
    own = np.median(values[core if core.any() else inside])
    other = np.median(values[(distance > spacing.max()) & (distance <= RIM_MM + spacing.max())])
    if own == other:
        return centroid(inside.astype(np.float64), box, volume.T_ct_index)
    weights = np.where(core, 1.0, np.clip((values - other) / (own - other), 0.0, 1.0))
    return centroid(np.where(distance <= spacing.max(), weights, 0.0), box, volume.T_ct_index)
