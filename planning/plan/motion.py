"""A plan's motion, looked at anew: what it touches, and how near it comes."""

from __future__ import annotations

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.motion.approach import FINER, RESOLUTION_RAD
from puncture_twin.planning.motion.path_check import dense_states, least_clearance
from puncture_twin.planning.plan.plan import Plan


def phase_clearances(plan: Plan, checker: StateChecker) -> dict[str, float]:
    """How near arm and holder come to patient and workcell in each phase of the stored motion; mm."""
    found = {}
    for phase, part in (("approach", plan.approach), ("insertion", plan.insertion)):
        least = least_clearance(checker, dense_states(checker, part.q, RESOLUTION_RAD / FINER))
        found[phase] = min(least.patient.mm, least.boxes.mm)
    return found


def motion_contact(plan: Plan, checker: CellChecker) -> str | None:
    """What a plan's motion touches, in words, or None: FCL at ten times the planner's resolution."""
    for phase, q, needle_free in (("approach", plan.approach.q, False), ("insertion", plan.insertion.q, True)):
        contact = _contact(checker, q, needle_free)
        if contact is not None:
            return f"{phase} is not free: {contact}"
    return None


def _contact(checker: CellChecker, q_path: Floats, needle_free: bool) -> str | None:
    """What touches what along a motion, checked as densely as when it was planned; None if nothing does."""
    for q in dense_states(checker, q_path, RESOLUTION_RAD / FINER):
        contact = CellChecker.contact(checker, q, needle_may_touch_patient=needle_free)  # FCL alone, no bounds
        if contact is not None:
            return f"{contact.body} touches {contact.other}"
    return None
