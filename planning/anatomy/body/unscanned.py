"""Parts of a CT that the scanner did not measure: what is there is neither body nor air.

Scanners and programs write one value where they did not look: beyond the circle of reconstruction, beyond the slab of a
tilted gantry that was resampled to a straight image, in slices that fill a volume up. Some write -3024, some the value
of air, some 0. Air that was measured has noise, and never one value over a whole corner of an image.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, widened
from puncture_twin.planning.geometry.parts import parts_of

UNSCANNED_HU = -1500.0
"""Nothing real is less dense than air at -1000; scanners write -2000 or -3024 where they did not look."""
BLANK_HU = -2000.0
"""Written in the place of paddings that are denser than air, such as 0."""
NEARLY_AIR_HU = -900.0
"""Below this a voxel is air, with its noise."""
BLOCK_VOXELS = 3
"""A cube of so many voxels along each edge that have one value is no noise, also where a scanner clips at -1024."""
MEASURED_AIR = 0.02
"""Of what is padded or nearly air, so much at least is measured air, or the image has no noise to tell by: of a
background that a program has blanked only the seam of the skin is left."""
ALIKE_PAIRS = 0.5
"""Of the neighbours in measured air that have one value: noise of 2 HU leaves less than a fifth."""


def measured_hu(hu: NDArray[Any]) -> tuple[NDArray[Any], Bools]:
    """The image with ``BLANK_HU`` where a padding is denser than air, so that no padding counts as body.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units.

    Returns:
        The image itself where there is none; and what of it was not measured.
    """
    found = find_unscanned(hu)
    dense = found & (hu >= NEARLY_AIR_HU)
    return (np.where(dense, hu.dtype.type(BLANK_HU), hu) if dense.any() else hu), found


def find_unscanned(hu: NDArray[Any]) -> Bools:
    """Find what the scanner did not measure, shape of the image.

    It is far below air; or a slice of one value; or what holds together with a corner of the image by cubes of one
    value. In an image without noise nothing tells such a value from that of air: then it is air.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the patient.
    """
    found = np.asarray(hu < UNSCANNED_HU)
    corners = tuple(slice(None, None, max(1, n - 1)) for n in hu.shape)
    cubes = [hu[cube] for cube in itertools.product((slice(0, 2), slice(-2, None)), repeat=3)]
    for value in {cube.flat[0] for cube in cubes if cube.min() == cube.max() >= UNSCANNED_HU}:
        blocks, at_corners = _block(same := hu == value), np.zeros(hu.shape, bool)
        at_corners[corners] = True
        if (blocks & at_corners).any() and _measured_air_has_noise(hu, value):
            parts = parts_of(blocks)
            found |= parts.painted(parts.counts(at_corners) > 0)
            found |= (found | same).all(axis=2)[:, :, None]  # where a circle touches the image's sides
    for z in np.flatnonzero(np.ptp(hu[corners[:2]], axis=(0, 1)) == 0):
        value = hu[0, 0, z]
        if not found[:, :, z].all() and (hu[:, :, z] == value).all() and _measured_air_has_noise(hu, value):
            found[:, :, z] = True
    return found


def _block(same: Bools) -> Bools:
    """Voxels of a mask that lie in a cube of it, or beside one; beyond the image's faces the mask goes on."""
    blocks = ~widened(~same, (BLOCK_VOXELS // 2,) * 3)
    return widened(blocks, (BLOCK_VOXELS - 1,) * 3) & same


def _measured_air_has_noise(hu: NDArray[Any], value: Any) -> bool:
    """Whether the image shows air of other values than one, and neighbours in it differ."""
    air = (hu < NEARLY_AIR_HU) & (hu > UNSCANNED_HU) & (hu != value)
    if np.count_nonzero(air) < MEASURED_AIR * np.count_nonzero(air | (hu == value)):
        return False
    pairs = air[1:] & air[:-1]
    return bool(np.mean((hu[1:] == hu[:-1])[pairs]) < ALIKE_PAIRS) if pairs.any() else False
