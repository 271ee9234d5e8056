"""The insertion between its samples: a robot runs straight in joint angles there; the needle must stay straight too."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from planning.errors import InputError
from planning.plan import STRAIGHT_TOLERANCE_MM, Plan
from planning.robot.kinematics import flange_pose
from planning.robot.ur import ur_model

Array = NDArray[np.float64]

STEP_RAD = 0.01
"""Between looked-at states: over such a step a point a metre from the axis bows out by 0.0125 mm (r s^2 / 8)."""

MOST_STATES = 2_000_000
"""Joints that turn through more steps than this during one insertion do something else."""


def check_straight_between(plan: Plan, *, where: Path) -> None:
    """Refuse an insertion whose needle leaves its line between two samples, such as by a jump to another branch.

    Raises:
        InputError: Says by how much.
    """
    poses = flange_pose(ur_model(plan.model), _refined(plan.insertion.q, where))
    target = plan.T_base_ct[:3, :3] @ plan.target_ct + plan.T_base_ct[:3, 3]
    outward = plan.T_base_ct[:3, :3] @ plan.outward_ct
    worst = 0.0
    for length in (0.0, plan.needle_length_mm):
        away = poses[:, :3, 3] + length * poses[:, :3, 2] - target
        worst = max(worst, float(np.linalg.norm(away - (away @ outward)[:, None] * outward, axis=1).max()))
    if not worst <= STRAIGHT_TOLERANCE_MM:
        raise InputError(
            f"the needle leaves the straight path by {worst:.3g} mm between two samples",
            where=where,
            allowed=f"at most {STRAIGHT_TOLERANCE_MM} mm",
        )


def _refined(q: Array, where: Path) -> Array:
    """The rows of a path (m, 6) and states between them, none farther than ``STEP_RAD`` from the next in any joint."""
    counts = np.ceil(np.abs(np.diff(q, axis=0)).max(axis=1) / STEP_RAD).clip(min=1.0)
    if counts.sum() > MOST_STATES:
        raise InputError("the insertion turns its joints over and over", where=where, allowed="a straight insertion")
    rows = np.interp(
        np.arange(counts.sum() + 1.0), np.concatenate([[0.0], np.cumsum(counts)]), np.arange(len(q), dtype=np.float64)
    )
    before = np.minimum(rows.astype(np.intp), len(q) - 2)
    share = (rows - before)[:, None]
    return np.asarray((1.0 - share) * q[before] + share * q[before + 1])
