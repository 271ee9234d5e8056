"""The declared noise of a case's markers, with the arm's configuration at each touch: as recorded, or likely."""

import contextlib
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm import kinematics
from puncture_twin.planning.arm.inverse_kinematics import inverse
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ArmUncertainty, ErrorModel
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.registration import fits
from puncture_twin.planning.registration.marker_pairs import MarkerPairs, check_pairs


def parameter_variances(arm: ArmUncertainty) -> Floats:
    """The diagonal of Sigma_eta, shape (28,), in the order of `error_jacobian`'s columns; mm^2 and rad^2."""
    deviations = np.empty(kinematics.N_PARAMETERS)
    for kind, value in (
        ("link", arm.link_mm),
        ("twist", arm.twist),
        ("joint", arm.joint),
        ("tip_offset", arm.tip_offset_mm),
        ("needle_direction", arm.needle_direction),
    ):
        deviations[kinematics.PARAMETERS[kind]] = value
    return np.asarray(deviations**2)


def reading_noise(
    errors: ErrorModel, model: UrModel, tip_mm: float, q_touch: Floats, *, known: bool
) -> fits.ReadingNoise:
    """The noise of markers touched in configurations (N, 6), rad, which are the real ones (known) or are assumed."""
    eta_variances = parameter_variances(errors.arm)
    J = kinematics.error_jacobian(model, q_touch, tip_mm)[:, :3]
    Jq = J[..., kinematics.PARAMETERS["joint"]]
    cov_base = errors.touch_mm**2 * np.eye(3) + errors.arm.repeatability**2 * Jq @ np.swapaxes(Jq, -1, -2)
    return fits.ReadingNoise(
        errors.marker_cov_ct, cov_base, J.reshape(-1, kinematics.N_PARAMETERS), eta_variances, known
    )


TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0)
"""How far the needle may lean from the wished direction, tried in this order."""
AZIMUTHS = 12
"""Sides to which it may lean."""
LEAST_SINGULARITY = 0.05
"""A pose nearer than this to a singularity is not used to measure (of 0..1)."""


def touching_configuration(model: UrModel, tip_mm: float, point_base: Floats, needle_base: Floats) -> Floats:
    """Joint angles that put the tip on a point, shape (6,), rad: the least tilt, then the farthest from singular.

    Of equals the one with its elbow on the side from which the needle comes: mirrored branches are equal. ``tip_mm`` is
    from the flange to the tip along z, the point (3,) in mm, and the wished direction (3,) from the needle's top to its
    tip a unit vector.

    Raises NoAnswerError: There are none in the tried directions.
    """
    frame = frame_about(needle_base)
    for tilt in np.radians(TILTS_DEG):
        branches = []
        for side in np.linspace(0, 2 * np.pi, AZIMUTHS, endpoint=False) if tilt > 0 else [0.0]:
            lean = [np.sin(tilt) * np.cos(side), np.sin(tilt) * np.sin(side), np.cos(tilt)]
            R = frame_about(frame @ np.array(lean))  # any roll will do: it is q6 alone
            branches.append(inverse(model, pose(R, point_base - tip_mm * R[:, 2]))[0])
        q = np.concatenate(branches)
        q = q[model.within_limits(q)]
        if len(q) and kinematics.singularity(model, q).least().max() >= LEAST_SINGULARITY:
            return kinematics.farthest_from_singular(model, q, -needle_base)
    place = ", ".join(f"{value:.1f}" for value in point_base)
    what = f"a {model.name} cannot touch ({place}) mm with a needle of {tip_mm:g} mm"
    raise NoAnswerError(what, code="marker_out_of_reach")


GUESSED_HOME = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])
"""An arm bent at the elbow, its needle down: where it can touch a marker in no direction tried."""


def marker_noise(case: Case, errors: ErrorModel, markers: MarkerPairs, *, where: str | Path) -> fits.ReadingNoise:
    """The declared noise of a case's markers, with the arm as it stood at the touches, or as it is guessed to have.

    Raises InputError: Too few markers to fit, or joints that do not put the tip where the file says that it touched.
    """
    model, tip = case.robot.model, case.needle.length_mm
    check_pairs(markers, where)
    q_touch = touches(case, markers)
    if markers.joints is not None:
        tool = [np.array([0.0, 0.0, tip])]
        kinematics.check_arm(model, markers.joints, markers.points_base, tool, names=markers.names, where=where)
    return reading_noise(errors, model, tip, q_touch, known=markers.joints is not None)


def touches(case: Case, markers: MarkerPairs) -> Floats:
    """Joints of the arm at the touch of each marker, shape (N, 6), rad: the file's, or likely ones."""
    if markers.joints is not None:
        return markers.joints
    model, tip, q = case.robot.model, case.needle.length_mm, np.tile(GUESSED_HOME, (len(markers), 1))
    needle = -(fits.fit_rigid(markers.points_ct, markers.points_base)[:3, :3] @ case.T_ct_entry[:3, 2])
    for row, point in enumerate(markers.points_base):
        with contextlib.suppress(NoAnswerError):
            q[row] = touching_configuration(model, tip, point, needle)
    return q
