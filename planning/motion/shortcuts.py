"""OMPL's shortcuts of a path, counted in steps, never in time."""

from __future__ import annotations

import numpy as np
from ompl import base as ob, geometric as og

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.joint_space import JointSpace, SegmentContact, angles_of

ROUNDS = 2
"""Of shortcuts."""

STEPS = 60
"""Shortcuts tried in each round. By itself OMPL tries as many as the path has vertices: few where branches are long."""

CLEARANCE_MM = 20.0
"""What a shortcut keeps from patient and boxes beyond the arm's padding, where both of its ends do. The shortest path
round an obstacle runs along it, and then an arm that errs by more than the padding touches."""

UNSCALED = 1.0
"""What the wrist's angles are divided by here: nothing."""


def shortened(joint_limits: Floats, contact_of: SegmentContact, waypoints: Floats) -> Floats:
    """A path with the same ends that is no longer, with every joint counted in full.

    Args:
        joint_limits: Shape (6, 2), rad.
        contact_of: Checks a shortcut.
        waypoints: Shape (k, 6), rad: straight free segments.

    Returns:
        Shape (m, 6), rad.
    """
    space = JointSpace(joint_limits, UNSCALED)
    space.set_up(_Validator(space.information, contact_of))
    path = og.PathGeometric(space.information)
    for q in waypoints:
        path.append(space.state(q))
    simplifier = og.PathSimplifier(space.information)
    simplifier.reduceVertices(path)
    for _ in range(ROUNDS):
        simplifier.partialShortcutPath(path, STEPS, STEPS)
        simplifier.reduceVertices(path)
    simplifier.collapseCloseVertices(path)  # corners close together are taken slowly
    return np.array([angles_of(state, UNSCALED) for state in path.getStates()])


class _Validator(ob.MotionValidator):  # type: ignore[misc]  # compiled, without types
    """Hands segments between states of the path to a check."""

    def __init__(self, information: ob.SpaceInformation, contact_of: SegmentContact) -> None:
        super().__init__(information)  # and not kept: it keeps the validator, and no one would free the two
        self._contact_of = contact_of

    def checkMotion(self, start: ob.State, end: ob.State) -> bool:  # noqa: N802  # OMPL's name
        ends = angles_of(start, UNSCALED), angles_of(end, UNSCALED)
        return self._contact_of(np.array(ends[0]), np.array(ends[1])) is None
