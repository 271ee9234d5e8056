"""The ultrasound workcell: an arm with a probe and an arm with a needle about a block of tissue, and their contacts.

Each arm alone is checked as everywhere (:class:`planning.collision.fast_checker.FastChecker`: itself, the table, the
phantom); here the probe's head and the two arms against each other are added, with the same convex bodies and FCL.
Everything is placed where the *drawing* has it; the clearance covers what the truth differs by.
"""

from __future__ import annotations

from enum import StrEnum
from functools import cache, partial
from itertools import product

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies import Body, Shape, Solid, arm_bodies, surface, touch
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.selfcal_case import PhantomSection, SelfcalCase

TABLE_MM = (1800.0, 1200.0, 40.0)
TABLE_GAP_MM = 0.5
"""The table ends so far below the bases' plane: the bases stand on it, and nothing else should."""

STUB_MM = 1.0
"""A tool ends in a needle; the probe's handle ends in one so short that it is none."""

FAR_LINKS = 5
"""The probe's head may touch the links from the base to wrist 1; the later ones turn behind it."""


class Touching(StrEnum):
    """Contact because of which a pair of configurations is refused."""

    PROBE_ARM = "probe_arm_collision"
    NEEDLE_ARM = "needle_arm_collision"
    BOTH = "arms_collide"


class BetweenArms:
    """Whether the two arms, with probe and needle, touch each other. Not for several threads at once.

    Args:
        case: Arms, probe and needle.
        T_end1_image: Where the probe's head is, shape (4, 4), mm.
        T_base1_base2: Where the needle's arm stands, shape (4, 4), mm.
        clearance_mm: How far apart they must stay.
    """

    def __init__(self, case: SelfcalCase, T_end1_image: Floats, T_base1_base2: Floats, clearance_mm: float) -> None:
        self.T_base1_base2 = T_base1_base2
        self._models = case.models
        head = _head_body(case, T_end1_image, clearance_mm)
        self.probe_bodies = (*arm_bodies(self._models[0], probe_tool(case), clearance_mm), head)
        self.needle_bodies = arm_bodies(self._models[1], needle_tool(case), 0.0)

    def place_probe(self, q_probe: Floats) -> None:
        """Move the probe's arm to ``q_probe`` (6,), rad."""
        poses = link_poses(self._models[0], q_probe)
        for body in self.probe_bodies:
            body.place(poses)

    def apart(self, q_probe: Floats, q_needle: Floats) -> bool:
        """Whether the two arms keep their clearance."""
        self.place_probe(q_probe)
        moved = self.T_base1_base2 @ link_poses(self._models[1], q_needle)
        for body in self.needle_bodies:
            body.place(moved)
        ends_first = product(reversed(self.probe_bodies), reversed(self.needle_bodies))  # they touch soonest
        return not any(_touch(first, second) for first, second in ends_first)


class TwoArms:
    """FCL's verdict on both arms. Not for several threads at once: FCL's objects are moved for each question.

    Args:
        case: The self-calibration case.
    """

    def __init__(self, case: SelfcalCase) -> None:
        content = case.content
        self.probe_model, self.needle_model = case.models
        clearance = content.poses.clearance_mm
        phantom, table = phantom_mesh(content.phantom), table_box(content.phantom)
        T_base2_base1 = np.asarray(np.linalg.inv(case.T_base1_base2), dtype=np.float64)
        moved = Box(table.name, T_base2_base1 @ table.T_base_box, table.size_mm)
        tools = (probe_tool(case), needle_tool(case))
        self._probe = FastChecker(self.probe_model, tools[0], [table], phantom, padding_mm=clearance)
        self._needle = FastChecker(
            self.needle_model, tools[1], [moved], phantom.transformed(T_base2_base1), padding_mm=clearance
        )
        self._between = BetweenArms(case, case.T_end1_image, case.T_base1_base2, clearance)
        self._phantom = fcl.CollisionObject(surface(phantom))
        self._table = fcl.CollisionObject(
            fcl.Box(*table.size_mm), fcl.Transform(table.T_base_box[:3, :3], table.T_base_box[:3, 3])
        )

    def probe_free(self, q: Floats) -> bool:
        """Whether the probe's arm touches neither itself, table nor phantom at ``q`` (6,), rad."""
        if self._probe.contact(q, needle_may_touch_patient=False) is not None:
            return False
        self._between.place_probe(q)
        *links, head = self._between.probe_bodies
        if touch(head.bare.surface.made, self._phantom) or touch(head.full.surface.made, self._table):
            return False
        return not any(_touch(head, link) for link in links[:FAR_LINKS])

    def needle_free(self, q: Floats) -> bool:
        """Whether the needle's arm touches neither itself, table nor, but for the needle, the phantom."""
        return self._needle.contact(q, needle_may_touch_patient=True) is None

    def apart(self, q_probe: Floats, q_needle: Floats) -> bool:
        """Whether the two arms keep their clearance from each other."""
        return self._between.apart(q_probe, q_needle)

    def verdict(self, q_probe: Floats, q_needle: Floats) -> Touching | None:
        """The contact, or None."""
        if not self.probe_free(q_probe):
            return Touching.PROBE_ARM
        if not self.needle_free(q_needle):
            return Touching.NEEDLE_ARM
        return None if self.apart(q_probe, q_needle) else Touching.BOTH


def _touch(first: Body, second: Body) -> bool:
    """Whether ``first``, with its clearance, touches ``second``; bounding spheres first."""
    apart = np.linalg.norm(first.full.surface.pose.getTranslation() - second.bare.surface.pose.getTranslation())
    reach = max(float(np.linalg.norm(hull, axis=1).max()) for hull in first.full.hulls)
    if apart > reach + second.radius_mm:
        return False
    return any(touch(a.made, b.made) for a, b in product(first.full.solids, second.bare.solids))


def probe_tool(case: SelfcalCase) -> Tool:
    """The probe's handle, as a tool of the arm: to the head's back."""
    probe = case.content.probe
    length = probe.length_mm - probe.head_mm[1]
    return Tool(length, STUB_MM, probe.handle_diameter_mm, probe.handle_diameter_mm)


def needle_tool(case: SelfcalCase) -> Tool:
    """The needle and its holder."""
    needle = case.content.needle
    return Tool(needle.length_mm, needle.shaft_mm, needle.diameter_mm, needle.holder_diameter_mm)


def head_pose(case: SelfcalCase, T_end1_image: Floats) -> Floats:
    """T_end1_head: the head's middle; x along the face, y into the depth, z across the slice; shape (4, 4), mm."""
    width, _ = case.content.image.imager().size_mm
    T = np.array(T_end1_image)
    T[:3, 3] += T[:3, :3] @ [0.5 * width, -0.5 * case.content.probe.head_mm[1], 0.0]
    return T


def _head_body(case: SelfcalCase, T_end1_image: Floats, clearance_mm: float) -> Body:
    size = np.array(case.content.probe.head_mm)
    shapes = [_cuboid(size + 2.0 * grown) for grown in (0.0, clearance_mm)]
    return Body("probe_head", 6, head_pose(case, T_end1_image), shapes[0], shapes[1], float(np.linalg.norm(size)) / 2.0)


def _cuboid(size: Floats) -> Shape:
    solid = Solid(partial(fcl.Box, *size))
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * size
    return Shape((solid,), solid, (corners,))


def table_box(phantom: PhantomSection) -> Box:
    """The table under both arms, base1."""
    center = [phantom.top_mm[0], phantom.top_mm[1], -TABLE_GAP_MM - TABLE_MM[2] / 2.0]
    return Box("table", pose(np.eye(3), center), TABLE_MM)


@cache
def phantom_mesh(phantom: PhantomSection) -> TriangleMesh:
    """A block with rounded edges, base1, mm, closed: the sum of a smaller block and a ball."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=phantom.round_mm)
    inner = np.array(phantom.size_mm) - 2.0 * phantom.round_mm
    corners = np.array(list(product((-0.5, 0.5), repeat=3))) * inner
    hull = trimesh.convex.convex_hull((corners[:, None] + ball.vertices).reshape(-1, 3))
    middle = np.array(phantom.top_mm) - [0.0, 0.0, phantom.size_mm[2] / 2.0]
    return TriangleMesh(np.asarray(hull.vertices) + middle, np.asarray(hull.faces))


def inside_phantom(phantom: PhantomSection, points: Floats) -> NDArray[np.bool_]:
    """Whether points (n, 3), base1, lie in the block; exact, from its definition."""
    half = np.array(phantom.size_mm) / 2.0 - phantom.round_mm
    middle = np.array(phantom.top_mm) - [0.0, 0.0, phantom.size_mm[2] / 2.0]
    beyond = np.maximum(np.abs(points - middle) - half, 0.0)
    return np.asarray(np.linalg.norm(beyond, axis=1) < phantom.round_mm)
