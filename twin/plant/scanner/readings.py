"""A virtual CT read of markers: which slice shows one, and which pixel (spec 1, section 3; Chen 2019, section 3.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats


@dataclass(frozen=True)
class Scanner:
    """How finely a scan tells positions apart; the defaults are the paper's.

    Attributes:
        slice_spacing_mm: Slice k sits at (k - 1) times this along the bed.
        in_plane_mm: Resolution across the bed.
        bed_axis: Axis of the CT frame along the bed: 0, 1 or 2.
    """

    slice_spacing_mm: float = 5.0
    in_plane_mm: float = 1.0
    bed_axis: int = 0

    @property
    def cell_mm(self) -> Floats:
        """Size of what one reading stands for, shape (3,)."""
        cell = np.full(3, self.in_plane_mm)
        cell[self.bed_axis] = self.slice_spacing_mm
        return cell

    @property
    def fle_mm(self) -> float:
        """Root mean square length of a reading's error: three independent uniform errors of half a cell each way."""
        return float(np.sqrt(np.sum(self.cell_mm**2) / 12))


def read_positions(scanner: Scanner, points_ct: Floats, grid_offset: Floats | None = None) -> Floats:
    """What is read off the scan: each point moved to the nearest slice and pixel.

    Args:
        scanner: The scanner.
        points_ct: True positions, shape (n, 3), mm.
        grid_offset: Shape (3,), mm: position of the first slice and pixel in the CT frame; None for its origin.

    Returns:
        Shape (n, 3), mm, CT frame.
    """
    offset = np.zeros(3) if grid_offset is None else grid_offset
    cells = np.round((points_ct - offset) / scanner.cell_mm)
    return np.asarray(offset + cells * scanner.cell_mm)


def slice_number(scanner: Scanner, points_ct: Floats) -> NDArray[np.int64]:
    """Number of the slice that shows each point, shape (n,), counted from 1 at the CT frame's origin."""
    along = points_ct[:, scanner.bed_axis] / scanner.slice_spacing_mm
    return np.round(along).astype(np.int64) + 1


def scan(scanner: Scanner, points_ct: Floats, rng: np.random.Generator) -> Floats:
    """One scan: the patient lies anywhere between two slices and two pixels.

    Points that lie whole cells apart are off by the same, as in a real scan: such an error moves them all, and the
    target read in the same scan with them.

    Args:
        scanner: The scanner.
        points_ct: True positions, shape (n, 3), mm.
        rng: Draws where the grid falls, one offset for all points.

    Returns:
        Readings, shape (n, 3), mm, CT frame.
    """
    return read_positions(scanner, points_ct, rng.uniform(-0.5, 0.5, 3) * scanner.cell_mm)


def draw_true_positions(scanner: Scanner, readings_ct: Floats, rng: np.random.Generator) -> Floats:
    """Positions that this scanner would have read as it did: anywhere in each reading's cell, shape (n, 3), mm."""
    return np.asarray(readings_ct + rng.uniform(-0.5, 0.5, readings_ct.shape) * scanner.cell_mm)
