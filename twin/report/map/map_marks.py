"""The marks of directions, on the map and in its legend."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.twin.report.canvas.canvas import BLACK, WHITE, Canvas, circle, star
from puncture_twin.twin.report.map.map_layout import POINT


def mark_dot(canvas: Canvas, place: Any) -> None:
    """A direction of the Pareto front."""
    canvas.segments(np.array([[place, place]]), 3.5 * POINT, BLACK)
    canvas.segments(np.array([[place, place]]), 2.5 * POINT, WHITE)


def mark_ring(canvas: Canvas, place: Any) -> None:
    """The best of a window."""
    canvas.line(circle(place, 3.4 * POINT), 1.2 * POINT, BLACK)


def mark_star(canvas: Canvas, place: Any, radius: float) -> None:
    """The chosen direction."""
    canvas.fill(star(place, radius), WHITE)
    canvas.line(star(place, radius), 1.6 * POINT, BLACK)
