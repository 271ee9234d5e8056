"""OMPL's space of joint angles: its bounds, and its states as angles.

OMPL measures distances in it with the wrist's joints counted for half: what a robot's arm touches is decided by the
first three joints most of the time, and branches that reach farther in those find the way through a gap sooner
(``python -m benchmarks.approach_planners``).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager

import numpy as np
from ompl import base as ob, util as ou

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.state_checker import Contact

SegmentContact = Callable[[Floats, Floats], Contact | None]
"""What the straight joint segment between two states (6,) meets; None when it is free, its end included. Of a segment
that begins at a state known to be free the check gets that state first."""

Angles = tuple[float, ...]
"""Six joint angles, rad."""

WRIST_DIVISOR = 2.0
"""OMPL's coordinates of the wrist's three joints are their angles over this: a power of two, so that no bit is lost."""

SEEDS = 2**31 - 1
"""OMPL takes positive seeds; 0 would mean its own choice."""


class JointSpace:
    """A box of joint angles as OMPL sees it.

    Args:
        bounds: Shape (6, 2), rad: lowest and highest angles.
        wrist_divisor: What the wrist's angles are divided by; a power of two.
    """

    def __init__(self, bounds: Floats, wrist_divisor: float = WRIST_DIVISOR) -> None:
        self._divisors = np.array([1.0, 1.0, 1.0, wrist_divisor, wrist_divisor, wrist_divisor])
        box = ob.RealVectorBounds(6)
        for joint, (low, high) in enumerate((bounds / self._divisors[:, None]).tolist()):
            box.setLow(joint, low)
            box.setHigh(joint, high)
        space = ob.RealVectorStateSpace(6)
        space.setBounds(box)
        self.information = ob.SpaceInformation(space)
        self.information.setStateValidityChecker(_everything)  # a segment is checked with its end

    def set_up(self, validator: ob.MotionValidator) -> None:
        """Have segments checked by a validator."""
        self.information.setMotionValidator(validator)
        self.information.setup()

    def state(self, q: Floats) -> ob.State:
        """A new state at angles (6,), rad."""
        state = self.information.allocState()
        for joint, value in enumerate((q / self._divisors).tolist()):
            state[joint] = value
        return state


def angles_of(state: ob.State, wrist_divisor: float = WRIST_DIVISOR) -> Angles:
    """The angles of a state, rad. Beyond six coordinates OMPL reads garbage."""
    wrist = wrist_divisor * state[3], wrist_divisor * state[4], wrist_divisor * state[5]
    return state[0], state[1], state[2], *wrist


def _everything(state: ob.State) -> bool:
    return True


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """OMPL's one generator seeded, and its messages off: reseeding makes it complain; a test holds that it works."""
    level = ou.getLogLevel()
    ou.setLogLevel(ou.LOG_NONE)
    try:
        ou.RNG.setSeed(1 + seed % SEEDS)
        yield
    finally:
        ou.setLogLevel(level)
