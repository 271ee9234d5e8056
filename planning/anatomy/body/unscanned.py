"""Parts of a CT that the scanner did not measure: what is there is neither body nor air.

Scanners and programs write one value where they did not look: beyond the circle of reconstruction, beyond the slab of a
tilted gantry that was resampled to a straight image, in slices that fill a volume up. Some write -3024, some the value
of air, some 0. Air that was measured has noise, and never one value over a whole corner of an image.
"""

from __future__ import annotations

import itertools
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, widened
from puncture_twin.planning.geometry.parts import parts_of

UNSCANNED_HU = -1500.0
"""Nothing real is less dense than air at -1000; scanners write -2000 or -3024 where they did not look."""
BLANK_HU = -2000.0
"""Written in the place of paddings that are denser than air, such as 0."""
CIRCLE_PIXELS = 2.0
"""A circle of reconstruction is drawn to the pixel; the ambient air never ends in one."""
NEARLY_AIR_HU = -900.0
"""Below this a voxel is air, with its noise."""
STILL_AIR = 0.9
"""Where so much of the air has one value, the image has no noise: that of a phantom, not of a scanner."""
CIRCLE_FILLS = 0.9
"""Of the image's width and height at least; a smaller disc in constant air may be a round phantom without noise."""
BLOCK_VOXELS = 3
"""A cube of so many voxels along each edge that have one value is no noise, also where a scanner clips at -1024."""
MEASURED_AIR = 0.02
"""Of what is padded or nearly air, so much at least is measured air, or the image has no noise to tell by: of a
background that a program has blanked only the seam of the skin is left."""
ALIKE_PAIRS = 0.5
"""Of the neighbours in measured air that have one value: noise of 2 HU leaves less than a fifth."""
CUBES = tuple(itertools.product((slice(0, 2), slice(-2, None)), repeat=3))
"""At an image's corners: of measured air none is filled by one value, and most images end here."""


class Unscanned(NamedTuple):
    """What was not measured.

    Attributes:
        voxels: Shape (nx, ny, nz), all of it.
        padded: Same shape, the part of it that is no circle's outside: there the image ends as it does at its faces.
    """

    voxels: Bools
    padded: Bools


def measured_hu(hu: NDArray[Any]) -> tuple[NDArray[Any], Unscanned | None]:
    """The image with ``BLANK_HU`` where a padding is denser than air, so that no padding counts as body.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units.

    Returns:
        The image itself where there is none, and then what of it was not measured.
    """
    found = find_unscanned(hu)
    if not found.voxels.any():
        return hu, found
    dense = found.voxels & (hu >= NEARLY_AIR_HU)
    return (np.where(dense, hu.dtype.type(BLANK_HU), hu), None) if dense.any() else (hu, found)


def find_unscanned(hu: NDArray[Any]) -> Unscanned:
    """Find what the scanner did not measure.

    It is far below air; or it has one value that fills what is outside a circle, or a corner or a slice of the image.
    In an image without noise nothing tells such a value from that of air: then it is air.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the patient.
    """
    below = np.asarray(hu < UNSCANNED_HU) if hu.min() < UNSCANNED_HU else np.zeros(hu.shape, bool)
    circle = _outside_circle(hu, below)
    padded = _padded(hu, circle)
    if circle.any():
        below |= circle[:, :, None]
    if padded.any():
        below |= padded
    return Unscanned(below, padded)


def _outside_circle(hu: NDArray[Any], below: Bools) -> Bools:
    """Pixels (nx, ny) outside a circle of reconstruction; where there is none, nothing."""
    none = np.zeros(hu.shape[:2], bool)
    if below.all():
        return none
    least = np.min(hu, where=~below, initial=hu.max()) if below.any() else hu.min()
    for value in np.unique([least, *hu[_corners(hu)].ravel()]):
        padding = _in_every_slice(hu, below, value)
        if _is_outside_a_circle(padding):
            air = hu[(hu < NEARLY_AIR_HU) & ~padding[:, :, None]]
            if len(air) == 0 or np.mean(air == value) < STILL_AIR:
                return padding
    return none


def _in_every_slice(hu: NDArray[Any], below: Bools, value: Any) -> Bools:
    """Pixels (nx, ny) that have a value, or are below all, in every slice; none where those at the corners do not."""
    corners = _corners(hu)[:2]
    if not ((hu[corners] == value) | below[corners]).all():
        return np.zeros(hu.shape[:2], bool)
    return np.asarray(((hu == value) | below).all(axis=2))


def _is_outside_a_circle(padding: Bools) -> bool:
    """Whether pixels (nx, ny) are just those outside of a circle that fills the image."""
    inside = np.argwhere(~padding)
    if not padding.any() or len(inside) == 0:
        return False
    low, high = inside.min(axis=0), inside.max(axis=0)
    if np.any(high - low + 1 < CIRCLE_FILLS * np.array(padding.shape)):
        return False
    middle = (low + high) / 2.0
    farthest = np.linalg.norm(inside - middle, axis=1).max()
    nearest = np.linalg.norm(np.argwhere(padding) - middle, axis=1).min()
    return bool(farthest - nearest < CIRCLE_PIXELS)


def _padded(hu: NDArray[Any], circle: Bools) -> Bools:
    """Slices of one value, and what holds together with a corner of the image by cubes of its value.

    Nothing of what is known to lie outside a circle (pixels (nx, ny)), and nothing in an image without noise.
    """
    padded = np.zeros(hu.shape, bool)
    for z in np.flatnonzero(np.ptp(hu[_corners(hu)[:2]], axis=(0, 1)) == 0):
        padded[:, :, z] = (hu[:, :, z] == hu[0, 0, z]).all()
    for value in np.unique(hu[_corners(hu)]):
        cubes = ((hu[cube] == value) & ~circle[cube[:2]][..., None] for cube in CUBES)
        if not any(cube.all() for cube in cubes):
            continue
        blocks = _block((hu == value) & ~circle[:, :, None])
        found, at_corners = parts_of(blocks), np.zeros_like(blocks)
        at_corners[_corners(hu)] = True
        padded |= found.painted(found.counts(at_corners) > 0)
    if not padded.any():
        return padded
    for value in np.unique(hu[padded]):
        if not _measured_air_has_noise(hu, value):
            padded &= hu != value
    return padded & ~circle[:, :, None]


def _corners(image: NDArray[Any]) -> tuple[slice, ...]:
    """The voxels at the corners of an image."""
    return tuple(slice(None, None, max(1, n - 1)) for n in image.shape)


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
