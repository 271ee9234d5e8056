"""Planned touches executed in the simulator: marker after marker, and home; one that fails does not end the tour."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.bed import bed_frame
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.surroundings import case_boxes
from puncture_twin.planning.collision.workcell import case_tool, patient_surface
from puncture_twin.planning.touch.straight_approach import ApproachCheckers
from puncture_twin.planning.touch.touch_plan import TouchTour
from puncture_twin.twin.plant.touch_truth import TouchTruth
from puncture_twin.twin.rehearsal.one_touch import (
    FailedTouch,
    StoppedError,
    TouchingCell,
    TouchReading,
    moved_outside,
    seconds_of,
    touch_marker,
)
from puncture_twin.twin.world.control.rigid_model import rigid_model
from puncture_twin.twin.world.workcell import open_workcell


@dataclass(frozen=True, eq=False)
class Touched:
    """All of them, in their order.

    Attributes:
        readings: One a marker that was felt.
        failed: Marker to why it was not read, in words.
        seconds: Home to home; where the arm stopped, of the touches before that.
    """

    readings: tuple[TouchReading, ...]
    failed: Mapping[str, str]
    seconds: float


def execute_touches(
    tour: TouchTour, case: Case, anatomy: Anatomy, checkers: ApproachCheckers, truth: TouchTruth, progress: Count
) -> Touched:
    """Touch the markers where they truly are. The same tour and truth give the same numbers.

    A marker that is not felt where it should be is given up with its reason, and the arm goes on from its standoff.
    Where the arm or needle touched something else it stops, and what was not read by then stays unread.

    Args:
        tour: Where, in which order, by which motions.
        case: For tool, boxes and gravity.
        anatomy: For the skin.
        checkers: Of the workcell as it is believed: a line moved at the standoff is checked again.
        truth: All randomness but the force sensor's is in it, and that comes from its seed.
        progress: Called with touches done and all of them.
    """
    tool, T = case_tool(case), truth.T_base_ct
    down_ct = -bed_frame(case)[:3, 2]
    with (
        open_workcell(tour.model, tool, anatomy.skin.mesh, T, case_boxes(case, T), down_ct=down_ct) as room,
        rigid_model(tour.model, tool, T[:3, :3] @ down_ct) as rigid,
    ):
        true = CellChecker(tour.model, tool, patient=patient_surface(anatomy).transformed(T))
        cell = TouchingCell(room, rigid, tour, truth, checkers, true, np.random.default_rng([truth.seed, 1]))
        room.arm.place(tour.touches[0].come.q[0])
        return _tour(cell, progress)


def _tour(cell: TouchingCell, progress: Count) -> Touched:
    """Every marker, and home."""
    readings: list[TouchReading] = []
    failed: dict[str, str] = {}
    touches, seconds = cell.tour.touches, 0.0
    try:
        for number, touch in enumerate(touches):
            found = touch_marker(cell, touch)
            if isinstance(found, FailedTouch):
                failed[touch.name] = found.why
            else:
                readings.append(found)
            seconds += found.seconds
            progress(number + 1, len(touches))
        seconds += seconds_of(moved_outside(cell, cell.tour.leave, np.zeros(6)))
    except StoppedError as stop:
        done = {one.name for one in readings} | set(failed)
        failed |= {touch.name: f"the tour was stopped: {stop}" for touch in touches if touch.name not in done}
    return Touched(tuple(readings), failed, seconds)
