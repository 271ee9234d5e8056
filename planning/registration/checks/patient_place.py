"""Where a transform puts the patient for the robot: in a box of the robot's own frame, on one, or on end."""

from __future__ import annotations

from typing import NamedTuple

import fcl
import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case, up_axis
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply

ALLOWANCE_MM = 30.0
"""A mattress gives way and a box is measured by hand: so deep a patient may lie in one, or to its middle."""

THIN = 0.05
"""Of a box's half size is left of it at least, so that a patient who goes through a thin one is seen."""

REST_MM = 100.0
"""Mattress and cushions between a table and the patient on it."""

FAR_MM = 400.0
"""What lies farther below is a floor, what lies farther above a ceiling."""


class Lying(NamedTuple):
    """How the patient lies to the boxes of the robot's frame."""

    on: str
    """The obstacle under the patient, no farther away than `REST_MM`; empty for none."""
    off: str
    """That an obstacle is below or above the patient, with its distance, where they lie on none; empty for none."""


def in_box(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> str:
    """The obstacle of frame ``base`` in which the patient would lie deeper than `ALLOWANCE_MM`; empty for none.

    FCL is asked whether the skin touches what is left of the box without the allowance, and a point whether the whole
    box lies in the patient.

    Args:
        case: For its obstacles.
        skin: CT frame.
        T_base_ct: Shape (4, 4), mm.
    """
    points = apply(T_base_ct, skin.vertices)
    return next((box.name for box in _base_boxes(case) if _deep_in(box, points, skin, T_base_ct)), "")


def _deep_in(box: Obstacle, points_base: Floats, skin: TriangleMesh, T_base_ct: Floats) -> bool:
    half = box.size_mm / 2
    core = np.maximum(half - ALLOWANCE_MM, THIN * half)
    local = points_base - box.center_mm
    corners = local[skin.faces]
    near = np.all((corners.min(axis=1) <= core) & (corners.max(axis=1) >= -core), axis=1)
    if near.any():
        part = fcl.CollisionObject(surface(TriangleMesh(local, skin.faces[near])))
        if touch(part, fcl.CollisionObject(fcl.Box(*(2 * core)))):
            return True
    return side_of(skin, apply(np.linalg.inv(T_base_ct), box.center_mm)) is Side.INSIDE


def lying(case: Case, skin: TriangleMesh, T_base_ct: Floats) -> Lying:
    """How the patient lies to the boxes of the robot's frame, by the skin's vertices; arguments as of `in_box`.

    Up is the axis of the robot's frame that is nearest to it, within 45 degrees: an arm may stand, hang or reach out of
    a wall.
    """
    up = _up_base(case, T_base_ct)
    axis = int(np.argmax(np.abs(up)))
    if abs(up[axis]) < np.cos(np.pi / 4):
        return Lying("", "")
    points, level, off = apply(T_base_ct, skin.vertices), np.arange(3) != axis, ""
    for box in _base_boxes(case):
        away, half = points - box.center_mm, box.size_mm / 2
        height = np.sign(up[axis]) * away[np.all(np.abs(away[:, level]) <= half[level], axis=1), axis]
        if not len(height):
            continue
        over, under = height.min() - half[axis], -half[axis] - height.max()
        if -ALLOWANCE_MM <= over <= REST_MM:
            return Lying(box.name, "")
        if REST_MM < over <= FAR_MM:
            off = f"the patient would float {over:.0f} mm above obstacle '{box.name}'"
        elif 0.0 <= under <= FAR_MM:
            off = f"the patient would lie {under:.0f} mm under obstacle '{box.name}'"
    return Lying("", off)


def off_upright(case: Case, T_base_ct: Floats) -> float:
    """Between the base's z axis and up, as the case states it or a patient usually lies; pi for an arm that hangs."""
    return float(np.arccos(np.clip(_up_base(case, T_base_ct)[2], -1.0, 1.0)))


def _up_base(case: Case, T_base_ct: Floats) -> Floats:
    up = np.asarray(up_axis(case))
    return np.asarray(T_base_ct[:3, :3] @ (up / np.linalg.norm(up)))


def _base_boxes(case: Case) -> tuple[Obstacle, ...]:
    return tuple(box for box in case.obstacles if box.frame == "base")
