"""The motions of a tour: from home through the standoffs of all touches by the shortest way, and back."""

from __future__ import annotations

from itertools import pairwise
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.order import shortest_tour
from puncture_twin.planning.touch.straight_approach import STANDOFF_MM, line_to
from puncture_twin.planning.touch.touch_plan import Touch, TouchTour


class NoMotionError(NoAnswerError):
    """No motion leads to the standoff of one of the touches."""

    def __init__(self, place: int, why: str) -> None:
        self.place = place
        super().__init__(why)


class Stops(NamedTuple):
    """Where the tip is to be set: names, points (n, 3), mm, base frame, and joints (n, 6), rad."""

    names: tuple[str, ...]
    points_base: Floats
    q_touch: Floats


def tour_through(context: CaseContext, stops: Stops, *, seed: int, progress: Count) -> TouchTour:
    """Plan the motions.

    Args:
        context: Of a case with an arm.
        stops: Each with a straight line to it that the arm can follow.
        seed: Of the planner.
        progress: Called with motions done and all of them.

    Raises:
        NoMotionError: None to a stop.
        NoAnswerError: None home.
    """
    assert context.reach is not None
    case, checker, home = context.case, context.reach.checker, home_configuration(context.case)
    tip_mm = case.needle.length_mm
    lines = [line_to(checker.model, tip_mm, q, STANDOFF_MM, 0.0) for q in stops.q_touch]
    places = np.array([*(line[0] for line in lines if line is not None), home])
    order = shortest_tour((np.abs(places[:, None] - places) / checker.model.max_speeds).max(axis=2))
    legs = []
    for start, end in pairwise([len(places) - 1, *order, len(places) - 1]):
        try:
            found = plan_approach(checker, places[start], places[end], seed=seed, speeds=case.robot.speeds)
        except NoAnswerError as error:
            if end in order:
                raise NoMotionError(end, str(error)) from error
            raise
        legs.append(found.trajectory)
        progress(len(legs), len(places))
    touched = zip(order, legs, strict=False)
    touches = (Touch(stops.names[at], stops.points_base[at], stops.q_touch[at], leg) for at, leg in touched)
    return TouchTour(case.robot.model, tip_mm, tuple(touches), legs[-1])
