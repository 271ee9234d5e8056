"""Straight joint segments, checked by compiled proofs; FCL has the word where they say nothing."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.checker import Check, Contact, require_finite
from puncture_twin.planning.collision.fcl_contact import fcl_contact
from puncture_twin.planning.collision.kernels import segments as segment_kernels
from puncture_twin.planning.collision.kernels.segments import CONTACT, NOT_FINITE, QUERY, Answer
from puncture_twin.planning.collision.proofs import Proofs

LOOK_FIRST_RAD = 0.125
"""States of a segment so far apart are looked at before it is proven: what it touches is found soonest so."""

FINE_MM = 1.0
"""A state answers for a part of a segment within which no body moves farther from it. So states that were checked are
no more than 2 mm of motion apart, which with 1 mm of padding proves the path between them; see :class:`CellChecker`."""

QUESTIONS = 256
"""Room for what one segment leaves to FCL, at first."""


class SegmentChecker:
    """Checks whether straight joint segments are free. Not for several threads.

    What touched last is tested first. That decides which contact is named where there are several, and never whether a
    segment is free: each segment's proof begins anew.

    Args:
        model: The arm.
        checks: The questions that may find a contact.
        proofs: The same, packed.
        clear_mm: What the padded arm is to keep from patient and boxes besides; of each body and obstacle that are
            nearer to one another at an end of the segment, most of their distance there. What is not proven to be kept
            counts as a contact.
    """

    def __init__(self, model: UrModel, checks: Sequence[Check], proofs: Proofs, clear_mm: float = 0.0) -> None:
        self._model, self._checks, self._clear_mm = model, checks, clear_mm
        self._packed = (proofs.scene, proofs.movers, model.lengths)
        self._order = np.arange(len(checks), dtype=np.int64)
        self._answer = _empty_answer(QUESTIONS)

    def __call__(self, start: Floats, end: Floats) -> Contact | None:
        """A contact on the segment between two states (6,), rad, the needle being outside the patient; None if free.

        The end, and states ``LOOK_FIRST_RAD`` apart from it on, are checked as they are; all of the segment is proven
        clear but for parts within which no body moves farther than ``FINE_MM`` from a state where FCL finds nothing.
        The start itself is not looked at beyond that.

        Raises:
            InputError: If a state is not finite.
        """
        start, end = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64)
        fractions, begin = looks(math.ceil(_length(end - start) / LOOK_FIRST_RAD)), 0
        while True:
            segment_kernels.check_segment(
                *self._packed, start, end, fractions, begin, FINE_MM, self._clear_mm, self._order, self._answer
            )
            status, check, begin, count = self._answer.status.tolist()
            if status == NOT_FINITE:
                require_finite(np.stack([start, end]))
            if status == CONTACT:
                return self._contact(check)
            if count > len(self._answer.fractions):
                self._answer, begin = _empty_answer(2 * count), 0
                continue
            questions = self._answer.fractions[:count].tolist(), self._answer.checks[:count].tolist()
            for fraction, at in zip(*questions, strict=True):
                if fcl_contact(self._checks[at], link_poses(self._model, start + fraction * (end - start))) is not None:
                    return self._contact(at)
            if status != QUERY:
                return None

    def _contact(self, check: int) -> Contact:
        """The contact of a check, which is tested first from now on."""
        if self._order[0] != check:
            self._order = np.concatenate([[check], self._order[self._order != check]])
        return self._checks[check].contact


def _empty_answer(questions: int) -> Answer:
    return Answer(np.zeros(4, np.int64), np.empty(questions), np.empty(questions, np.int64))


def _length(step: Floats) -> float:
    """Of a step (6,), rad; that of one that is no number counts as 0."""
    length = math.sqrt(float(step @ step))
    return length if math.isfinite(length) else 0.0


def halving_order(count: int) -> Floats:
    """0, 1/n, 2/n ... (n - 1)/n in an order that spreads over the whole at once (van der Corput's), shape (n,)."""
    order = np.argsort([int(f"{n:032b}"[::-1], 2) for n in range(count)], kind="stable")
    return np.asarray(order / max(1, count))


@lru_cache(maxsize=256)
def looks(count: int) -> Floats:
    """Where on a segment so many states stand, the end first: fractions of its path, shape (n,)."""
    return np.asarray(1.0 - halving_order(count))
