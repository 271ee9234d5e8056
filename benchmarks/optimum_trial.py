"""One session held against the Cramer-Rao bound: how far its estimates and its servo end from what was possible."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.declared_errors import ServoErrors
from puncture_twin.twin.guidance.stereo.detection import image_detector
from puncture_twin.twin.guidance.stereo.joint.joint_model import Adjusted, Guess, Observed, Unknowns, bound
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.session import DetectorOf, run_session
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell

Floats = NDArray[np.float64]


class OptimumTrial(NamedTuple):
    """Errors at the end of each target, and their bounds (rms); shape (targets,), mm."""

    ball_mm: Floats
    """Estimated ball to true ball."""
    target_mm: Floats
    """Estimated target to true target."""
    offset_mm: Floats
    """Error of target minus ball."""
    after_mm: Floats
    """True ball to true target: what the servo left."""
    ball_bound_mm: Floats
    target_bound_mm: Floats
    offset_bound_mm: Floats


def optimum_trial(case: ServoCase, seed: int, detector_of: DetectorOf = image_detector) -> OptimumTrial:
    """Hold a session and bound it by all that was measured in it until each target's end."""
    session = run_session(case, seed, detector_of=detector_of)
    workcell = session.workcell
    stays = [visit for one in session.reached for visit in one.servoed.visits]
    ends = np.cumsum([len(one.servoed.visits) for one in session.reached])
    q_true = np.concatenate([session.calibration.q_true, np.reshape([visit.q_true for visit in stays], (-1, 6))])
    spheres = workcell.ball_c(q_true)
    observed = session.guide.observed()
    rows = []
    for one, end in zip(session.reached, ends, strict=True):
        if not one.servoed.visits:
            continue
        index = case.targets.names.index(one.target)
        until = len(session.calibration.q_command) + int(end)
        floor = room_bound(workcell, first_stays(observed, until), spheres[:until])
        offset = floor.offset(-1, case.targets.points[index])
        seen, ball, target = one.servoed.visits[-1].seen, spheres[until - 1], workcell.targets_c[index]
        errors = (seen.ball_c - ball, seen.target_c - target, (seen.target_c - seen.ball_c) - (target - ball))
        bounds = (offset.ball_covariance, offset.target_covariance, offset.covariance)
        rows.append([*(np.linalg.norm(e) for e in errors), one.after_mm, *(np.sqrt(np.trace(b)) for b in bounds)])
    return OptimumTrial(*np.array(rows).T)


def first_stays(observed: Observed, count: int) -> Observed:
    """What had been measured when the arm had stood so many times."""
    return replace(
        observed,
        q_command=observed.q_command[:count],
        pixels=observed.pixels[:, :count],
        pixel_covariance=observed.pixel_covariance[:, :count],
    )


def room_bound(workcell: StereoWorkcell, observed: Observed, balls_c: Floats) -> Adjusted:
    """The Cramer-Rao bound at the truth of a room, the ball having been at ``balls_c`` (s, 3)."""
    guess = Guess(workcell.T_c_base, workcell.T_c_m, balls_c)
    errors = observed.errors
    truth = Unknowns(
        np.array([camera_errors(*pair, errors) for pair in zip(observed.planned, workcell.cameras, strict=True)]),
        np.zeros(6),
        rod_errors(workcell, errors),
        np.zeros(6),
        np.array(workcell.case.markers.points),
        balls_c,
    )
    return bound(observed, guess, truth)


def camera_errors(planned: Camera, true: Camera, errors: ServoErrors) -> Floats:
    """A camera's errors (13,), in declared deviations: the inverse of ``camera_of`` for square pixels."""
    moved = true.T_camera_c @ np.linalg.inv(planned.T_camera_c)
    turn = Rotation.from_matrix(moved[:3, :3]).as_rotvec()
    axis = [true.cx - planned.cx, true.cy - planned.cy]
    focal, lens = true.fx / planned.fx - 1.0, true.distortion - planned.distortion
    return in_deviations(np.concatenate([[focal], axis, lens, turn, moved[:3, 3]]), errors.camera_deviations())


def rod_errors(workcell: StereoWorkcell, errors: ServoErrors) -> Floats:
    """Errors of arm and ball (26,), in declared deviations: the inverse of ``rod_poses``."""
    arm, nominal = workcell.arm, workcell.arm.nominal
    lengths = np.concatenate([arm.a - nominal.a, np.delete(arm.d - nominal.d, 1)])
    every = np.concatenate([lengths, arm.alpha - nominal.alpha, arm.joint_offsets, workcell.tool.ball_offset])
    return in_deviations(every, errors.arm_deviations())


def in_deviations(errors: Floats, deviations: Floats) -> Floats:
    """Errors over their deviations; 0 where the deviation is."""
    return np.where(deviations > 0, errors / np.where(deviations > 0, deviations, 1.0), 0.0)
