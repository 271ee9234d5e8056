"""What the abdomen's guidance knows and what is true: markers on the skin, their CT reading, their touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.twin.phantoms import torso
from puncture_twin.twin.phantoms.viscera import LESION_CENTRE_LPS_MM

__all__ = ["GUIDANCE_SEED", "Guidance", "abdomen_guidance", "patient_placement", "skin_markers_ct"]

BASE_AXES_CT = ((0.0, -1.0, 0.0), (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
"""The base's x, y and z axes in the CT frame (LPS). The base hangs above the belly with its z axis toward the
patient's head; the target lies along the base's -x."""
TARGET_IN_BASE_MM = (-500.0, 0.0, 200.0)
"""Where the lesion lies in the base frame: 500 mm from the base's axis, 200 mm along it. The base's origin is
then 500 mm in front of the lesion, about 400 mm above the skin."""
MARKER_DIRECTIONS_DEG = ((12.0, 42.0), (0.0, -38.0), (48.0, -8.0), (84.0, 46.0), (98.0, -42.0), (142.0, 6.0))
"""Directions from the lesion in which the markers sit: from the right toward the front, and toward the head."""
GUIDANCE_SEED = 20190401
SLICE_SPACING_MM = 1.0
IN_PLANE_MM = 0.7
"""The simulated scan's resolution; a read position errs uniformly by up to half of it."""
TOUCH_SIGMA_MM = 0.1
"""Standard deviation of a touched position along each axis."""
_FARTHEST_MM = 400.0
_HALVINGS = 60


@dataclass(frozen=True, eq=False)
class Guidance:
    """Positions by name, mm; arrays of shape (3,).

    Attributes:
        markers_ct: Markers as read from the scan.
        touched_base: Markers as touched by the robot.
        truth_base: Markers and ``target`` where they really are, in the base frame.
    """

    markers_ct: dict[str, Floats]
    touched_base: dict[str, Floats]
    truth_base: dict[str, Floats]


def patient_placement() -> Floats:
    """Where the patient truly lies: T_base_ct, CT frame to base frame, shape (4, 4), mm."""
    R = np.array(BASE_AXES_CT, dtype=np.float64)
    return pose(R, np.array(TARGET_IN_BASE_MM) - R @ np.array(LESION_CENTRE_LPS_MM))


def skin_markers_ct() -> dict[str, Floats]:
    """True marker positions M1 to M6 on the skin, LPS, mm."""
    around, up = np.radians(np.array(MARKER_DIRECTIONS_DEG)).T
    directions = np.stack([-np.cos(around) * np.cos(up), -np.sin(around) * np.cos(up), np.sin(up)], axis=1)
    points = _leave_skin(np.array(LESION_CENTRE_LPS_MM), directions)
    return {f"M{number}": point for number, point in enumerate(points, start=1)}


def _leave_skin(start: Floats, directions: Floats) -> Floats:
    """Where rays from inside cross the skin, by bisection of its field, shape (n, 3)."""
    low, high = np.zeros(len(directions)), np.full(len(directions), _FARTHEST_MM)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        inside = torso.skin(start + middle[:, None] * directions) < 0
        low, high = np.where(inside, middle, low), np.where(inside, high, middle)
    return np.asarray(start + low[:, None] * directions)


def abdomen_guidance(generator: np.random.Generator) -> Guidance:
    """Simulate reading the markers in the scan and touching them with the robot."""
    markers = skin_markers_ct()
    names, points_ct = list(markers), np.stack(list(markers.values()))
    half = np.array([IN_PLANE_MM, IN_PLANE_MM, SLICE_SPACING_MM]) / 2
    read = points_ct + generator.uniform(-half, half, points_ct.shape)
    T_base_ct = patient_placement()
    truth = apply(T_base_ct, points_ct)
    touched = truth + generator.normal(0.0, TOUCH_SIGMA_MM, truth.shape)
    return Guidance(
        markers_ct=dict(zip(names, read, strict=True)),
        touched_base=dict(zip(names, touched, strict=True)),
        truth_base={**dict(zip(names, truth, strict=True)), "target": np.array(TARGET_IN_BASE_MM)},
    )
