"""What stands around the arm in a case: the patient's skin, the obstacles, the needle on the flange."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from planning.anatomy import Anatomy
from planning.case import Case, Obstacle
from planning.robot.fast_checker import FastChecker
from planning.robot.tool import Box, Tool
from planning.robot.ur import ur_model

Floats = NDArray[np.float64]


ARM_PADDING_MM = 5.0
"""The arm keeps this distance from patient and room: more than the registration's error, and enough to prove the way
between two checked states."""


def case_tool(case: Case) -> Tool:
    """The needle and its holder."""
    needle = case.needle
    return Tool(needle.length_mm, needle.shaft_mm, needle.diameter_mm, needle.holder_diameter_mm)


def case_boxes(case: Case, T_base_ct: Floats) -> tuple[Box, ...]:
    """The obstacles, in the base frame."""
    return tuple(_box(obstacle, T_base_ct) for obstacle in case.obstacles)


def _box(obstacle: Obstacle, T_base_ct: Floats) -> Box:
    T = np.eye(4)
    T[:3, 3] = obstacle.center_mm
    T_base_box = T if obstacle.frame == "base" else T_base_ct @ T
    x, y, z = obstacle.size_mm
    return Box(obstacle.name, T_base_box, (float(x), float(y), float(z)))


def case_checker(case: Case, anatomy: Anatomy, T_base_ct: Floats) -> FastChecker:
    """The collision checker of the case's room, with the patient where ``T_base_ct`` says."""
    patient = anatomy.skin.mesh.transformed(T_base_ct)
    boxes = case_boxes(case, T_base_ct)
    return FastChecker(ur_model(case.robot.model), case_tool(case), boxes, patient, padding_mm=ARM_PADDING_MM)


def home_configuration(case: Case) -> Floats:
    """Where the arm waits, shape (6,), rad: the case's, or arm up and wrist down."""
    if case.robot.home is not None:
        return case.robot.home
    return np.radians([0.0, -90.0, 0.0, -90.0, 0.0, 0.0])
