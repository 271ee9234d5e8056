"""Markers to be touched, and the motions of a tour: from home through all standoffs at least cost, and back."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import combinations, pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.motion.approach import plan_approach
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.straight_approach import STANDOFF_MM, line_to


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


RESOLUTION = 1e-9
"""Of costs, in their unit: sums of whole multiples are exact."""


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


def shortest_tour(cost: ArrayLike) -> tuple[int, ...]:
    """The order of n places of least total cost, by dynamic programming over subsets; of equal ones the first in order.

    Where costs are symmetric, a tour and its reverse cost the same: sums of rounded floats would choose between them.

    Source: Held and Karp 1962, "A dynamic programming approach to sequencing problems". 2^n n^2 steps: n to a dozen.

    Args:
        cost: Shape (n + 1, n + 1), symmetric or not: from row to column; the last row and column are home.

    Returns:
        The places 0 to n - 1 in order.

    >>> shortest_tour([[0, 9, 1, 9], [9, 0, 9, 1], [9, 1, 0, 9], [1, 9, 9, 0]])
    (0, 2, 1)
    """
    of = np.rint(np.asarray(cost, dtype=np.float64) / RESOLUTION).astype(np.int64).tolist()
    n = len(of) - 1
    best: dict[tuple[int, int], tuple[int, tuple[int, ...]]] = {(1 << k, k): (of[n][k], (k,)) for k in range(n)}
    for size in range(2, n + 1):
        for places in combinations(range(n), size):
            whole = sum(1 << k for k in places)
            for last in places:
                before = (best[whole & ~(1 << last), k] for k in places if k != last)
                best[whole, last] = min((so_far + of[order[-1]][last], (*order, last)) for so_far, order in before)
    whole = (1 << n) - 1
    return min((best[whole, last][0] + of[last][n], best[whole, last][1]) for last in range(n))[1]
