"""A stack that was scanned with a tilted gantry on a grid with right angles.

The slices of such a stack are shifted against each other in their own plane. They keep their planes here and are only
moved back within them, by linear interpolation along rows and columns; nothing is interpolated between two slices.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.dicom.stack import Stack

NO_TILT_MM = 0.05
"""Of shift from the first slice to the last: less is the rounding of positions."""
MAX_TILT_DEG = 45.0
"""Gantries tilt to 30 degrees; beyond, the slices are no stack."""
WHOLE_PIXEL = 1e-6
"""Of a pixel: a shift so near to a whole number of pixels needs no interpolation."""


@dataclass(frozen=True, eq=False)
class StraightGrid:
    """The grid with right angles that holds every slice of a stack.

    Attributes:
        shape: Voxels along columns, rows and slices.
        T_ct_index: Shape (4, 4), maps them to LPS mm.
        shifts: Shape (n, 2), where pixel (0, 0) of each slice lies in the grid, along columns and rows, in pixels.
        tilt_deg: Between the slices' normal and the way from one to the next.
    """

    shape: tuple[int, int, int]
    T_ct_index: Floats
    shifts: Floats
    tilt_deg: float


def straight_grid(stack: Stack, rows: int, columns: int, where: Path) -> StraightGrid:
    """The grid of a stack; its own one where it was not tilted.

    Raises:
        InputError: The slices lie side by side rather than one behind the other.
    """
    plane, count = stack.plane, len(stack.slices)
    along = float(stack.step_ct @ plane.normal_ct)
    sideways_mm = plane.axes_ct.T @ stack.step_ct
    tilt = float(np.degrees(np.arctan2(np.linalg.norm(sideways_mm), along)))
    if tilt > MAX_TILT_DEG:
        what = f"the slices' normal and the way from slice to slice are {tilt:.0f} degrees apart"
        raise InputError(what, where=where, allowed=f"a tilt of at most {MAX_TILT_DEG:g} degrees")
    if np.linalg.norm(sideways_mm) * (count - 1) <= NO_TILT_MM:
        sideways_mm = np.zeros(2)
        tilt = 0.0
    shifts = np.arange(count)[:, None] * (sideways_mm / plane.spacing_mm)
    low, high = np.floor(shifts.min(axis=0) + WHOLE_PIXEL), np.ceil(shifts.max(axis=0) - WHOLE_PIXEL)
    T = stack.T_ct_index
    T[:3, 2] = along * plane.normal_ct
    T[:3, 3] += T[:3, :2] @ low
    size = (high - low).astype(int) + (columns, rows)
    return StraightGrid((int(size[0]), int(size[1]), count), T, shifts - low, tilt)


def moved(image: NDArray[np.float32], shift: Floats, shape: tuple[int, int]) -> NDArray[np.float32]:
    """An image in a larger one, NaN where it says nothing.

    Args:
        image: Shape (columns, rows), NaN where nothing was measured.
        shift: Where its pixel (0, 0) lies in the larger one, along each axis; 0 or more.
        shape: Of the larger one.
    """
    for axis in (0, 1):
        image = _moved(image, float(shift[axis]), shape[axis], axis)
    return image


def _moved(image: NDArray[np.float32], shift: float, size: int, axis: int) -> NDArray[np.float32]:
    near = int(np.floor(shift + WHOLE_PIXEL))
    part = shift - near
    if part <= WHOLE_PIXEL:
        return _placed(image, near, size, axis)
    return np.float32(1.0 - part) * _placed(image, near, size, axis) + np.float32(part) * _placed(
        image, near + 1, size, axis
    )


def _placed(image: NDArray[np.float32], at: int, size: int, axis: int) -> NDArray[np.float32]:
    after = size - at - image.shape[axis]
    pads = [(0, 0), (0, 0)]
    pads[axis] = (at, after)
    return np.pad(image, pads, constant_values=np.nan)
