"""A CT gantry for the arm's workcell: a wall with a round bore, as boxes that never leave more space than the bore."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.errors import InputError

SIDES = 24
"""Of the polygon that stands for the bore: inscribed, so the bore is up to 0.9 % narrower than it is (3 mm of 350)."""


def gantry_boxes(
    T_base_gantry: NDArray[np.float64], *, bore_diameter_mm: float, wall_mm: float, depth_mm: float
) -> tuple[Box, ...]:
    """The wall about a bore.

    Args:
        T_base_gantry: Shape (4, 4), mm: the bore's centre; its axis is z, so a tilt is a turn about x.
        bore_diameter_mm: Of the bore.
        wall_mm: How far the wall reaches outward from the bore; the housing beyond does not count.
        depth_mm: Along the bore.

    Returns:
        Boxes named ``gantry_0`` ...: every point of the wall is in one of them, and every point nearer to the axis than
        cos(pi / ``SIDES``) times the bore's radius in none.

    Raises:
        InputError: If a length is not finite and positive, or the pose not rigid.
    """
    for name, value in (("bore_diameter_mm", bore_diameter_mm), ("wall_mm", wall_mm), ("depth_mm", depth_mm)):
        if not (np.isfinite(value) and value > 0.0):
            raise InputError(f"{name} = {value}", where="gantry", allowed="finite and above 0")
    radius = bore_diameter_mm / 2.0
    inner, outer = radius * np.cos(np.pi / SIDES), radius + wall_mm
    size = (outer - inner, 2.0 * outer * np.tan(np.pi / SIDES), depth_mm)
    boxes = []
    for side in range(SIDES):
        turn = 2.0 * np.pi * side / SIDES
        T = np.eye(4)
        T[:2, 0], T[:2, 1] = (np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))
        T[:2, 3] = (inner + outer) / 2.0 * T[:2, 0]
        boxes.append(Box(f"gantry_{side}", np.asarray(T_base_gantry, dtype=np.float64) @ T, size))
    return tuple(boxes)
