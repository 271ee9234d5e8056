"""Reach: which directions the arm can insert along, from a standoff pose straight to the target, without contact.

`assess_reach_all` checks many directions: kinematics of all first (`surveyed`), then for each the motions that it
allows, the best margin first, until one is clear. `approach_goals` lists where an approach to one direction may end.
Retraction is the insertion backwards, so what may be inserted may be withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import (
    MARGIN_DIGITS,
    MAX_SWEEP_MM,
    Insertion,
    NeedleLine,
    ReachRequest,
    Surveyed,
    every_branch,
    fill_branch_path,
    first_stop,
    flange_poses,
    needle_lines,
    reach_margin,
    surveyed,
)
from puncture_twin.planning.arm.inverse_kinematics import why_unreachable, wrapped_solutions
from puncture_twin.planning.arm.kinematics import away_from_singularities, link_frames
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.bodies import BODY_NAMES, Contact
from puncture_twin.planning.collision.checker import CellChecker, SweptBodies, motion_bounds


@dataclass(frozen=True, eq=False)
class ReachAnswer:
    """Answer to a reach request: the insertion, or the reason why there is none."""

    reachable: bool
    reason: Reason
    """``NONE``, ``UNREACHABLE``, ``ARM_COLLISION`` (at standoff) or ``INSERTION_BLOCKED``."""
    depth_mm: float | None
    """How far the needle was inserted from standoff when it was blocked; None for other reasons."""
    detail: str  # one sentence for people: what touched what, or what was missing; empty when reachable
    contact: Contact | None  # what touched what, where that was the reason
    roll: float  # turn about the needle against :func:`flange_poses`' zero, rad; NaN when not reachable
    branch: int  # index among the eight branches of ``inverse``; -1 when not reachable
    insertion_q: Floats
    """Shape (m, 6), rad: standoff first, tip on the target last; empty when not reachable."""
    insertion_depth_mm: Floats  # shape (m,), mm inserted from standoff at each row
    margin: float
    """0..1, the least over the insertion of: each joint's distance to its limits over a quarter turn, and the three
    singularity terms. 0 when not reachable."""

    @classmethod
    def refused(
        cls, reason: Reason, depth_mm: float | None, detail: str, contact: Contact | None = None
    ) -> ReachAnswer:
        """The answer for a direction that the arm does not reach, or not to the target."""
        return cls(False, reason, depth_mm, detail, contact, math.nan, -1, np.empty((0, 6)), np.empty(0), 0.0)

    def __post_init__(self) -> None:
        self.insertion_q.setflags(write=False)
        self.insertion_depth_mm.setflags(write=False)


def refusal(model: UrModel, survey: Surveyed, deepest: Blocked | None) -> ReachAnswer:
    """The refusal of a request without a clear motion: ``deepest`` blocked the one that came farthest, if any began."""
    if deepest is not None and deepest.at_standoff:
        return ReachAnswer.refused(Reason.ARM_COLLISION, None, deepest.detail, deepest.contact)
    if deepest is not None:
        return ReachAnswer.refused(Reason.INSERTION_BLOCKED, deepest.depth_mm, deepest.detail, deepest.contact)
    if (survey.stop_at < 0).any():
        return ReachAnswer.refused(Reason.UNREACHABLE, None, "every roll and branch leaves the joint limits")
    reached = away_from_singularities(model, survey.starts)
    if not reached.any():
        T_base_flange = flange_poses(survey.line.target, survey.line.outward, survey.distances[0])
        return ReachAnswer.refused(Reason.UNREACHABLE, None, why_unreachable(model, T_base_flange[0]))
    paths = every_branch(model, survey.line, survey.distances)
    stops = [first_stop(model, path, survey.depths) for path in paths[reached]]
    farthest = max((stop for stop in stops if stop), key=lambda stop: stop.depth_mm)
    return ReachAnswer.refused(Reason.INSERTION_BLOCKED, farthest.depth_mm, farthest.detail)


ROLLS = 8
"""Rolls about the needle that are tried, evenly over the turn."""
CHUNK = 256
"""Requests between two reports of progress."""


def assess_reach_all(
    checker: CellChecker, requests: Sequence[ReachRequest], progress: Count | None = None, *, n_rolls: int = ROLLS
) -> list[ReachAnswer]:
    """Find, for each direction, a roll and a branch that reach the standoff pose and insert straight, untouched.

    All (roll, branch) pairs are ordered by margin; the first that is clear is the answer, so it is the best of them.
    Kinematics comes first, for a chunk of requests; then contacts, of each request's next motion at once.

    Args:
        checker: Checks contacts, in the base frame.
        n_rolls: How many rolls, evenly over the turn.
    """
    answers: list[ReachAnswer] = []
    for start in range(0, len(requests), CHUNK):
        answers += _answers(checker, requests[start : start + CHUNK], n_rolls)
        if progress is not None:
            progress(len(answers), len(requests))
    return answers


def every_reach(checker: CellChecker, request: ReachRequest) -> list[ReachAnswer]:
    """Every roll and branch that reaches the standoff pose and inserts straight, untouched; the best margin first."""
    survey = _surveyed(checker, [request], ROLLS)[0]
    motions = [*survey.insertions()]
    standoffs = np.array([insertion.standoff for insertion in motions]).reshape(-1, 6)
    contacts = checker.contacts(standoffs, needle_may_touch_patient=False)
    answers = (check_motion(checker, survey, *pair) for pair in zip(motions, contacts, strict=True))
    return [answer for answer in answers if isinstance(answer, ReachAnswer)]


def _answers(checker: CellChecker, requests: Sequence[ReachRequest], n_rolls: int) -> list[ReachAnswer]:
    """The reach answer of each request; round by round the next motion of all that have none yet."""
    surveys = _surveyed(checker, requests, n_rolls)
    search = FirstClear(checker, surveys)
    if search.goes_on:
        search.try_next()
        search.drop_folded()
    while search.goes_on:
        search.try_next()
    return [
        refusal(checker.model, survey, deepest) if answer is None else answer
        for survey, answer, deepest in zip(surveys, search.answers, search.deepest, strict=True)
    ]


def _surveyed(checker: CellChecker, requests: Sequence[ReachRequest], n_rolls: int) -> list[Surveyed]:
    targets = np.array([request.target_base for request in requests])
    outwards = np.array([request.outward_base for request in requests])
    rolls = 2.0 * math.pi * np.arange(n_rolls) / n_rolls
    return surveyed(checker.model, requests, needle_lines(targets, outwards), rolls)


class FirstClear:
    """Searches of many requests, side by side: motions that kinematics allows, the best margin first.

    All motions of a request begin with the needle in the same place, and needle and holder are round about its axis: if
    they were clear of patient and boxes once, they need not be checked again.

    Attributes:
        answers: Of each request its first motion that touches nothing; None as long as there is none.
        deepest: Of each what blocked the motion that came farthest, of equals the best margin's; None if nothing did.
    """

    def __init__(self, checker: CellChecker, surveyed: Sequence[Surveyed]) -> None:
        self.answers: list[ReachAnswer | None] = [None] * len(surveyed)
        self.deepest: list[Blocked | None] = [None] * len(surveyed)
        self._checker, self._surveyed = checker, surveyed
        self._starts = np.array([found.starts for found in surveyed])
        self._turns = np.array([found.turns for found in surveyed])
        margins = np.array([found.margins for found in surveyed])
        flat = margins.reshape(len(surveyed), -1)
        order = np.argsort(-np.round(flat, MARGIN_DIGITS), axis=1, kind="stable")  # NaN comes last
        self._left = ~np.isnan(np.take_along_axis(flat, order, axis=1))
        self._branches, self._rolls = np.divmod(order, margins.shape[2])
        self._round_clear = np.zeros(len(surveyed), np.bool_)

    @property
    def goes_on(self) -> bool:
        """Whether any request has a motion left to try."""
        return bool(self._left.any())

    def try_next(self) -> None:
        """Try the next motion of each request that has one left: at its standoff, and if clear there along the path."""
        rows = np.flatnonzero(self._left.any(axis=1))
        at = self._left[rows].argmax(axis=1)
        branches, rolls, clear = self._branches[rows, at], self._rolls[rows, at], self._round_clear[rows]
        standoffs = self._starts[rows, branches] + self._turns[rows, branches, rolls]
        contacts = self._checker.contacts(standoffs, needle_may_touch_patient=False, round_clear=clear)
        self._left[rows, at] = False
        for row, branch, roll, standoff, contact in zip(
            rows.tolist(), branches.tolist(), rolls.tolist(), standoffs, contacts, strict=True
        ):
            survey = self._surveyed[row]
            motion = Insertion(survey.line, branch, float(survey.rolls[roll]), survey.turns[branch, roll], standoff)
            result = check_motion(self._checker, survey, motion, contact)
            if isinstance(result, ReachAnswer):
                self.answers[row] = result
                self._left[row] = False
                continue
            if (most := self.deepest[row]) is None or result.depth_mm > most.depth_mm:
                self.deepest[row] = result
            if result.at_any_roll:
                self._left[row] &= self._branches[row] != branch
        past = [contact is None or contact.other in BODY_NAMES for contact in contacts]  # the workcell is checked first
        self._round_clear[rows] |= np.array(past, np.bool_)

    def drop_folded(self) -> None:
        """Drop the branches on which the arm touches itself at the standoff whatever the roll.

        To be called where a motion of each request was tried: those that go no farther than the standoff change neither
        its answer nor what was deepest.
        """
        rows, at = np.nonzero(self._left)
        usable = np.zeros(self._starts.shape[:2], np.bool_)
        usable[rows, self._branches[rows, at]] = True
        branches, rows = np.nonzero(usable.T)  # neighbours follow one another: one proof nearly holds for the next
        usable[rows, branches] = ~self._checker.folded(self._starts[rows, branches] + self._turns[rows, branches, 0])
        self._left &= np.take_along_axis(usable, self._branches, axis=1)


ROLL_BODIES = frozenset({"wrist_3", "tool"})
"""The bodies that turn with the roll and are not round about the needle: other contacts are the same at any roll."""


class Blocked(NamedTuple):
    """Depth at which a motion ends early, its reason, and whether another roll on the same branch has it too."""

    depth_mm: float
    detail: str
    at_any_roll: bool = True
    at_standoff: bool = False
    contact: Contact | None = None


def check_motion(
    checker: CellChecker, survey: Surveyed, insertion: Insertion, contact: Contact | None
) -> ReachAnswer | Blocked:
    """The answer that one motion gives, by its contact at the standoff and the contacts on its way to the target."""
    if contact is not None:
        detail = f"{contact.body} touches {contact.other} at standoff"
        return Blocked(0.0, detail, ROLL_BODIES.isdisjoint(contact), at_standoff=True, contact=contact)
    model = checker.model
    lengths = survey.request.needle_length_mm, survey.request.standoff_mm
    line, branch, roll, turn, _ = insertion
    q, depths = sampled(checker.swept, line, branch, turn, lengths, len(survey.depths), MAX_SWEEP_MM)
    stop = first_stop(model, q, depths)
    if stop is not None:
        return Blocked(stop.depth_mm, stop.detail)
    margin = reach_margin(model, q)
    if margin < 0.0:
        return Blocked(0.0, "a joint would leave its limits during the insertion", at_any_roll=False)
    first = checker.first_contact(q, needle_may_touch_patient=True)
    if first is None:
        return ReachAnswer(True, Reason.NONE, None, "", None, roll, branch, q, depths, margin)
    depth, contact = float(depths[first.at]), first.contact
    detail = f"{contact.body} touches {contact.other} {depth:.1f} mm after the standoff"
    return Blocked(depth, detail, ROLL_BODIES.isdisjoint(contact), contact=contact)


def sampled(
    swept: SweptBodies,
    line: NeedleLine,
    branch: int,
    turn: Floats,
    lengths_mm: tuple[float, float],
    samples: int,
    most_mm: float,
) -> tuple[Floats, Floats]:
    """The motion of one branch along a needle, sampled so that no body moves more than so far from state to state.

    States (m, 6), rad, NaN from where the branch first does not exist; and depths (m,), mm from the standoff, even.

    Args:
        branch: Index among the eight of ``inverse``.
        turn: Shape (6,), rad: added to every state.
        lengths_mm: Flange to tip, and tip to target at the standoff.
        samples: To begin with, 2 or more.
        most_mm: What no body's motion exceeds; see :meth:`SweptBodies.bounds_mm`.
    """
    bodies = swept.corners, swept.longest_lever_mm
    q, depths = _sampled(swept.model.lengths, *line, branch, turn, lengths_mm, samples, bodies, most_mm)
    return q, depths


@nb.njit(cache=True)
def _sampled(  # type: ignore[no-untyped-def]  # numba infers
    lengths, R, target, outward, branch, turn, lengths_mm, samples, bodies, most_mm
):
    """Fill the states of `sampled`: with as many more samples as the largest motion demands, until none are."""
    needle, standoff = lengths_mm
    while True:
        step = standoff / (samples - 1)
        depths, distances = np.empty(samples), np.empty(samples)
        for k in range(samples):
            depths[k] = k * step if k < samples - 1 else standoff
            distances[k] = needle + standoff - depths[k]
        q, frames, bounds = np.empty((samples, 6)), np.empty((samples, 7, 4, 4)), np.empty((samples - 1, 6))
        fill_branch_path(lengths, R, target, outward, distances, branch, turn, q)
        link_frames(lengths, q, frames)
        motion_bounds(frames, q, bodies[0], bodies[1], bounds)
        worst = bounds.max()
        if not worst > most_mm:  # NaN: the branch ends early
            return q, depths
        samples = math.ceil((samples - 1) * worst / most_mm) + 1


MARGIN_FRACTION = 0.5
"""A pose with less than this fraction of the best margin is no goal: a shorter path is not worth a cramped arm."""
NEAREST = 4
"""Goals kept of each branch: those nearest to home."""


def approach_goals(checker: CellChecker, request: ReachRequest, q_home: Floats) -> list[ReachAnswer]:
    """The motions that may follow an approach, nearest to home first; empty if the arm does not reach the direction.

    Each answer of :func:`every_reach`, and the same with any joint rotated by whole turns, as long as all of the
    insertion stays within the limits. ``q_home`` (6,), rad.
    """
    reached = every_reach(checker, request)
    least = MARGIN_FRACTION * max((answer.margin for answer in reached), default=0.0)
    every = [rotated for answer in reached for rotated in _rotated(checker, answer) if rotated.margin >= least]
    every.sort(key=lambda answer: float(np.linalg.norm(answer.insertion_q[0] - q_home)))
    by_branch: dict[int, list[ReachAnswer]] = {}
    for answer in every:
        by_branch.setdefault(answer.branch, []).append(answer)
    chosen = {id(answer) for branch in by_branch.values() for answer in branch[:NEAREST]}
    return [answer for answer in every if id(answer) in chosen]


def _rotated(checker: CellChecker, answer: ReachAnswer) -> list[ReachAnswer]:
    """An answer with every combination of whole turns that its limits allow; the bodies stand where they stood."""
    motions = [
        answer.insertion_q + (q - answer.insertion_q[0])
        for q in wrapped_solutions(checker.model, answer.insertion_q[0])
    ]
    inside = [q for q in motions if checker.model.within_limits(q).all()]
    return [replace(answer, insertion_q=q, margin=reach_margin(checker.model, q)) for q in inside]
