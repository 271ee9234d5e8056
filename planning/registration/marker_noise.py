"""The declared noise of a case's markers, and how the arm stood, or may have stood, when it touched them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.stated_arm import check_arm
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.registration.fits.least_squares import fit_rigid
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, check_pairs
from puncture_twin.planning.registration.reading_noise import ReadingNoise
from puncture_twin.planning.registration.touch_noise import reading_noise
from puncture_twin.planning.registration.touch_poses import touching_configuration

GUESSED_HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""An arm bent at the elbow, its needle down."""


def marker_noise(case: Case, errors: ErrorModel, markers: MarkerPairs, *, where: str | Path) -> ReadingNoise:
    """The declared noise of a case's markers, with the arm as it stood at the touches, or as it is guessed to have.

    Raises:
        InputError: Too few markers to fit, or joints that do not put the tip where the file says that it touched.
    """
    model, tip = case.robot.model, case.needle.length_mm
    check_pairs(markers, where)
    q_touch = touches(case, markers)
    if markers.joints is not None:
        tool = [np.array([0.0, 0.0, tip])]
        check_arm(model, markers.joints, markers.points_base, tool, names=markers.names, where=where)
    return reading_noise(errors, model, tip, q_touch, known=markers.joints is not None)


def touches(case: Case, markers: MarkerPairs) -> Floats:
    """How the arm stood when it touched each marker, shape (N, 6), rad: as the file says, or as it may have stood."""
    if markers.joints is not None:
        return markers.joints
    model, tip = case.robot.model, case.needle.length_mm
    needle = -(fit_rigid(markers.points_ct, markers.points_base)[:3, :3] @ case.T_ct_entry[:3, 2])
    return np.array([_guessed(model, tip, point, needle) for point in markers.points_base])


def _guessed(model: UrModel, tip_mm: float, point_base: Floats, needle_base: Floats) -> Floats:
    """How the arm may have stood; its home where it cannot touch the point in any direction tried."""
    try:
        return touching_configuration(model, tip_mm, point_base, needle_base)
    except NoAnswerError:
        return GUESSED_HOME
