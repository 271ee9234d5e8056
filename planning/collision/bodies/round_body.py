"""A cylinder about the needle's axis as a body for FCL."""

from __future__ import annotations

from functools import partial

import fcl
import numpy as np

from puncture_twin.planning.collision.bodies.body import FLANGE_FRAME, Body, Shape
from puncture_twin.planning.collision.bodies.prisms import prism
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.geometry.rigid import pose


def round_body(name: str, diameter_mm: float, span_mm: tuple[float, float], padding_mm: float) -> Body:
    """A cylinder about the needle's axis, from one height above the flange to another, mm."""
    length = span_mm[1] - span_mm[0]
    T_flange_body = pose(np.eye(3), [0.0, 0.0, (span_mm[0] + span_mm[1]) / 2.0])
    bare = _cylinder(diameter_mm / 2.0, length)
    full = _cylinder(diameter_mm / 2.0 + padding_mm, length + 2.0 * padding_mm) if padding_mm else bare
    radius_mm = float(np.hypot(diameter_mm, length)) / 2.0
    return Body(name, FLANGE_FRAME, T_flange_body, bare, full, radius_mm)


def _cylinder(radius_mm: float, length_mm: float) -> Shape:
    solid = Solid(partial(fcl.Cylinder, radius_mm, length_mm))
    return Shape((solid,), solid, (prism(radius_mm, length_mm),))
