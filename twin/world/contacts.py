"""Who touches the arm, and how near two bodies are, according to the physics."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.world.arm import Arm
from puncture_twin.twin.world.engine import pybullet
from puncture_twin.twin.world.units import to_mm


class Touch(NamedTuple):
    """The deepest contact between one link and one body at one moment."""

    link: str
    """Name of the arm's link."""
    body: int
    """Id of the other body."""
    depth_mm: float
    """How far the two shapes overlap."""


def touches(arm: Arm) -> tuple[Touch, ...]:
    """Contacts of the last physics step, at most one for each link and body, in a fixed order.

    Bullet takes the arm's links as the convex hulls of their meshes.
    """
    deepest: dict[tuple[int, int], float] = {}
    for point in pybullet.getContactPoints(bodyA=arm.body, physicsClientId=arm.client):
        other, link, distance_m = point[2], point[3], point[8]
        if distance_m <= 0 and other != arm.body:
            key = (link, other)
            deepest[key] = max(deepest.get(key, 0.0), -float(to_mm(distance_m)))
    return tuple(Touch(arm.link_name(link), other, depth) for (link, other), depth in sorted(deepest.items()))


def felt_force(arm: Arm, link: str) -> Floats:
    """The force of the workcell's bodies on one link, as of the last physics step: shape (3,), N, world frame."""
    force = np.zeros(3)
    for point in pybullet.getContactPoints(bodyA=arm.body, linkIndexA=arm.links[link], physicsClientId=arm.client):
        if point[2] != arm.body:
            normal, (first, along_first, second, along_second) = np.array(point[7]), point[10:14]
            force += point[9] * normal + first * np.array(along_first) + second * np.array(along_second)
    return force
