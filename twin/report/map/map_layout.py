"""Where things stand in ``map.png``: pixels from its upper left corner, and places in the disc."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.report.map_view import MapView

HEIGHT = 1222

POINT = 130 / 72
"""Pixels: a printer's point."""

MIDDLE, RADIUS = (583.0, 642.0), 412
"""Of the disc; labels stand around it."""

SIDE_LEFT, SIDE_TOP, SIDE_WIDTH, SIDE_HEIGHT = 1158.0, 122.0, 515.0, 1039.0
"""Of the column beside it."""

RINGS_AT = np.radians(67.5)
"""Where the rings' angles are written, counter-clockwise from the right."""


class Label(NamedTuple):
    """What is written on the map, and where, in the disc's radii (x right, y up)."""

    x: float
    y: float
    text: str


def disc_pixels(points: Any) -> Floats:
    """Columns and rows of points of the unit disc (x right, y up), shape (..., 2)."""
    return np.asarray(np.asarray(MIDDLE) + RADIUS * np.asarray(points, dtype=float) * [1.0, -1.0])


def side_pixels(x: float, y: float) -> tuple[float, float]:
    """Column and row of a place in the column beside the map, 0..1 to the right and down."""
    return SIDE_LEFT + x * SIDE_WIDTH, SIDE_TOP + y * SIDE_HEIGHT


def ring_radii(view: MapView) -> list[tuple[int, float]]:
    """θ of the rings that are drawn, degrees, and their radius in the disc."""
    top = float(np.degrees(view.theta_max))
    spacing = 15 if top <= 100 else 30
    return [(ring, ring / top) for ring in range(spacing, int(top) + 1, spacing)]
