"""The ultrasound workcell: an arm with a probe and an arm with a needle about a block of tissue, and their contacts.

Each arm alone is checked as everywhere (:class:`planning.collision.fast_checker.FastChecker`: itself, the table, the
phantom); the two arms against each other as in :mod:`planning.collision.two_arms`.
Everything is placed where the *drawing* has it; the clearance covers what the truth differs by.
"""

from __future__ import annotations

from enum import StrEnum
from functools import cache
from itertools import product

import fcl
import numpy as np
import trimesh
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.two_arms import BetweenArms, handle_tool, head_body
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.twin.guidance.ultrasound.selfcal_case import PhantomSection, SelfcalCase

TABLE_MM = (1800.0, 1200.0, 40.0)
TABLE_GAP_MM = 0.5
"""The table ends so far below the bases' plane: the bases stand on it, and nothing else should."""


class Touching(StrEnum):
    """Contact because of which a pair of configurations is refused."""

    PROBE_ARM = "probe_arm_collision"
    NEEDLE_ARM = "needle_arm_collision"
    BOTH = "arms_collide"


def between_arms(case: SelfcalCase, T_end1_image: Floats, T_base1_base2: Floats, clearance_mm: float) -> BetweenArms:
    """Both arms of a case, with the probe's head and the needle's arm where they are.

    Args:
        case: Arms, probe and needle.
        T_end1_image: Where the probe's head is, shape (4, 4), mm.
        T_base1_base2: Where the needle's arm stands, shape (4, 4), mm.
        clearance_mm: How far apart they must stay.
    """
    head = head_body(head_pose(case, T_end1_image), np.array(case.content.probe.head_mm), clearance_mm)
    tools = (probe_tool(case), needle_tool(case))
    return BetweenArms(case.models, tools, head, T_base1_base2, clearance_mm)


class TwoArms:
    """FCL's verdict on both arms. Not for several threads at once: FCL's objects are moved for each question."""

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
        self._between = between_arms(case, case.T_end1_image, case.T_base1_base2, clearance)
        self._phantom = fcl.CollisionObject(surface(phantom))
        self._table = fcl.CollisionObject(
            fcl.Box(*table.size_mm), fcl.Transform(table.T_base_box[:3, :3], table.T_base_box[:3, 3])
        )

    def probe_free(self, q: Floats) -> bool:
        """Whether the probe's arm touches neither itself, table nor phantom at ``q`` (6,), rad."""
        if self._probe.contact(q, needle_may_touch_patient=False) is not None:
            return False
        self._between.place_probe(q)
        head = self._between.probe_bodies[-1]
        if touch(head.bare.surface.made, self._phantom) or touch(head.full.surface.made, self._table):
            return False
        return not self._between.head_touches_own_arm(q)

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


def probe_tool(case: SelfcalCase) -> Tool:
    """The probe's handle, as a tool of the arm: to the head's back."""
    probe = case.content.probe
    return handle_tool(probe.length_mm - probe.head_mm[1], probe.handle_diameter_mm)


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
