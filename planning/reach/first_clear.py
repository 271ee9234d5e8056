"""The search for the first clear motion of each of many requests."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.collision.bodies.body import BODY_NAMES
from puncture_twin.planning.collision.state_checker import Contact, StateChecker
from puncture_twin.planning.reach.answer import ReachAnswer
from puncture_twin.planning.reach.survey import MARGIN_DIGITS, Insertion, Surveyed
from puncture_twin.planning.reach.trial import Blocked, blocked_at_standoff, tried


class NextMotions(NamedTuple):
    """Of each request whose search goes on, the motion that is tried next."""

    rows: Ints
    """Shape (m,): which requests."""
    branches: Ints
    rolls: Ints
    standoffs: Floats
    """Shape (m, 6), rad: where the motions begin."""
    round_clear: Bools
    """Shape (m,): whether holder and needle are known to touch neither patient nor boxes there."""


class FirstClear:
    """The searches of many requests, side by side: of each the motions that kinematics allows, the best margin first.

    All motions of a request begin with the needle in the same place, and needle and holder are round about its axis: if
    they were clear of patient and boxes once, they need not be checked again.

    Attributes:
        answers: Of each request its first motion that touches nothing; None as long as there is none.
        deepest: Of each what blocked the motion that came farthest, of equals the best margin's; None if nothing did.
    """

    def __init__(self, surveyed: Sequence[Surveyed]) -> None:
        self.answers: list[ReachAnswer | None] = [None] * len(surveyed)
        self.deepest: list[Blocked | None] = [None] * len(surveyed)
        self._surveyed = surveyed
        self._starts = np.array([found.starts for found in surveyed])
        self._turns = np.array([found.turns for found in surveyed])
        margins = np.array([found.margins for found in surveyed])
        flat = margins.reshape(len(surveyed), -1)
        order = np.argsort(-np.round(flat, MARGIN_DIGITS), axis=1, kind="stable")  # NaN comes last
        self._left = ~np.isnan(np.take_along_axis(flat, order, axis=1))
        self._branches, self._rolls = np.divmod(order, margins.shape[2])
        self._round_clear = np.zeros(len(surveyed), np.bool_)

    def next_motions(self) -> NextMotions:
        """What is tried next; of no requests where all searches are over."""
        rows = np.flatnonzero(self._left.any(axis=1))
        at = self._left[rows].argmax(axis=1)
        branches, rolls = self._branches[rows, at], self._rolls[rows, at]
        standoffs = self._starts[rows, branches] + self._turns[rows, branches, rolls]
        return NextMotions(rows, branches, rolls, standoffs, self._round_clear[rows])

    def take(self, checker: StateChecker, motions: NextMotions, contacts: Sequence[Contact | None]) -> None:
        """Go on from what the motions touch at their standoffs, and check those along the path that touch nothing."""
        tries = [self._tried(checker, motions, *each) for each in enumerate(contacts)]
        for row, found in zip(motions.rows.tolist(), tries, strict=True):
            if isinstance(found, ReachAnswer):
                self.answers[row] = found
            elif (most := self.deepest[row]) is None or found.depth_mm > most.depth_mm:
                self.deepest[row] = found
        over = np.array([isinstance(found, ReachAnswer) for found in tries], np.bool_)
        hopeless = np.array([isinstance(found, Blocked) and found.at_any_roll for found in tries], np.bool_)
        self._left[motions.rows, self._left[motions.rows].argmax(axis=1)] = False
        self._left[motions.rows[over]] = False
        rows = motions.rows[hopeless]
        self._left[rows] &= self._branches[rows] != motions.branches[hopeless, None]
        past = [contact is None or contact.other in BODY_NAMES for contact in contacts]  # the workcell is checked first
        self._round_clear[motions.rows] |= np.array(past, np.bool_)

    def drop_folded(self, checker: StateChecker) -> None:
        """Drop the branches on which the arm touches itself at the standoff whatever the roll.

        To be called where a motion of each request was tried: those that go no farther than the standoff change neither
        its answer nor what was deepest.
        """
        rows, at = np.nonzero(self._left)
        left = np.zeros(self._starts.shape[:2], np.bool_)
        left[rows, self._branches[rows, at]] = True
        branches, rows = np.nonzero(left.T)  # neighbours in turn: what is proven of one is nearly proven of the next
        left[rows, branches] = ~checker.folded(self._starts[rows, branches] + self._turns[rows, branches, 0])
        self._left &= np.take_along_axis(left, self._branches, axis=1)

    def _tried(
        self, checker: StateChecker, motions: NextMotions, at: int, contact: Contact | None
    ) -> ReachAnswer | Blocked:
        """What comes of one of the motions, which touches so at its standoff."""
        if contact is not None:
            return blocked_at_standoff(contact)
        found, branch, roll = self._surveyed[motions.rows[at]], int(motions.branches[at]), int(motions.rolls[at])
        turn = found.turns[branch, roll]
        insertion = Insertion(found.line, branch, float(found.rolls[roll]), turn, motions.standoffs[at])
        return tried(checker, found, insertion)
