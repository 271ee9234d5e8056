"""The path of each branch along the needle, by inverse kinematics."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.insertion import NeedleLine
from puncture_twin.planning.arm.inverse_kinematics import (
    EVERY_BRANCH,
    N_BRANCHES,
    fill_branches,
    wrapped_angle,
)
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb


def every_branch(model: UrModel, line: NeedleLine, distance_mm: Floats) -> Floats:
    """Every branch's path along the needle at roll 0. A roll adds to q6 and to nothing else.

    Args:
        model: The arm.
        line: The needle's line.
        distance_mm: Shape (m,): target to flange along the path.

    Returns:
        Shape (8, m, 6), rad, without jumps of whole turns; NaN from where a branch first does not exist.
    """
    q = np.empty((N_BRANCHES, len(distance_mm), 6))
    _every_branch(model.lengths, *line, distance_mm, q)
    return q


@nb.njit(cache=True)
def _every_branch(lengths, R, target, outward, distances, q):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``q`` (8, m, 6): every branch at each distance (m,) from the target, without jumps of whole turns.

    NaN from where a branch first does not exist.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(EVERY_BRANCH))
        for branch in range(8):
            for joint in range(6):
                angle = here[branch, joint]
                if k > 0:
                    before = q[branch, k - 1, joint]
                    angle = before + wrapped_angle(angle - before)  # NaN stays NaN
                q[branch, k, joint] = angle


@nb.njit(cache=True)
def fill_branch_path(lengths, R, target, outward, distances, branch, turn, q):  # type: ignore[no-untyped-def]  # numba infers
    """The path of one branch along the needle, without jumps of whole turns; NaN from where it first does not exist.

    Args:
        lengths: The arm.
        R: As in :class:`NeedleLine`.
        target: As in :class:`NeedleLine`, mm.
        outward: As in :class:`NeedleLine`.
        distances: Shape (m,), mm: target to flange along the path.
        branch: Index among the eight of ``inverse``.
        turn: Shape (6,), rad: added to every row, such as a roll and whole turns.
        q: Shape (m, 6), filled, rad.
    """
    p, here = np.empty(3), np.empty((8, 6))
    for k in range(len(distances)):
        for i in range(3):
            p[i] = target[i] + distances[k] * outward[i]
        fill_branches(lengths, R, p, here, np.int64(1) << branch)
        for joint in range(6):
            angle = here[branch, joint] + turn[joint]
            q[k, joint] = angle if k == 0 else q[k - 1, joint] + wrapped_angle(angle - q[k - 1, joint])
