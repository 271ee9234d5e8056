"""What the arm has to reach for one direction, and whether it does."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.collision.state_checker import Contact

SAME_UNIT = 1e-9
"""How far a direction's length may be from 1."""


@dataclass(frozen=True, eq=False)
class ReachRequest:
    """One direction to reach along.

    Attributes:
        target_base: Shape (3,), mm: the lesion, base frame.
        outward_base: Shape (3,), unit: from the target out of the body, base frame.
        needle_length_mm: Flange to tip.
        standoff_mm: Tip to target before the insertion starts.

    Raises:
        InputError: If something is not finite, the direction not a unit vector, or a length not positive.
    """

    target_base: Floats
    outward_base: Floats
    needle_length_mm: float
    standoff_mm: float

    def __post_init__(self) -> None:
        for name in ("target_base", "outward_base"):
            array = np.array(getattr(self, name), dtype=np.float64)
            if array.shape != (3,) or not all(map(math.isfinite, array.tolist())):
                raise InputError(f"{name} = {array}", where="reach request", allowed="three finite numbers")
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        if abs(math.hypot(*self.outward_base.tolist()) - 1.0) > SAME_UNIT:
            raise InputError(f"outward_base = {self.outward_base}", where="reach request", allowed="a unit vector")
        for name in ("needle_length_mm", "standoff_mm"):
            if not (math.isfinite(getattr(self, name)) and getattr(self, name) > 0.0):
                raise InputError(f"{name} = {getattr(self, name)}", where="reach request", allowed="finite and above 0")


@dataclass(frozen=True, eq=False)
class ReachAnswer:
    """Whether and how the arm reaches along one direction.

    Attributes:
        reachable: The verdict.
        reason: ``NONE``, ``UNREACHABLE``, ``ARM_COLLISION`` (at standoff) or ``INSERTION_BLOCKED``.
        depth_mm: How far the needle was inserted from standoff when it was blocked; None for other reasons.
        detail: One sentence for people: what touched what, or what was missing; empty when reachable.
        contact: What touched what, where that was the reason.
        roll: Turn about the needle against :func:`flange_poses`' zero, rad; NaN when not reachable.
        branch: Index among the eight branches of ``inverse``; -1 when not reachable.
        insertion_q: Shape (m, 6), rad: standoff first, tip on the target last; empty when not reachable.
        insertion_depth_mm: Shape (m,), mm inserted from standoff at each row.
        margin: 0..1, the least over the insertion of: each joint's distance to its limits over a quarter turn, and the
            three singularity terms. 0 when not reachable.
    """

    reachable: bool
    reason: Reason
    depth_mm: float | None
    detail: str
    contact: Contact | None
    roll: float
    branch: int
    insertion_q: Floats
    insertion_depth_mm: Floats
    margin: float

    @classmethod
    def refused(
        cls, reason: Reason, depth_mm: float | None, detail: str, contact: Contact | None = None
    ) -> ReachAnswer:
        """Of a direction that the arm does not reach, or not to the target."""
        return cls(False, reason, depth_mm, detail, contact, math.nan, -1, np.empty((0, 6)), np.empty(0), 0.0)

    def __post_init__(self) -> None:
        self.insertion_q.setflags(write=False)
        self.insertion_depth_mm.setflags(write=False)
