"""The fast collision checker: the verdicts of :class:`CellChecker`, with FCL only where bounds prove nothing.

`FastChecker` checks states and paths, `SegmentChecker` straight joint segments; both by compiled proofs first.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.collision.bodies import (
    NEEDLE_IN_PATIENT,
    PATIENT,
    Check,
    Contact,
    FirstContact,
    require_finite,
)
from puncture_twin.planning.collision.checker import CellChecker, SweptBodies
from puncture_twin.planning.collision.kernels import segments
from puncture_twin.planning.collision.kernels.settled import CLEAR, OPEN, TOUCHES_OUTSIDE
from puncture_twin.planning.collision.packed import ROUND
from puncture_twin.planning.collision.proofs import Motion, Proofs, without_neighbours
from puncture_twin.planning.geometry.mesh import TriangleMesh


class FastChecker(CellChecker):
    """Answers :class:`CellChecker`'s questions by bounds, and queries FCL for those that bounds leave open.

    The questions come in the same order and their answers are FCL's or proven, so each verdict is the same, down to the
    contact that is named (docs/concepts/arm-collisions.md). Distances are FCL's. Not for several threads at once.

    Args and errors are those of :class:`CellChecker`; ``cache`` keeps the enclosures of the arm's bodies.
    """

    def __init__(
        self,
        model: UrModel,
        tool: Tool,
        boxes: Sequence[Box] = (),
        patient: TriangleMesh | None = None,
        *,
        outside: TriangleMesh | None = None,
        padding_mm: float = 0.0,
        cache: Cache = NO_CACHE,
    ) -> None:
        super().__init__(model, tool, boxes, patient, outside=outside, padding_mm=padding_mm)
        self._swept_full = SweptBodies.of(model, tool, padding_mm)
        skin_triangles = 0 if patient is None else len(patient.faces)
        self._proofs = Proofs(model, self._checks, boxes, self._surface, skin_triangles, cache)
        self._tested = without_neighbours(model, self._checks, self._proofs, cache)
        self._still = (np.zeros((1, 7)), np.zeros((1, 6)))
        needle = np.array([check.contact == NEEDLE_IN_PATIENT for check in self._tested])
        self._round = np.array([check.first_body is None and check.contact.body in ROUND for check in self._tested])
        self._before_last = np.array([check.before_last_joint for check in self._tested], np.bool_)
        self._masks = {False: np.ones_like(needle), True: ~needle}
        self._padding_mm = padding_mm

    def contact(self, q: Floats, *, needle_may_touch_patient: bool) -> Contact | None:
        """See :meth:`CellChecker.contact`."""
        first = self.first_contact(np.asarray(q)[None], needle_may_touch_patient=needle_may_touch_patient)
        return None if first is None else first.contact

    def contacts(
        self, q: Floats, *, needle_may_touch_patient: bool, round_clear: Bools | None = None
    ) -> list[Contact | None]:
        """See :meth:`CellChecker.contacts`."""
        states = np.asarray(q, dtype=np.float64).reshape(-1, 6)
        require_finite(states)
        frames, mask = link_poses(self.model, states), self._masks[needle_may_touch_patient]
        tested, known = np.stack([mask, mask & ~self._round]), np.zeros(len(states), np.int64)
        if round_clear is not None:
            known[round_clear] = 1
        return self._first_contacts(frames, tested, known)

    def folded(self, q: Floats) -> Bools:
        """See :meth:`CellChecker.folded`."""
        states = np.asarray(q, dtype=np.float64).reshape(-1, 6)
        require_finite(states)
        frames, all_alike = link_poses(self.model, states), np.zeros(len(states), np.int64)
        contacts = self._first_contacts(frames, self._before_last[None], all_alike)
        return np.array([contact is not None for contact in contacts], np.bool_)

    def _first_contacts(self, frames: Floats, tested: Bools, of_state: Ints) -> list[Contact | None]:
        """The first contact of each state, see :meth:`Proofs.first_not_clear`."""
        contacts: list[Contact | None] = [None] * len(frames)
        begins = np.zeros(len(frames), dtype=np.int64)
        while (left := self._proofs.first_not_clear(frames, begins, tested, of_state)).checks.max(initial=-1) >= 0:
            begins = np.where(left.checks < 0, len(self._tested), left.checks + 1)
            rows = np.flatnonzero(left.checks >= 0)
            of_rows = left.checks[rows].tolist(), left.answers[rows].tolist()
            for row, check, answer in zip(rows.tolist(), *of_rows, strict=True):
                contacts[row] = self._contact_of(check, answer, frames[row])
                if contacts[row] is not None:
                    begins[row] = len(self._tested)
        return contacts

    def first_contact(self, q_path: Floats, *, needle_may_touch_patient: bool) -> FirstContact | None:
        """See :meth:`CellChecker.first_contact`."""
        path = np.asarray(q_path, dtype=np.float64)
        require_finite(path)
        motion, mask = self.motion(path), self._masks[needle_may_touch_patient]
        for index, check, answer in self._proofs.not_clear(motion, mask):
            contact = self._contact_of(check, answer, motion.frames[index])
            if contact is not None:
                return FirstContact(index, contact)
        return None

    def _contact_of(self, check: int, answer: int, frames: Floats) -> Contact | None:
        """Contact of one check at frames (7, 4, 4): by bounds, or by FCL where they prove nothing."""
        if answer == OPEN:
            return self._tested[check].contact_at(frames)
        if answer == CLEAR:
            return None
        contact = self._tested[check].contact
        return contact._replace(other=OUTSIDE_BODY) if answer == TOUCHES_OUTSIDE else contact

    def segment_checker(self, clear_mm: float = 0.0) -> SegmentChecker:
        """A check of many segments, which remembers what touched last; with a clearance where their ends have it."""
        return SegmentChecker(self.model, self._tested, self._proofs, self._segment_scratch, clear_mm)

    @cached_property
    def _segment_scratch(self) -> segments.SegmentScratch:
        return segments.segment_scratch(self._proofs.scene, self._proofs.movers)

    def open_checks(self, q: Floats, *, needle_may_touch_patient: bool) -> list[Contact]:
        """The checks at ``q`` (6,), rad, that are left to FCL."""
        motion = self.motion(np.asarray(q, dtype=np.float64)[None])
        mask = self._masks[needle_may_touch_patient]
        return [self._tested[check].contact for _, check in self._proofs.unproven(motion, mask)]

    def next_nearer(self, motion: Motion, begin: int, pair: str, body: str, mm: float) -> int:
        """The first state at or after one that is not proven to keep one kind of a body's distance; -1 for none.

        The bounds are of the padded body: every plane and every sphere stands off the bare one by the padding.

        Args:
            pair: One of ``DISTANCE_PAIRS``.
            mm: The distance, of the body without its padding, that is to be exceeded.
        """
        of_body = [check.contact.body == body and check.first_body is None for check in self._tested]
        skin = [check.contact.other == PATIENT for check in self._tested]
        tested = np.array(of_body) & (np.array(skin) == (pair != "boxes"))
        rest = Motion(motion.frames[begin:], motion.moved[begin:], motion.rotated[begin:])
        for index, _ in self._proofs.unproven(rest, tested, max(mm - self._padding_mm, 0.0)):
            return begin + index
        return -1

    def motion(self, path: Floats) -> Motion:
        """States (m, 6), rad, with the frames and motions that the bounds need."""
        if len(path) <= 1:
            return Motion(link_poses(self.model, path), *self._still)
        return Motion(*self._swept_full.moving(path))


LOOK_FIRST_RAD = 0.125
"""Down to parts of this length a segment is halved for all checks together: what it touches is found soonest so."""
FINE_MM = 1.0
"""A checked state stands for the part of a segment within which no body moves farther from it. So checked states are no
more than 2 mm of motion apart, which with 1 mm of padding proves the path between them; see :class:`CellChecker`."""
QUESTIONS = 256
"""Initial space for the queries that one segment leaves to FCL."""


class SegmentChecker:
    """Checks whether straight joint segments are free. Not for several threads.

    What touched last is tested first. That decides which contact is named where there are several, and never whether a
    segment is free: each segment's proof begins anew.

    Args:
        scratch: For them; several may share it, one after the other.
        clear_mm: What the padded arm is to keep from patient and boxes besides; of each body and obstacle that are
            nearer to one another at an end of the segment, most of their distance there. What is not proven to be kept
            counts as a contact.
    """

    def __init__(
        self,
        model: UrModel,
        checks: Sequence[Check],
        proofs: Proofs,
        scratch: segments.SegmentScratch,
        clear_mm: float = 0.0,
    ) -> None:
        self._model, self._checks, self._clear_mm = model, checks, clear_mm
        self._packed = (proofs.scene, proofs.movers, model.lengths)
        self._order = np.arange(len(checks), dtype=np.int64)
        self._scratch, self._answer = scratch, _empty_answer(QUESTIONS)

    def __call__(self, start: Floats, end: Floats) -> Contact | None:
        """Contact on the segment between two states (6,), rad, the needle outside the patient; None if free.

        The end is checked as it is, and then the middles of ever smaller parts; all of the segment is proven clear but
        for parts within which no body moves farther than ``FINE_MM`` from a state where FCL finds nothing. The start
        itself is not looked at beyond that.

        Raises:
            InputError: If a state is not finite.
        """
        start, end, answered = np.array(start, dtype=np.float64), np.array(end, dtype=np.float64), 0
        length = math.sqrt(float((end - start) @ (end - start)))
        halvings = 0  # for all checks together; none of a step that is no number
        if 0.0 < length < math.inf:
            halvings = min(segments.HALVINGS, max(0, math.ceil(math.log2(length / LOOK_FIRST_RAD))))
        settings = halvings, FINE_MM, self._clear_mm
        while True:
            answer = self._answer
            segments.check_segment(*self._packed, start, end, answered, *settings, self._order, self._scratch, answer)
            status, check, answered, count = answer.status.tolist()
            if status == segments.NOT_FINITE:
                require_finite(np.stack([start, end]))
            if status == segments.CONTACT:
                return self._contact(check)
            if count > len(answer.fractions):
                self._answer = _empty_answer(2 * count)
                continue
            for fraction, at in zip(answer.fractions[:count].tolist(), answer.checks[:count].tolist(), strict=True):
                if self._checks[at].contact_at(link_poses(self._model, start + fraction * (end - start))) is not None:
                    return self._contact(at)
            if status != segments.QUERY:
                return None

    def _contact(self, check: int) -> Contact:
        """The contact of a check, which is tested first from now on."""
        if self._order[0] != check:
            self._order = np.concatenate([[check], self._order[self._order != check]])
        return self._checks[check].contact


def _empty_answer(questions: int) -> segments.Answer:
    return segments.Answer(np.zeros(4, np.int64), np.empty(questions), np.empty(questions, np.int64))


def halving_order(count: int) -> Floats:
    """0, 1/n, 2/n ... (n - 1)/n in an order that spreads over the whole at once (van der Corput's), shape (n,)."""
    order = np.argsort([int(f"{n:032b}"[::-1], 2) for n in range(count)], kind="stable")
    return np.asarray(order / max(1, count))
