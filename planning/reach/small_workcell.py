"""A small workcell, asked once: on a new machine it has every kernel of the arm compiled before a case needs it."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import pose
from puncture_twin.planning.reach.answer import ReachAnswer, ReachRequest
from puncture_twin.planning.reach.reach import assess_reach_all

NEEDLE = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
STANDOFF_MM = 120.0
TARGET = np.array([360.0, 20.0, 100.0])
"""In the middle of the body, mm, base frame."""

OUTWARD = np.array([[0.0, 0.0, 1.0], [-0.3, 0.2, 0.93], [0.9, 0.1, 0.3], [0.3, 0.0, 0.95]])
"""Two directions that the arm reaches, and two that it does not."""

CORNERS = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])
FACES = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
"""Of an octahedron, seen from outside counterclockwise."""


def small_workcell() -> FastChecker:
    """A UR3, a body over a table, something else beside it; mm, base frame."""
    table = Box("table", pose(np.eye(3), TARGET - [0.0, 0.0, 220.0]), (300.0, 300.0, 20.0))
    body, beside = octahedron(TARGET, 80.0), octahedron(TARGET - [0.0, 200.0, 100.0], 40.0)
    return FastChecker(ur_model("ur3"), NEEDLE, [table], body, outside=beside, padding_mm=1.0)


def ask_arm(checker: FastChecker) -> list[ReachAnswer]:
    """Of each of the small workcell's directions whether the arm reaches it."""
    outward = OUTWARD / np.linalg.norm(OUTWARD, axis=1, keepdims=True)
    return assess_reach_all(checker, [ReachRequest(TARGET, u, NEEDLE.needle_length_mm, STANDOFF_MM) for u in outward])


def octahedron(at: Floats, radius_mm: float) -> TriangleMesh:
    """Six corners so far from a place (3,), mm."""
    return TriangleMesh(at + radius_mm * CORNERS, FACES)
