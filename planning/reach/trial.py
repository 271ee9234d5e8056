"""Motions checked for contacts, of many directions at once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import first_stop, reach_margin
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.state_checker import Contact, StateChecker
from puncture_twin.planning.reach.answer import ReachAnswer
from puncture_twin.planning.reach.sampling import sampled
from puncture_twin.planning.reach.survey import MAX_SWEEP_MM, Insertion, Surveyed

ROLL_BODIES = frozenset({"wrist_3", "tool"})
"""The bodies that turn with the roll and are not round about the needle: other contacts are the same at any roll."""


class Blocked(NamedTuple):
    """Where a motion ends early, and whether another roll on the same branch would touch the same."""

    depth_mm: float
    detail: str
    at_any_roll: bool = True
    at_standoff: bool = False
    contact: Contact | None = None


def tried_all(checker: StateChecker, motions: Sequence[tuple[Surveyed, Insertion]]) -> list[ReachAnswer | Blocked]:
    """Check motions for contacts: the standoffs of all at once, then those motions whose standoff is clear.

    Args:
        checker: Checks contacts, in the base frame.
        motions: Each with the survey that it comes from.

    Returns:
        For each motion: that the arm reaches the direction by it, or where it ends.
    """
    standoffs = np.array([insertion.standoff for _, insertion in motions]).reshape(-1, 6)
    found: list[ReachAnswer | Blocked] = []
    for motion, contact in zip(motions, checker.contacts(standoffs, needle_may_touch_patient=False), strict=True):
        if contact is None:
            found.append(tried(checker, *motion))
        else:
            found.append(blocked_at_standoff(contact))
    return found


def blocked_at_standoff(contact: Contact) -> Blocked:
    """What a contact at its standoff makes of a motion."""
    detail = f"{contact.body} touches {contact.other} at standoff"
    return Blocked(0.0, detail, ROLL_BODIES.isdisjoint(contact), at_standoff=True, contact=contact)


def tried(checker: StateChecker, found: Surveyed, insertion: Insertion) -> ReachAnswer | Blocked:
    """Check one motion for contacts, whose standoff is clear."""
    model = checker.model
    lengths = found.request.needle_length_mm, found.request.standoff_mm
    line, branch, roll, turn, _ = insertion
    q, depths = sampled(checker.swept, line, branch, turn, lengths, len(found.depths), MAX_SWEEP_MM)
    stop = first_stop(model, q, depths)
    if stop is not None:
        return Blocked(stop.depth_mm, stop.detail)
    margin = reach_margin(model, q)
    if margin < 0.0:
        return Blocked(0.0, "a joint leaves its limits on the way", at_any_roll=False)
    first = checker.first_contact(q, needle_may_touch_patient=True)
    if first is None:
        return ReachAnswer(True, Reason.NONE, None, "", None, roll, branch, q, depths, margin)
    depth, contact = float(depths[first.at]), first.contact
    detail = f"{contact.body} touches {contact.other} {depth:.1f} mm after the standoff"
    return Blocked(depth, detail, ROLL_BODIES.isdisjoint(contact), contact=contact)
