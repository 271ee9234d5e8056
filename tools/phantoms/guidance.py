"""What the abdomen's guidance knows and what is true: markers on the skin, their CT reading, their touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import error_model
from puncture_twin.planning.case.tables import ErrorsSection
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.marker_noise import reading_noise
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register
from puncture_twin.planning.uncertainty.pose_error import PoseError, choose_touches
from tools.phantoms import torso
from tools.phantoms.viscera import LESION_CENTRE_LPS_MM

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
NEEDLE_MM = 210.0
"""Flange to tip, as the case states it."""
TOUCHED_LIKE_DEG = (-130.8, -167.9, -46.7, 16.7, -24.1, 16.4)
"""Joints of a UR3 with its tip on the target, the needle along theta 64, beta 98 degrees: markers are touched likewise,
so that most of what the arm does wrong cancels."""
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
    joints_deg: dict[str, Floats]
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
        joints_deg=dict(zip(names, np.degrees(_touches(read, touched)), strict=True)),
        truth_base={**dict(zip(names, truth, strict=True)), "target": np.array(TARGET_IN_BASE_MM)},
    )


def _touches(read_ct: Floats, touched_base: Floats) -> Floats:
    """How a UR3 stood when its controller read these positions, shape (n, 6), rad: the touches of least error."""
    model, q = ur_model("ur3"), np.radians(TOUCHED_LIKE_DEG)
    section = ErrorsSection(ct_pixel_mm=IN_PLANE_MM, ct_spacing_mm=SLICE_SPACING_MM, touch_mm=TOUCH_SIGMA_MM)
    errors = error_model(section, space=Space.LPS)
    noise = reading_noise(errors, model, NEEDLE_MM, np.tile(q, (len(touched_base), 1)), known=True)
    names = tuple(f"M{number}" for number in range(1, len(touched_base) + 1))
    target_ct = np.array(LESION_CENTRE_LPS_MM)
    fitted = register(MarkerPairs(names, read_ct, touched_base), method="weighted", target_ct=target_ct, noise=noise)
    assert fitted.uncertainty is not None
    target_base = apply(fitted.T_base_ct, target_ct)
    return choose_touches(PoseError(model, NEEDLE_MM, target_base, errors, fitted.uncertainty), touched_base, q)
