"""Straight joint segments, checked by compiled proofs; FCL has the word where they say nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.check import Check
from puncture_twin.planning.collision.kernels import segments as segment_kernels
from puncture_twin.planning.collision.kernels.segment_parts import CONTACT, HALVINGS, NOT_FINITE, QUERY, Answer, Room
from puncture_twin.planning.collision.proofs import Proofs
from puncture_twin.planning.collision.state_checker import Contact, require_finite

LOOK_FIRST_RAD = 0.125
"""Down to parts of this length a segment is halved for all checks together: what it touches is found soonest so."""

FINE_MM = 1.0
"""A state answers for a part of a segment within which no body moves farther from it. So states that were checked are
no more than 2 mm of motion apart, which with 1 mm of padding proves the path between them; see :class:`CellChecker`."""

QUESTIONS = 256
"""Room for what one segment leaves to FCL, at first."""


class _Filled(NamedTuple):
    """What the compiled code fills."""

    room: Room
    answer: Answer


class SegmentChecker:
    """Checks whether straight joint segments are free. Not for several threads.

    What touched last is tested first. That decides which contact is named where there are several, and never whether a
    segment is free: each segment's proof begins anew.

    Args:
        model: The arm.
        checks: The questions that may find a contact.
        proofs: The same, packed.
        room: For them; several may share it, one after the other.
        clear_mm: What the padded arm is to keep from patient and boxes besides; of each body and obstacle that are
            nearer to one another at an end of the segment, most of their distance there. What is not proven to be kept
            counts as a contact.
    """

    def __init__(
        self, model: UrModel, checks: Sequence[Check], proofs: Proofs, room: Room, clear_mm: float = 0.0
    ) -> None:
        self._model, self._checks, self._clear_mm = model, checks, clear_mm
        self._packed = (proofs.scene, proofs.movers, model.lengths)
        self._order = np.arange(len(checks), dtype=np.int64)
        self._filled = _Filled(room, _empty_answer(QUESTIONS))

    def __call__(self, start: Floats, end: Floats) -> Contact | None:
        """A contact on the segment between two states (6,), rad, the needle being outside the patient; None if free.

        The end is checked as it is, and then the middles of ever smaller parts; all of the segment is proven clear but
        for parts within which no body moves farther than ``FINE_MM`` from a state where FCL finds nothing. The start
        itself is not looked at beyond that.

        Raises:
            InputError: If a state is not finite.
        """
        start, end, answered = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64), 0
        halvings = _halvings(end - start)
        while True:
            segment_kernels.check_segment(
                *self._packed, start, end, answered, halvings, FINE_MM, self._clear_mm, self._order, *self._filled
            )
            status, check, answered, count = self._filled.answer.status.tolist()
            if status == NOT_FINITE:
                require_finite(np.stack([start, end]))
            if status == CONTACT:
                return self._contact(check)
            if count > len(self._filled.answer.fractions):
                self._filled = self._filled._replace(answer=_empty_answer(2 * count))
                continue
            touching = self._touching(start, end, count)
            if touching is not None or status != QUERY:
                return touching

    def _touching(self, start: Floats, end: Floats, queries: int) -> Contact | None:
        """What FCL finds first where so many queries are left to it."""
        answer = self._filled.answer
        where = answer.fractions[:queries].tolist(), answer.checks[:queries].tolist()
        for fraction, at in zip(*where, strict=True):
            if self._checks[at].contact_at(link_poses(self._model, start + fraction * (end - start))) is not None:
                return self._contact(at)
        return None

    def _contact(self, check: int) -> Contact:
        """The contact of a check, which is tested first from now on."""
        if self._order[0] != check:
            self._order = np.concatenate([[check], self._order[self._order != check]])
        return self._checks[check].contact


def _empty_answer(questions: int) -> Answer:
    return Answer(np.zeros(4, np.int64), np.empty(questions), np.empty(questions, np.int64))


def _halvings(step: Floats) -> int:
    """How often a step (6,), rad, is halved for all checks together; one that is no number not at all."""
    length = math.sqrt(float(step @ step))
    return min(HALVINGS, max(0, math.ceil(math.log2(length / LOOK_FIRST_RAD)))) if 0.0 < length < math.inf else 0


def halving_order(count: int) -> Floats:
    """0, 1/n, 2/n ... (n - 1)/n in an order that spreads over the whole at once (van der Corput's), shape (n,)."""
    order = np.argsort([int(f"{n:032b}"[::-1], 2) for n in range(count)], kind="stable")
    return np.asarray(order / max(1, count))
