"""The last stretch to a marker: a straight line along the needle, and whether the arm may take it.

The needle must touch nothing but the marker: with its foremost `TIP_MM` taken off, it keeps its padding from
the patient all the way, so that no shaft passes through them. Arm and holder keep their distance as everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.insertion import MAX_JOINT_STEP_RAD_PER_MM
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.state_checker import NEEDLE_IN_PATIENT
from puncture_twin.planning.motion.path_check import dense_states

STANDOFF_MM = 20.0
"""Where the straight line begins, away from the marker: the needle is clear of the patient there."""

SLOW_MM = 5.0
"""From here on the tip moves at touching speed."""

PAST_MM = 5.0
"""So far beyond its believed place a marker is felt for; then the touch is given up."""

TIP_MM = 8.0
"""Of the needle that may be nearer than its padding to the patient: the marker sits on their skin."""

STEP_MM = 0.5
"""Between two configurations of the line."""

RESOLUTION_RAD = 0.005
"""Largest joint distance between two checked states of the line."""


@dataclass(frozen=True, eq=False)
class ApproachCheckers:
    """Two views of one workcell.

    Attributes:
        whole: The arm with its needle.
        blunted: The same with a needle that is `TIP_MM` shorter.
    """

    whole: CellChecker
    blunted: CellChecker


def line_to(model: UrModel, tip_mm: float, q_touch: Floats, from_mm: float, to_mm: float) -> Floats | None:
    """Joints along the needle's line through a touch, shape (m, 6), rad; None where the arm cannot follow it.

    Args:
        model: The arm.
        tip_mm: Flange to tip.
        q_touch: Shape (6,), rad, the tip on the marker.
        from_mm: Where the tip starts, mm before the marker; negative beyond it.
        to_mm: Where it ends.
    """
    count = max(2, int(np.ceil(abs(from_mm - to_mm) / STEP_MM)) + 1)
    distances = np.linspace(from_mm, to_mm, count)
    poses = np.tile(flange_pose(model, q_touch), (count, 1, 1))
    poses[:, :3, 3] -= distances[:, None] * poses[:, :3, 2]
    every = nearest_within_limits(model, inverse(model, poses), q_touch)
    away = np.abs(every - q_touch).max(axis=2)
    q = every[np.arange(count), np.argmin(np.where(np.isnan(away), np.inf, away), axis=1)]
    step = MAX_JOINT_STEP_RAD_PER_MM * abs(from_mm - to_mm) / (count - 1)
    follows = not np.isnan(q).any() and bool(np.abs(np.diff(q, axis=0)).max() <= step)
    return q if follows and _is_near(q, q_touch, distances) else None


def _is_near(q: Floats, q_touch: Floats, distances: Floats) -> bool:
    """Whether the row nearest to the marker is the touch's own branch."""
    allowed = MAX_JOINT_STEP_RAD_PER_MM * (float(np.abs(distances).min()) + STEP_MM)
    return bool(np.abs(q[int(np.argmin(np.abs(distances)))] - q_touch).max() <= allowed)


def why_not(checkers: ApproachCheckers, tip_mm: float, q_touch: Floats) -> str:
    """What keeps the arm from a straight approach, in words; empty where nothing does.

    Args:
        checkers: Of the workcell.
        tip_mm: Flange to tip.
        q_touch: Shape (6,), rad, the tip on the marker.
    """
    whole = checkers.whole
    if not whole.model.within_limits(q_touch[None])[0]:
        return "a joint would be beyond its limits"
    line = line_to(whole.model, tip_mm, q_touch, STANDOFF_MM, -PAST_MM)
    if line is None:
        return "the arm cannot follow the straight line to it"
    standoff = whole.contact(line[0], needle_may_touch_patient=False)
    if standoff is not None:
        return f"at the standoff {standoff.body} touches {standoff.other}"
    found = whole.first_contact(_dense(whole, line), needle_may_touch_patient=True)
    if found is not None:
        return f"{found.contact.body} touches {found.contact.other}"
    before = line_to(whole.model, tip_mm, q_touch, STANDOFF_MM, 0.0)
    assert before is not None  # a part of the whole line
    shaft = checkers.blunted.first_contact(_dense(checkers.blunted, before), needle_may_touch_patient=False)
    if shaft is None:
        return ""
    if shaft.contact == NEEDLE_IN_PATIENT:
        return "the needle's shaft would go through the patient"
    return f"{shaft.contact.body} touches {shaft.contact.other}"


def _dense(checker: CellChecker, line: Floats) -> Floats:
    return dense_states(checker, line, RESOLUTION_RAD)
