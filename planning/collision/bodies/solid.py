"""A shape of a body that FCL builds when it is first asked about it."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import fcl


class Solid:
    """A shape that moves. Spheres and planes answer most questions about it, and FCL takes longer to build it.

    Args:
        make: Makes its geometry, mm.
        pose: Where it stands at first.

    Attributes:
        pose: Where it stands.
    """

    def __init__(self, make: Callable[[], fcl.CollisionGeometry], pose: fcl.Transform | None = None) -> None:
        self._make = make
        self.pose = pose or fcl.Transform()

    @cached_property
    def made(self) -> fcl.CollisionObject:
        """The shape where it stands, and wherever it is placed from now on."""
        return fcl.CollisionObject(self._make(), self.pose)

    def place(self, pose: fcl.Transform) -> None:
        """Move it."""
        self.pose = pose
        if "made" in self.__dict__:
            self.made.setTransform(pose)
