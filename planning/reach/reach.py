"""Which directions the arm can reach and insert along: standoff pose, straight insertion, nothing touched on the path.

Retraction is the same motion backwards, so what may be inserted may be withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.insertion import (
    NeedleLine,
    away_from_singularities,
    every_branch,
    first_stop,
    flange_at,
    needle_lines,
    reach_margin,
    survey,
    why_unreachable,
)
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.checker import Contact, StateChecker
from puncture_twin.planning.reach.answer import ReachAnswer, ReachRequest
from puncture_twin.planning.reach.sampling import sampled

__all__ = [
    "MAX_SWEEP_MM",
    "ReachAnswer",
    "ReachRequest",
    "assess_reach_all",
    "every_reach",
]


MAX_SWEEP_MM = 2.0
"""Between two collision checks no body point moves farther, so that it is never more than half of this from where it
was checked."""

SAME_LENGTH_MM = 1e-6
"""Two statements of one needle's length may differ by this much: rounding."""

MARGIN_DIGITS = 9
"""Margins that agree to this many digits are equal, so that rounding does not choose between mirrored branches."""

ROLLS = 8
"""Rolls about the needle that are tried, evenly over the turn."""

CHUNK = 256
"""Requests between two reports of progress."""

ROLL_BODIES = frozenset({"wrist_3", "tool"})
"""The bodies that turn with the roll and are not round about the needle: other contacts are the same at any roll."""


class _Insertion(NamedTuple):
    """A motion from standoff to target on one branch at one roll."""

    line: NeedleLine
    branch: int
    roll: float
    turn: Floats
    """Shape (6,), rad: what to add to the branch's path at roll 0, the roll and whole turns."""
    standoff: Floats
    """Shape (6,), rad: where the motion begins."""


class _Blocked(NamedTuple):
    """Where a motion ends early, and whether another roll on the same branch would touch the same."""

    depth_mm: float
    detail: str
    at_any_roll: bool = True
    at_standoff: bool = False
    contact: Contact | None = None


class _Tried(NamedTuple):
    """A motion that was checked for contacts; ``block`` is None when it is clear to the target."""

    q: Floats
    depths: Floats
    block: _Blocked | None


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
    surveyed = next(_surveyed(checker, [request], ROLLS))
    insertions = list(surveyed.insertions())
    tried = _tried_all(checker, [(surveyed, insertion) for insertion in insertions])
    return [_success(checker.model, *one) for one in zip(insertions, tried, strict=True) if one[1].block is None]


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


class _Surveyed(NamedTuple):
    """What kinematics alone says of one request."""

    request: ReachRequest
    line: NeedleLine
    depths: Floats
    rolls: Floats
    stop_at: NDArray[np.int64]
    starts: Floats
    margins: Floats
    turns: Floats

    def insertions(self, without: Container[int] = ()) -> Iterator[_Insertion]:
        """The motions that kinematics allows, the best margin first; of equals the first branch, then the first roll.

        Branches that ``without`` has come to hold are passed over.
        """
        branches, rolled = np.nonzero(~np.isnan(self.margins))
        order = np.argsort(-np.round(self.margins[branches, rolled], MARGIN_DIGITS), kind="stable")
        for branch, roll in zip(branches[order].tolist(), rolled[order].tolist(), strict=True):
            if branch not in without:
                turn = self.turns[branch, roll]
                yield _Insertion(self.line, branch, float(self.rolls[roll]), turn, self.starts[branch] + turn)


def _surveyed(checker: StateChecker, requests: Sequence[ReachRequest], n_rolls: int) -> Iterator[_Surveyed]:
    for request in requests:
        if abs(request.needle_length_mm - checker.tool.needle_length_mm) > SAME_LENGTH_MM:
            allowed = f"the tool's {checker.tool.needle_length_mm}"
            raise InputError(f"needle_length_mm = {request.needle_length_mm}", where="reach request", allowed=allowed)
    if n_rolls < 1:
        raise InputError(f"n_rolls = {n_rolls}", where="reach", allowed="above 0")
    depths = [_depths(request) for request in requests]
    rolls = 2.0 * math.pi * np.arange(n_rolls) / n_rolls
    targets = np.array([request.target_base for request in requests])
    outwards = np.array([request.outward_base for request in requests])
    distances = [_distances(request, depth) for request, depth in zip(requests, depths, strict=True)]
    lines = needle_lines(targets, outwards)
    found = survey(checker.model, lines, distances, depths, rolls)
    for request, line, depth, *of_request in zip(requests, lines, depths, *found, strict=True):
        yield _Surveyed(request, line, depth, rolls, *of_request)


def _answers(checker: StateChecker, requests: Sequence[ReachRequest], n_rolls: int) -> list[ReachAnswer]:
    """Of each request; round by round the next motion of all that have no answer yet."""
    searches = [_Search(found) for found in _surveyed(checker, requests, n_rolls)]
    waiting = searches
    while waiting := [search for search in waiting if search.next is not None]:
        nexts = [(search.surveyed, search.next) for search in waiting if search.next is not None]
        for search, tried in zip(waiting, _tried_all(checker, nexts), strict=True):
            search.take(tried)
    return [search.answer(checker.model) for search in searches]


class _Search:
    """The search for the first clear motion of one request: what is tried next, and what came of those before."""

    def __init__(self, surveyed: _Surveyed) -> None:
        self.surveyed = surveyed
        self._hopeless: set[int] = set()
        self._blocks: list[_Blocked] = []
        self._found: _Tried | None = None
        self._insertions = surveyed.insertions(without=self._hopeless)
        self._best: _Insertion | None = None
        self.next = next(self._insertions, None)

    def take(self, tried: _Tried) -> None:
        """What came of the next motion: it is the answer, or there is another next one."""
        if tried.block is None:
            self._found, self._best, self.next = tried, self.next, None
            return
        assert self.next is not None  # it was tried
        self._blocks.append(tried.block)
        if tried.block.at_any_roll:
            self._hopeless.add(self.next.branch)
        self.next = next(self._insertions, None)

    def answer(self, model: UrModel) -> ReachAnswer:
        """Of a search that is over: the first motion that touches nothing; else a refusal with what came farthest."""
        if self._found is not None and self._best is not None:
            return _success(model, self._best, self._found)
        if not self._blocks:
            found = self.surveyed
            return _why_none(model, found.request, found.line, found.depths, found.stop_at)
        deepest = max(self._blocks, key=lambda block: block.depth_mm)  # the first of equals: the best margin
        if deepest.at_standoff:
            return ReachAnswer.refused(Reason.ARM_COLLISION, None, deepest.detail, deepest.contact)
        return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail, deepest.contact)


def _why_none(
    model: UrModel, request: ReachRequest, line: NeedleLine, depths: Floats, stop_at: NDArray[np.int64]
) -> ReachAnswer:
    """The refusal of a direction along which kinematics allows no motion."""
    if (stop_at < 0).any():
        return ReachAnswer.refused(Reason.UNREACHABLE, None, "every roll and branch leaves the joint limits")
    distances = _distances(request, depths)
    paths = every_branch(model, line, distances)
    reached = away_from_singularities(model, paths[:, 0])
    if not reached.any():
        why = why_unreachable(model, flange_at(line, distances[0]))
        return ReachAnswer.refused(Reason.UNREACHABLE, None, why)
    stops = [first_stop(model, path, depths) for path in paths[reached]]
    deepest = max((stop for stop in stops if stop), key=lambda stop: stop.depth_mm)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail)


def _depths(request: ReachRequest) -> Floats:
    return np.linspace(0.0, request.standoff_mm, math.ceil(request.standoff_mm / MAX_SWEEP_MM) + 1)


def _distances(request: ReachRequest, depths_mm: Floats) -> Floats:
    """Target to flange at each depth, mm."""
    return request.needle_length_mm + request.standoff_mm - depths_mm


def _tried_all(checker: StateChecker, motions: Sequence[tuple[_Surveyed, _Insertion]]) -> list[_Tried]:
    """Check motions for contacts: the standoffs of all at once, then those motions whose standoff is clear."""
    standoffs = np.array([insertion.standoff for _, insertion in motions]).reshape(-1, 6)
    contacts = checker.contacts(standoffs, needle_may_touch_patient=False)
    return [
        _tried(checker, surveyed.request, insertion, surveyed.depths)
        if contact is None
        else _blocked_at_standoff(surveyed, insertion, contact)
        for (surveyed, insertion), contact in zip(motions, contacts, strict=True)
    ]


def _blocked_at_standoff(surveyed: _Surveyed, insertion: _Insertion, contact: Contact) -> _Tried:
    """A motion whose standoff touches something."""
    detail = f"{contact.body} touches {contact.other} at standoff"
    block = _Blocked(0.0, detail, ROLL_BODIES.isdisjoint(contact), at_standoff=True, contact=contact)
    return _Tried(insertion.standoff[None], surveyed.depths[:1], block)


def _tried(checker: StateChecker, request: ReachRequest, insertion: _Insertion, depths: Floats) -> _Tried:
    """Check one motion for contacts, whose standoff is clear."""
    model = checker.model
    lengths = request.needle_length_mm, request.standoff_mm
    line, branch, turn = insertion.line, insertion.branch, insertion.turn
    q, depths = sampled(checker.swept, line, branch, turn, lengths, len(depths), MAX_SWEEP_MM)
    stop = first_stop(model, q, depths)
    if stop is not None:
        return _Tried(q, depths, _Blocked(stop.depth_mm, stop.detail))
    if reach_margin(model, q) < 0.0:
        return _Tried(q, depths, _Blocked(0.0, "a joint leaves its limits on the way", at_any_roll=False))
    first = checker.first_contact(q, needle_may_touch_patient=True)
    if first is None:
        return _Tried(q, depths, None)
    depth, contact = float(depths[first.at]), first.contact
    detail = f"{contact.body} touches {contact.other} {depth:.1f} mm after the standoff"
    return _Tried(q, depths, _Blocked(depth, detail, ROLL_BODIES.isdisjoint(contact), contact=contact))


def _success(model: UrModel, insertion: _Insertion, tried: _Tried) -> ReachAnswer:
    margin = reach_margin(model, tried.q)
    return ReachAnswer(
        True, Reason.NONE, None, "", None, insertion.roll, insertion.branch, tried.q, tried.depths, margin
    )
