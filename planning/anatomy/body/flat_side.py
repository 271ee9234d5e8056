"""Where a body found in a CT ends in a plane: it is pressed on a table, or is one with a table or pad that touches it.

What touches the patient and is as dense as they are cannot be told from them by threshold. But no skin is flat over a
hand's breadth along a whole scan, unless it is pressed flat. In both cases nothing comes from beyond that plane.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats

FLAT_MM = 1.0
"""A side is flat where it keeps within this of one plane; noise moves the surface of a 5 mm voxel by some 0.2 mm."""
FLAT_WIDTH_MM = 100.0
"""Over so much of its width, in enough slices. A round back with a radius of 1.2 m is as flat."""
FLAT_LENGTH_MM = 50.0
"""Enough are half of the slices, or all along so much of the bed: a board may be shorter than the image."""
BEYOND_FRACTION = 0.01
"""Of a side's surface: more of it beyond the plane, and the plane is a step, such as a table's top beside the body."""
SIDES = {(0, 0): "right", (0, -1): "left", (1, 0): "front", (1, -1): "back"}
"""Names of the sides by array axis and end, axes running to the left, back and head."""


class FlatSide(NamedTuple):
    """A plane across an axis of the image in which the body ends.

    Attributes:
        axis: 0 or 1, running to the left or to the back.
        end: 0 or -1, the side of the body: at the axis' low or high end.
        plane: Where it crosses the axis, in voxels.
        width_mm: How wide the flat part is: in the middle slice by width, or along a whole board, if that is wider.
    """

    axis: int
    end: int
    plane: float
    width_mm: float

    @property
    def warning(self) -> str:
        """One sentence."""
        return (
            f"the body is flat at its {SIDES[self.axis, self.end]} side over {self.width_mm:.0f} mm: it is pressed on "
            "something there, or is one with it; nothing beyond that plane counts as free"
        )


def flat_sides(above: NDArray[np.floating], body: Bools, spacing_mm: Floats) -> tuple[FlatSide, ...]:
    """The sides at which a body ends in a plane across its image's axes.

    Args:
        above: Shape (nx, ny, nz), Hounsfield units above those of the body's surface, axis 2 along the bed.
        body: Same shape.
        spacing_mm: Shape (3,).
    """
    return tuple(_flat_sides(above, body, spacing_mm))


def _flat_sides(above: NDArray[np.floating], body: Bools, spacing_mm: Floats) -> Iterator[FlatSide]:
    for axis, end in itertools.product((0, 1), (0, -1)):
        step_mm, across_mm = float(spacing_mm[axis]), float(spacing_mm[1 - axis])
        ends = surface_ends(above, body, axis, end)
        plane = _commonest(ends[np.isfinite(ends)], FLAT_MM / step_mm)
        outward_mm = (ends - plane) * (step_mm if end else -step_mm)
        width_mm = _flat_width((np.abs(outward_mm) <= FLAT_MM / 2).sum(axis=0), float(spacing_mm[2])) * across_mm
        if width_mm >= FLAT_WIDTH_MM and np.mean(outward_mm[np.isfinite(ends)] > FLAT_MM) < BEYOND_FRACTION:
            yield FlatSide(axis, end, plane, width_mm)


def surface_ends(above: NDArray[np.floating], body: Bools, axis: int, end: int) -> Floats:
    """Where a body's surface is along each line of an axis, seen from one of its ends.

    Args:
        above: Shape (nx, ny, nz), Hounsfield units above those of the body's surface, axis 2 along the bed.
        body: Same shape.
        axis: 0 or 1, along the lines.
        end: 0 or -1, from which end of the axis.

    Returns:
        Voxels along the axis, shape (n, nz); NaN where there is no body, and where the image cuts it.
    """
    turn = slice(None, None, -1) if end else slice(None)
    inside = np.moveaxis(body, axis, 0)[turn]
    values = np.moveaxis(above, axis, 0)[turn]
    first = np.argmax(inside, axis=0)
    known = inside.any(axis=0) & (first > 0)
    first = np.maximum(first, 1)
    within = np.take_along_axis(values, first[None], axis=0)[0].astype(np.float64)
    beside = np.take_along_axis(values, first[None] - 1, axis=0)[0].astype(np.float64)
    crossed = known & (within > 0.0) & (beside < 0.0)
    at = first - np.divide(within, within - beside, out=np.full(within.shape, 0.5), where=crossed)
    at = np.where(known, at, np.nan)
    return np.asarray(len(inside) - 1 - at if end else at)


def _flat_width(flat: NDArray[np.integer], step_mm: float) -> float:
    """How many lines are flat in half of the slices, or along `FLAT_LENGTH_MM` without a gap, whichever is more.

    Args:
        flat: Shape (nz,), the flat lines of each slice.
        step_mm: From slice to slice.
    """
    run = min(len(flat), int(np.ceil(FLAT_LENGTH_MM / step_mm)))
    least = np.lib.stride_tricks.sliding_window_view(flat, run).min(axis=1)
    return max(float(np.median(flat)), float(least.max()))


def _commonest(values: Floats, window: float) -> float:
    """The middle of the window that holds most values; NaN for none."""
    if len(values) == 0:
        return float("nan")
    values = np.sort(values)
    counts = np.searchsorted(values, values + window, side="right") - np.arange(len(values))
    return float(values[np.argmax(counts)] + window / 2)
