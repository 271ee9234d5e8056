"""Markers to be touched: each from a standoff, straight and slowly, and the motions between them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.trajectory import Trajectory


@dataclass(frozen=True, eq=False)
class Touch:
    """One marker.

    Attributes:
        name: The marker's.
        point_base: Shape (3,), mm: where it is believed to be.
        q_touch: Shape (6,), rad: the tip on it.
        come: From the last standoff, or home, to this one.
    """

    name: str
    point_base: Floats
    q_touch: Floats
    come: Trajectory


@dataclass(frozen=True, eq=False)
class TouchTour:
    """Touches one after another.

    Attributes:
        model: The arm.
        tip_mm: Flange to tip.
        touches: In the order in which they are touched.
        leave: From the last standoff home.
    """

    model: UrModel
    tip_mm: float
    touches: tuple[Touch, ...]
    leave: Trajectory


@dataclass(frozen=True, eq=False)
class TouchPlan(TouchTour):
    """A tour of the markers for a puncture.

    Attributes:
        left_out: Marker to why it is not touched, in words.
        expected_mm: Of the tip at the target when the registration comes from these touches (rms), mm.
        worst_mm: The same with the worst of the poses that could be taken, mm.
    """

    left_out: Mapping[str, str]
    expected_mm: float
    worst_mm: float
