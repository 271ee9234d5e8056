"""Directions and mounts in the patient's words."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.place.mounts import Region
from puncture_twin.twin.report.map_view import body_directions

NEARLY = 0.985
"""Cosine from which a direction carries a body direction's name (10 degrees)."""


def direction_text(direction_ct: Floats, space: str) -> str:
    """What a person calls a direction, such as "the patient's left"; "" where no name fits.

    Args:
        direction_ct: Shape (3,), unit.
        space: The case's.
    """
    for name, vector in body_directions(space).items():
        if float(vector @ direction_ct) > NEARLY:
            return name if space == "local" else f"the {name}"
    return ""


def mounting_text(region: Region, T_ct_bed: Floats, space: str) -> str:
    """A region's name, with the patient's directions in it where they fit."""
    if not region.facing:
        return region.mount
    axis = region.axis if region.mount == "side" else (0, 1 if region.facing.startswith("+") else -1, 0)
    text = direction_text(np.asarray(T_ct_bed[:3, :3] @ np.asarray(axis, dtype=float)), space) or region.facing
    return f"side, base axis toward {text}" if region.mount == "side" else f"{region.mount}, on {text}"
