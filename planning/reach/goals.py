"""Where the approach may end: every roll, branch and whole turn on which the arm holds one direction."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.arm.insertion import reach_margin
from puncture_twin.planning.arm.inverse_kinematics import wrapped_solutions
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.reach.answer import ReachAnswer, ReachRequest
from puncture_twin.planning.reach.reach import every_reach

MARGIN_FRACTION = 0.5
"""A pose with less than this fraction of the best margin is no goal: a shorter path is not worth a cramped arm."""

NEAREST = 4
"""Goals kept of each branch: those nearest to home."""


def approach_goals(checker: StateChecker, request: ReachRequest, q_home: Floats) -> list[ReachAnswer]:
    """The motions that may follow an approach, nearest to home first; empty if the arm does not reach the direction.

    Each answer of :func:`every_reach`, and the same with any joint turned by whole turns, as long as all of the
    insertion stays within the limits.

    Args:
        checker: Judges contacts, in the base frame.
        request: The direction.
        q_home: Shape (6,), rad.

    Raises:
        InputError: See :func:`every_reach`.
    """
    reached = every_reach(checker, request)
    least = MARGIN_FRACTION * max((answer.margin for answer in reached), default=0.0)
    every = [rotated for answer in reached for rotated in _rotated(checker, answer) if rotated.margin >= least]
    every.sort(key=lambda answer: float(np.linalg.norm(answer.insertion_q[0] - q_home)))
    kept: dict[int, list[ReachAnswer]] = {}
    for answer in every:
        kept.setdefault(answer.branch, []).append(answer)
    chosen = {id(answer) for branch in kept.values() for answer in branch[:NEAREST]}
    return [answer for answer in every if id(answer) in chosen]


def _rotated(checker: StateChecker, answer: ReachAnswer) -> list[ReachAnswer]:
    """An answer with every combination of whole turns that its limits allow; the bodies stand where they stood."""
    motions = [
        answer.insertion_q + (q - answer.insertion_q[0])
        for q in wrapped_solutions(checker.model, answer.insertion_q[0])
    ]
    inside = [q for q in motions if checker.model.within_limits(q).all()]
    return [replace(answer, insertion_q=q, margin=reach_margin(checker.model, q)) for q in inside]
