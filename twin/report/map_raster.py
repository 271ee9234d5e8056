"""The map as pixels: every pixel asks which grid cell it lies in, so no gap and no moire can arise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from planning.candidates import Candidates
from twin.report.map_view import MapView, rows_at
from twin.report.palette import REASON_COLOURS, reason_of, safe_shades

OVERSAMPLING = 2
"""Samples per pixel side; averaged, they smooth the cells' borders."""


@dataclass(frozen=True, eq=False)
class MapRaster:
    """The square picture of the cap; row 0 is the top.

    Attributes:
        rgba: Shape (n, n, 4), transparent outside the grid.
        rows: Shape (n, n), the candidate under each pixel's centre, -1 outside the grid.
    """

    rgba: NDArray[np.uint8]
    rows: NDArray[np.int64]


def clearance_range(candidates: Candidates) -> tuple[float, float]:
    """Least and greatest clearance among the safe directions, mm; (0, 1) when there is none to speak of."""
    values = candidates.min_clearance[candidates.safe]
    values = values[np.isfinite(values)]
    if len(values) == 0:
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    return low, max(high, low + 1e-3)


def row_colours(candidates: Candidates) -> NDArray[np.uint8]:
    """The colour of every direction, shape (n, 3)."""
    colours = np.zeros((len(candidates), 3), dtype=np.uint8)
    for value in np.unique(candidates.reason):
        reason = reason_of(str(value))
        if reason in REASON_COLOURS:
            colours[candidates.reason == value] = REASON_COLOURS[reason]
    low, high = clearance_range(candidates)
    safe = candidates.safe
    colours[safe] = safe_shades((candidates.min_clearance[safe] - low) / (high - low))
    return colours


def map_raster(candidates: Candidates, view: MapView, size: int) -> MapRaster:
    """Draw the cap.

    Args:
        candidates: The grid's rows.
        view: The map's geometry.
        size: Pixels per side.
    """
    fine = _rows(candidates, view, size * OVERSAMPLING)
    table = np.zeros((len(candidates) + 1, 4))
    table[:-1, :3] = row_colours(candidates)
    table[:-1, 3] = 255.0
    rgba = table[fine]
    rgba[..., :3] *= rgba[..., 3:] / 255.0
    rgba = rgba.reshape(size, OVERSAMPLING, size, OVERSAMPLING, 4).mean(axis=(1, 3))
    rgba[..., :3] /= np.maximum(rgba[..., 3:], 1.0) / 255.0
    return MapRaster(np.clip(np.round(rgba), 0, 255).astype(np.uint8), _rows(candidates, view, size))


def _rows(candidates: Candidates, view: MapView, size: int) -> NDArray[np.int64]:
    axis = (np.arange(size) + 0.5) / size * 2 - 1
    x, y = np.meshgrid(axis, -axis)
    theta, beta = view.angles_at(np.stack([x, y], axis=-1))
    return rows_at(candidates, theta, beta)
