"""Two arms that hold a probe and a needle, and whether they touch each other: convex bodies and FCL.

Each arm alone is checked as everywhere (`planning.collision.fast_checker.FastChecker`); here the probe's head and the
two arms against each other are added, with the same bodies.
"""

from functools import partial
from itertools import product

import fcl
import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies import FLANGE_FRAME, Body, Shape, Solid, arm_bodies, touch

STUB_MM = 1.0
"""A tool ends in a needle; the probe's handle ends in one so short that it is none."""
FAR_LINKS = 5
"""The probe's head may touch the links from the base to wrist 1; the later ones turn behind it."""


class BetweenArms:
    """Whether the two arms, with probe and needle, touch each other. Not for several threads at once.

    Args:
        models: Of the probe's arm and the needle's.
        tools: What they carry: the probe's handle (`handle_tool`), needle and holder.
        head: The probe's head, see `head_body`.
        T_base1_base2: Where the needle's arm stands, shape (4, 4), mm.
        clearance_mm: How far apart they must stay.
    """

    def __init__(
        self,
        models: tuple[UrModel, UrModel],
        tools: tuple[Tool, Tool],
        head: Body,
        T_base1_base2: Floats,
        clearance_mm: float,
    ) -> None:
        self.T_base1_base2 = T_base1_base2
        self._models = models
        self.probe_bodies = (*arm_bodies(models[0], tools[0], clearance_mm), head)
        self.needle_bodies = arm_bodies(models[1], tools[1], 0.0)

    def place_probe(self, q_probe: Floats) -> None:
        """Move the probe's arm to ``q_probe`` (6,), rad."""
        poses = link_poses(self._models[0], q_probe)
        for body in self.probe_bodies:
            body.place(poses)

    def head_touches_own_arm(self, q_probe: Floats) -> bool:
        """Whether the probe's head touches a link of the arm that holds it at ``q_probe`` (6,), rad."""
        self.place_probe(q_probe)
        *links, head = self.probe_bodies
        return any(bodies_touch(head, link) for link in links[:FAR_LINKS])

    def apart(self, q_probe: Floats, q_needle: Floats) -> bool:
        """Whether the two arms keep their clearance."""
        self.place_probe(q_probe)
        poses = self.T_base1_base2 @ link_poses(self._models[1], q_needle)
        for body in self.needle_bodies:
            body.place(poses)
        ends_first = product(reversed(self.probe_bodies), reversed(self.needle_bodies))  # they touch soonest
        return not any(bodies_touch(first, second) for first, second in ends_first)


def bodies_touch(first: Body, second: Body) -> bool:
    """Whether ``first``, with its clearance, touches ``second`` where they are; bounding spheres first."""
    apart = np.linalg.norm(first.full.surface.pose.getTranslation() - second.bare.surface.pose.getTranslation())
    reach = max(float(np.linalg.norm(hull, axis=1).max()) for hull in first.full.hulls)
    if apart > reach + second.radius_mm:
        return False
    return any(touch(a.made, b.made) for a, b in product(first.full.solids, second.bare.solids))


def handle_tool(length_mm: float, diameter_mm: float) -> Tool:
    """A probe's handle, as a tool of the arm: from the flange to the head's back."""
    return Tool(length_mm, STUB_MM, diameter_mm, diameter_mm)


def head_body(T_flange_head: Floats, size_mm: Floats, clearance_mm: float) -> Body:
    """A probe's head: a cuboid of full edges (3,), mm, about the origin of its frame on the flange."""
    shapes = []
    for size in (size_mm, size_mm + 2.0 * clearance_mm):
        solid = Solid(partial(fcl.Box, *size))
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * size
        shapes.append(Shape((solid,), solid, (corners,)))
    radius_mm = float(np.linalg.norm(size_mm)) / 2.0
    return Body("probe_head", FLANGE_FRAME, T_flange_head, shapes[0], shapes[1], radius_mm)
