"""Which directions the arm can reach and insert along: standoff pose, straight insertion, nothing touched on the path.

Retraction is the same motion backwards, so what may be inserted may be withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.arm.insertion import first_stop, needle_lines
from puncture_twin.planning.arm.singularity import away_from_singularities
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.reach.answer import ReachAnswer, ReachRequest
from puncture_twin.planning.reach.branch_paths import every_branch
from puncture_twin.planning.reach.first_clear import FirstClear
from puncture_twin.planning.reach.survey import Surveyed, surveyed
from puncture_twin.planning.reach.trial import Blocked, tried_all
from puncture_twin.planning.reach.unreachable import why_unreachable


def refusal(model: UrModel, found: Surveyed, deepest: Blocked | None) -> ReachAnswer:
    """Of a request without a clear motion: what came farthest.

    Args:
        model: The arm.
        found: What kinematics says of the request.
        deepest: What blocked the motion that came farthest of those that it allows; None if it allows none.
    """
    if deepest is None:
        return _refusal_of_kinematics(model, found)
    if deepest.at_standoff:
        return ReachAnswer.refused(Reason.ARM_COLLISION, None, deepest.detail, deepest.contact)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail, deepest.contact)


def _refusal_of_kinematics(model: UrModel, found: Surveyed) -> ReachAnswer:
    """The refusal of a direction along which kinematics allows no motion."""
    if (found.stop_at < 0).any():
        return ReachAnswer.refused(Reason.UNREACHABLE, None, "every roll and branch leaves the joint limits")
    reached = away_from_singularities(model, found.starts)
    if not reached.any():
        R, target, outward = found.line
        T_base_flange = pose(R, target + found.distances[0] * outward)
        return ReachAnswer.refused(Reason.UNREACHABLE, None, why_unreachable(model, T_base_flange))
    paths = every_branch(model, found.line, found.distances)
    stops = [first_stop(model, path, found.depths) for path in paths[reached]]
    deepest = max((stop for stop in stops if stop), key=lambda stop: stop.depth_mm)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail)


SAME_LENGTH_MM = 1e-6
"""Two statements of one needle's length may differ by this much: rounding."""

ROLLS = 8
"""Rolls about the needle that are tried, evenly over the turn."""

CHUNK = 256
"""Requests between two reports of progress."""


def every_reach(checker: StateChecker, request: ReachRequest) -> list[ReachAnswer]:
    """Every roll and branch that reaches the standoff pose and inserts straight, untouched; the best margin first.

    Args:
        checker: Checks contacts, in the base frame.
        request: The direction.

    Returns:
        Empty where there is none.

    Raises:
        InputError: See :func:`assess_reach_all`.
    """
    found = _surveyed(checker, [request], ROLLS)[0]
    tried = tried_all(checker, [(found, insertion) for insertion in found.insertions()])
    return [answer for answer in tried if isinstance(answer, ReachAnswer)]


def assess_reach_all(
    checker: StateChecker,
    requests: Sequence[ReachRequest],
    progress: Count | None = None,
    *,
    n_rolls: int = ROLLS,
) -> list[ReachAnswer]:
    """Find, for each direction, a roll and a branch that reach the standoff pose and insert straight, untouched.

    All (roll, branch) pairs are ordered by margin; the first that is clear is the answer, so it is the best of them.
    Kinematics comes first, for a chunk of requests; then contacts, of each request's next motion at once.

    Args:
        checker: Checks contacts, in the base frame.
        requests: The directions.
        progress: Called with (answered, to answer).
        n_rolls: How many rolls, evenly over the turn.

    Raises:
        InputError: If a request's needle is not the checker's, or a number makes no sense.
    """
    answers: list[ReachAnswer] = []
    for start in range(0, len(requests), CHUNK):
        answers += _answers(checker, requests[start : start + CHUNK], n_rolls)
        if progress is not None:
            progress(len(answers), len(requests))
    return answers


def _answers(checker: StateChecker, requests: Sequence[ReachRequest], n_rolls: int) -> list[ReachAnswer]:
    """Of each request; round by round the next motion of all that have no answer yet."""
    surveys = _surveyed(checker, requests, n_rolls)
    search = FirstClear(surveys)
    _try_next(checker, search)
    search.drop_folded(checker)
    while _try_next(checker, search):
        pass
    return [
        refusal(checker.model, found, deepest) if answer is None else answer
        for found, answer, deepest in zip(surveys, search.answers, search.deepest, strict=True)
    ]


def _try_next(checker: StateChecker, search: FirstClear) -> bool:
    """Try the next motion of each request whose search goes on; whether there was one."""
    motions = search.next_motions()
    clear = motions.round_clear
    contacts = checker.contacts(motions.standoffs, needle_may_touch_patient=False, round_clear=clear)
    search.take(checker, motions, contacts)
    return len(motions.rows) > 0


def _surveyed(checker: StateChecker, requests: Sequence[ReachRequest], n_rolls: int) -> list[Surveyed]:
    """What kinematics alone says of the requests, which are checked first."""
    for request in requests:
        if abs(request.needle_length_mm - checker.tool.needle_length_mm) > SAME_LENGTH_MM:
            allowed = f"the tool's {checker.tool.needle_length_mm}"
            raise InputError(f"needle_length_mm = {request.needle_length_mm}", where="reach request", allowed=allowed)
    if n_rolls < 1:
        raise InputError(f"n_rolls = {n_rolls}", where="reach", allowed="above 0")
    targets = np.array([request.target_base for request in requests])
    outwards = np.array([request.outward_base for request in requests])
    rolls = 2.0 * math.pi * np.arange(n_rolls) / n_rolls
    return surveyed(checker.model, requests, needle_lines(targets, outwards), rolls)
