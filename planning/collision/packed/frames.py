"""Frames of the packed bodies."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.geometry.rigid import apply

WORKCELL_FRAME = 0
"""The frame of what does not move: the base's."""


def in_frame(corners: Floats, body: Body) -> Floats:
    """Corners (n, 3) of a body's shapes in the frame that it moves with."""
    return np.asarray(apply(body.T_frame_body, corners))
