"""Poses for a pivot calibration: the tip on one place, the needle tilted to several sides, as the workcell allows.

The place is a hole or a dimple next to the patient. Of the free poses those are taken that leave the tip least
uncertain: greedily, the next one that adds most to det(A'A) of `R_i x + p_i = c` (D-optimal design).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.case import bed_frame
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.search.context import CaseContext
from puncture_twin.planning.touch.touch_planner import PLANNED_PADDING_MM, approach_checkers
from puncture_twin.planning.touch.tour_motions import (
    ApproachCheckers,
    NoMotionError,
    Stops,
    TouchTour,
    tour_through,
    why_not,
)
from puncture_twin.planning.uncertainty.touch_choice import touch_candidates

LEAST_POSES, MOST_POSES = 4, 12
"""The order of more takes too long to be the best one."""

SPREAD = 2
"""So many free poses are wanted for each that is taken: else they lean to one side."""

RADII = (0.6, 0.8, 0.45)
"""Distances from the shoulder at which the flange is tried, over the arm's reach without its wrist."""

HEIGHTS = (0.0, 0.3, -0.3, 0.6)
"""Heights above the shoulder at which the flange is tried, over the same reach."""

SIDES = 12
"""Directions from the base in which they lie."""

ROLLS = (0.0, 2 * np.pi / 3, -2 * np.pi / 3)
"""Rolls of the flange about the needle, added to each tilt: they tell how far the tip is off the flange's axis."""

RIDGE = 1e-6
"""Added to A'A, so that fewer poses than unknowns can be compared."""


def plan_pivot(context: CaseContext, count: int, *, place_base: Floats | None, seed: int, progress: Count) -> TouchTour:
    """Plan to set the tip onto one place in several poses, named P1, P2 and so on.

    Args:
        count: How many poses, 4 to 12.
        place_base: Shape (3,), mm, where; None for a place that is found next to the patient.
        progress: Called with motions done and all of them.

    Raises:
        InputError: The case has no arm.
        NoAnswerError: No place, or not this one, can be touched in so many poses, or no motion was found.
    """
    context.require_arm()
    checkers = approach_checkers(context, PLANNED_PADDING_MM)
    places, most = _places(context) if place_base is None else [place_base], 0
    for place in places:
        free = _free_poses(context, checkers, place, count)
        most = max(most, len(free))
        if len(free) < count:
            continue
        q = free[spread_poses(flange_pose(checkers.whole.model, free)[:, :3, :3], count)]
        stops = Stops(tuple(f"P{row + 1}" for row in range(count)), np.tile(place, (count, 1)), q)
        try:
            return tour_through(context, stops, seed=seed, progress=progress)
        except NoMotionError:
            continue
    where = "no point was found that can" if place_base is None else "this point cannot"
    what = f"{where} be touched in {count} poses by collision-free motions: {most} poses at most"
    raise NoAnswerError(what, code="too_few_poses")


def spread_poses(R_base_flange: Floats, count: int) -> list[int]:
    """Rows of ``count`` rotations (n, 3, 3) that determine the tip best, the first one first."""
    A = np.concatenate([R_base_flange, np.broadcast_to(-np.eye(3), R_base_flange.shape)], axis=2)
    squares = np.swapaxes(A, 1, 2) @ A
    rows, whole = [0], squares[0] + RIDGE * np.eye(6)
    while len(rows) < count:
        gains = np.linalg.slogdet(whole + squares).logabsdet
        gains[rows] = -np.inf
        rows.append(int(np.argmax(gains)))
        whole = whole + squares[rows[-1]]
    return rows


def _places(context: CaseContext) -> Iterator[Floats]:
    """Places about the base, base frame, mm: those opposite the patient first."""
    assert context.reach is not None
    model, up = context.case.robot.model, _up_base(context)
    reach = abs(model.a2) + abs(model.a3)
    target = apply(context.reach.T_base_ct, context.case.target_ct)
    away = (target @ up) * up - target
    away = away / max(float(np.linalg.norm(away)), 1e-9)
    across = np.cross(up, away)
    for radius in RADII:
        for height in HEIGHTS:
            for side in sorted(np.linspace(-np.pi, np.pi, SIDES, endpoint=False), key=abs):
                flange = model.shoulder_base + reach * (radius * (np.cos(side) * away + np.sin(side) * across))
                yield flange + (reach * height - context.case.needle.length_mm) * up


def _up_base(context: CaseContext) -> Floats:
    """Unit direction against gravity, base frame."""
    assert context.reach is not None
    return np.asarray(context.reach.T_base_ct[:3, :3] @ bed_frame(context.case)[:3, 2])


def _free_poses(context: CaseContext, checkers: ApproachCheckers, place_base: Floats, count: int) -> Floats:
    """Joints (n, 6), rad, with the tip on a place that nothing obstructs, from above first."""
    model, tip_mm = checkers.whole.model, context.case.needle.length_mm
    empty = np.empty((0, 6))
    for q in _from_above(model, tip_mm, place_base, _up_base(context), home_configuration(context.case)):
        if why_not(checkers, tip_mm, q):
            continue
        tilted = touch_candidates(model, tip_mm, place_base, q).alike
        if len(tilted) < SPREAD * count:
            continue
        every = (tilted + roll * np.eye(6)[5] for roll in ROLLS)
        free = np.array([one for q in every for one in q if not why_not(checkers, tip_mm, one)]).reshape(-1, 6)
        if len(free) >= count:
            return np.asarray(free)
    return empty


def _from_above(model: UrModel, tip_mm: float, place_base: Floats, up_base: Floats, home: Floats) -> Floats:
    """Joints (n, 6), rad, with the needle straight down onto a place."""
    q = inverse(model, flange_poses(place_base, up_base, tip_mm)).reshape(-1, 6)
    q = nearest_within_limits(model, q, home)
    q = q[~np.isnan(q).any(axis=1)]
    q = q[away_from_singularities(model, q)]
    return np.asarray(q[np.argsort(np.abs(q - home).max(axis=1), kind="stable")])
