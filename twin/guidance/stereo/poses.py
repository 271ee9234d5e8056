"""How the arm holds the rod: one orientation, one inverse-kinematics branch for every point of a session."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.singularity import ELBOW, ELBOW_DIGITS, TIE_DIGITS, singularity
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.frames import frame_yz
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod

LEAST_SINGULARITY = 0.05
"""A branch that comes nearer to a singularity (of 0..1) at some point is not used."""

REFERENCE_RAD = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""Whole turns are chosen nearest to this: arm up, elbow bent, flange down."""


def rod_orientation(tilt_rad: float) -> Floats:
    """R_base_flange, shape (3, 3): the flange looks down, its rod leaning away from the arm by an angle, rad."""
    z = np.array([np.sin(tilt_rad), 0.0, -np.cos(tilt_rad)])
    y = np.array([0.0, -1.0, 0.0])
    return frame_yz(y, z)


def flange_poses(rod: CarriedRod, points_base: Floats) -> Floats:
    """T_base_flange, shape (n, 4, 4), mm, that put the ball on points (n, 3)."""
    return pose(rod.R_base_flange, points_base - rod.rod_mm * rod.R_base_flange[:, 2])


class Posture(NamedTuple):
    """How the arm holds a set of points."""

    q: Floats
    """Shape (n, 6), rad."""
    branch: int
    """The inverse-kinematics branch of all of them. An arm's errors differ from branch to branch by millimetres, so
    what was calibrated on one is to be used on it."""


def configurations(rod: CarriedRod, points_base: Floats, checker: StateChecker, *, first: int | None = None) -> Posture:
    """Joint angles that hold the ball on every point, all on one branch, free of contacts.

    Of the branches the one that stays farthest from every singularity is taken; of equals, which mirrored ones are, the
    one whose elbow is on the rod's side.

    Args:
        rod: The arm, its rod and its orientation.
        points_base: Shape (n, 3), mm.
        checker: Judges contacts.
        first: Try this branch before the others.

    Raises:
        NoAnswerError: No branch holds all points freely; says what the best one lacks.
    """
    every = inverse(rod.model, flange_poses(rod, points_base))
    workcell = np.nan_to_num(singularity(rod.model, every).least(), nan=0.0).min(axis=0)
    why = f"a {rod.model.name} cannot hold the ball on all {len(points_base)} points on one branch"
    elbow = np.nan_to_num(link_poses(rod.model, every[0])[:, ELBOW, :3, 3] @ -rod.R_base_flange[:, 2])
    ranks = np.column_stack([np.round(workcell, TIE_DIGITS), np.round(elbow, ELBOW_DIGITS)])
    order = sorted(range(len(ranks)), key=lambda branch: (branch != first, *-ranks[branch]))
    for branch in (branch for branch in order if workcell[branch] >= LEAST_SINGULARITY):
        q = nearest_within_limits(rod.model, every[:, branch], REFERENCE_RAD)
        if np.isnan(q).any():
            continue
        found = checker.first_contact(q, needle_may_touch_patient=False)
        if found is None:
            return Posture(q, branch)
        why = f"{found.contact.body} would touch {found.contact.other} at point {found.at + 1} of {len(points_base)}"
    raise NoAnswerError(why)


def path_upward(rod: CarriedRod, points_base: Floats, up_mm: float) -> Floats:
    """Points (n, 3) farther back along the rod by a distance, mm: where the arm hovers."""
    return np.asarray(points_base - up_mm * rod.R_base_flange[:, 2])
