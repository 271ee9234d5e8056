"""How to touch the markers so that the arm's errors cancel best: the choice among reachable poses of least error.

What an arm does wrong at the markers it does again at the target, but only in a similar configuration: touched with the
insertion's own orientation and branch, errors of a nominal UR3 fall to a third; touched from elsewhere they add up.
Motion and contact are not tested here.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import branch_of, inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import PARAMETERS, error_jacobian, flange_pose, singularity
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.planning.registration.fit_uncertainty import LEAST_SINGULARITY
from puncture_twin.planning.uncertainty.pose_error import PoseError

TILTS_DEG = (0.0, 10.0, 20.0, 30.0, 45.0)
"""By how much a touch may lean from the insertion's orientation."""
AZIMUTHS = 12
"""Sides to which it may lean."""
SWEEPS = 4
"""Over all markers; the choice is settled after two or three."""


class Candidates(NamedTuple):
    """Joints (n, 6), rad, that keep the tip on a point; the nearest to the insertion's first."""

    alike: Floats
    """On the insertion's own branch."""
    others: Floats
    """On the other branches: between them the arm passes a singularity."""


def choose_touches(error: PoseError, points_base: Floats, q_insertion: Floats) -> Floats:
    """Joints that touch each marker, shape (N, 6), rad, and leave the least error at the target.

    Args:
        error: Of the case; its registration's map is kept, its touches are replaced.
        points_base: Shape (N, 3), mm, in the order of the registration's markers.
        q_insertion: Shape (6,), rad, the tip on the target.

    Raises:
        NoAnswerError: A marker that the arm cannot touch near the insertion's orientation.
    """
    found = [touch_candidates(error.model, error.tip_mm, point, q_insertion) for point in points_base]
    candidates = [one.alike if len(one.alike) else one.others for one in found]
    for point, q in zip(points_base, candidates, strict=True):
        if not len(q):
            place = ", ".join(f"{value:.1f}" for value in point)
            what = f"a {error.model.name} cannot touch ({place}) mm near the insertion's orientation"
            raise NoAnswerError(what, code="marker_out_of_reach")
    return least_error(error, candidates, q_insertion)


def least_error(error: PoseError, candidates: Sequence[Floats], q_insertion: Floats, *, worst: bool = False) -> Floats:
    """One candidate of each marker, shape (N, 6), rad, that together leave the least error at the target.

    Marker by marker the candidate of the least trace(Sigma_dd) is taken, given the others, until nothing changes.

    Args:
        error: Of the case; its registration's map is kept, its touches are replaced.
        candidates: Of each of the registration's markers, shape (n, 6), rad.
        q_insertion: Shape (6,), rad, the tip on the target.
        worst: The most error instead, to compare with.
    """
    maps = error.fit.map_at(error.target_base)[:3].reshape(3, -1, 3)
    eta, repeatability = error.fit.noise.eta_variances, error.errors.arm.repeatability
    J = [error_jacobian(error.model, q, error.tip_mm)[:, :3] for q in candidates]
    moved = [np.einsum("ab,nbc->nac", maps[:, row], part) for row, part in enumerate(J)]
    anew = [repeatability**2 * np.sum(part[..., PARAMETERS["joint"]] ** 2, axis=(1, 2)) for part in moved]
    chosen = np.zeros(len(candidates), int)  # the first candidates turn least from the insertion
    at_target = error_jacobian(error.model, q_insertion, error.tip_mm)[:3]
    sign = -1.0 if worst else 1.0
    for _ in range(SWEEPS):
        before = chosen.copy()
        for row in range(len(candidates)):
            others = sum(moved[k][chosen[k]] for k in range(len(candidates)) if k != row)
            left = at_target - others - moved[row]
            chosen[row] = np.argmin(sign * (np.sum(left**2 * eta, axis=(1, 2)) + anew[row]))
        if np.array_equal(before, chosen):
            break
    return np.array([q[row] for q, row in zip(candidates, chosen, strict=True)])


def touch_candidates(model: UrModel, tip_mm: float, point_base: Floats, q_insertion: Floats) -> Candidates:
    """Configurations within the joint limits and away from singularities that touch a point, near the insertion's.

    Args:
        tip_mm: Flange to tip.
        point_base: Shape (3,), mm.
        q_insertion: Shape (6,), rad: by its orientation, or leaning from it by up to `TILTS_DEG`.
    """
    R = flange_pose(model, q_insertion)[:3, :3]
    sides = np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False)
    leans = [tilt * np.array([np.cos(side), np.sin(side), 0.0]) for tilt in np.radians(TILTS_DEG[1:]) for side in sides]
    poses = np.zeros((1 + len(leans), 4, 4))
    poses[:, :3, :3] = R @ exp_rotation(np.array([np.zeros(3), *leans]))
    poses[:, :3, 3], poses[:, 3, 3] = point_base - tip_mm * poses[:, :3, 2], 1.0
    q = nearest_within_limits(model, inverse(model, poses).reshape(-1, 6), q_insertion)
    q = q[~np.isnan(q).any(axis=1)]
    q = q[singularity(model, q).least() >= LEAST_SINGULARITY]
    q = q[np.argsort(np.abs(q - q_insertion).max(axis=1), kind="stable")]
    alike = branch_of(model, q) == branch_of(model, q_insertion[None])[0]
    return Candidates(q[alike], q[~alike])
