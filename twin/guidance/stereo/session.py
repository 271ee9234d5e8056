"""A whole stereo session: calibrate, map the head, then servo onto every target; belief and truth kept apart."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.state_checker import StateChecker
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.detection import (
    Detections,
    Detector,
    LocatedPair,
    Search,
    image_detector,
    in_space,
    look_at,
)
from puncture_twin.twin.guidance.stereo.guide import Guide, JointGuide, Known
from puncture_twin.twin.guidance.stereo.joint.needle_error import NeedleError, NeedleOutcome, needle_outcome
from puncture_twin.twin.guidance.stereo.robot_calibration import (
    RobotCalibration,
    calibrate_by_robot,
    carried_rod,
    grid_points,
)
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import (
    Mapping,
    SeenMarkers,
    ServoStop,
    StepLimits,
    configurations,
    map_head,
    path_upward,
)
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, Servoed, Task, path_contact, servo
from puncture_twin.twin.guidance.stereo.stereo_workcell import StereoWorkcell, draw_workcell, workcell_checker

POINTED_MM = 3.0
"""Deviation of an operator's pointing at a marker in the images, per axis: where the search begins."""

TEST_POINTS = 10
"""Points at which the stereo is tried, as in the paper's Table 1."""

DetectorOf = Callable[[StereoWorkcell, np.random.Generator], Detector]
"""Makes the detector of a workcell."""


class Reached(NamedTuple):
    """Errors at one target, measured in truth; mm."""

    target: str
    servoed: Servoed
    mapping_mm: float
    """Estimated target to true target."""
    expected_tre_mm: float
    """What the mapping expects of itself (rms)."""
    before_mm: float
    """True ball to true target where the robot alone brought it; the whole distance if it could not start."""
    after_mm: float
    """True ball to true target at the end."""
    servo_only_mm: float
    """True ball to estimated target at the end: what the servo answers for."""
    unseen: NeedleOutcome | None = None
    """The needle where the robot alone brought it; None where it could not start, or nothing can be predicted."""
    seen: NeedleOutcome | None = None
    """The needle at the last look, if there was one."""

    @property
    def confirmed(self) -> bool:
        """Whether the last look saw the ball within the tolerance."""
        return self.servoed.stop is ServoStop.CONVERGED


@dataclass(frozen=True, eq=False)
class Session:
    """Result of a session.

    Attributes:
        seed: What it was drawn from.
        workcell: The truth.
        calibration: Result of the robot's points.
        mapping: What the markers gave.
        stereo_mm: Shape (10,): error of the stereo at points of the calibrated volume.
        reached: One for each target.
        guide: The estimates of ball and target for the servo; knows everything that was measured.
    """

    seed: int
    workcell: StereoWorkcell
    calibration: RobotCalibration
    mapping: Mapping
    stereo_mm: Floats
    reached: tuple[Reached, ...]
    guide: Guide


class _Parts(NamedTuple):
    """Random generators, one for each part, so that one part's draws do not shift another's."""

    workcell: np.random.Generator
    pictures: np.random.Generator
    arm: np.random.Generator
    image: np.random.Generator
    tests: np.random.Generator


def run_session(
    case: ServoCase,
    seed: int,
    *,
    targets: tuple[str, ...] | None = None,
    detector_of: DetectorOf = image_detector,
    empty: StateChecker | None = None,
) -> Session:
    """Run a whole session in a workcell drawn from a seed.

    Args:
        case: The case.
        seed: Of all that is drawn.
        targets: Only these; all when None.
        detector_of: Makes the detector; studies of what is behind the images leave them out.
        empty: Checker of the workcell without the head, where one is at hand.

    Raises:
        NoAnswerError: The calibration, the mapping or a start pose could not be done; says what blocked it.
        InputError: The case contradicts itself.
    """
    parts = _Parts(*(np.random.default_rng(s) for s in np.random.SeedSequence(seed).spawn(len(_Parts._fields))))
    workcell = draw_workcell(case, parts.workcell)
    detector = detector_of(workcell, parts.pictures)
    calibration = calibrate_by_robot(workcell, detector, empty or workcell_checker(case, None), parts.arm)
    stereo_mm = _try_stereo(workcell, calibration, detector, parts.tests)
    truth = case.truth_errors
    markers_m = case.markers.points + parts.image.normal(0.0, truth.marker_mm, case.markers.points.shape)
    targets_m = case.targets.points + parts.image.normal(0.0, truth.target_mm, case.targets.points.shape)
    seen = see_markers(workcell, calibration, detector, parts.tests)
    mapping = _map(case, calibration, seen, markers_m, targets_m)
    joint = case.file.servo.estimate == "joint"
    guide = (JointGuide if joint else Guide)(Known(workcell, calibration, mapping, seen, markers_m, detector))
    reached = _reach_all(workcell, guide, mapping, targets_m, calibration, parts.arm, targets)
    return Session(seed, workcell, calibration, mapping, stereo_mm, reached, guide)


def see_markers(
    workcell: StereoWorkcell, calibration: RobotCalibration, detector: Detector, rng: np.random.Generator
) -> list[Detections]:
    """Pixels of every marker in every camera.

    Raises:
        NoAnswerError: A marker is not found.
    """
    head, servo_plan, found = workcell.case.file.head, workcell.case.file.servo, []
    for name, point in zip(workcell.case.markers.names, workcell.markers_c, strict=True):
        predicted = point + rng.normal(0.0, POINTED_MM, 3)
        searches = tuple(Search(camera, predicted, servo_plan.search_px) for camera in calibration.cameras)
        detections = look_at(
            detector, LocatedPair(point, head.marker_diameter_mm / 2, None), searches, servo_plan.frames
        )
        if isinstance(detections, Lost):
            raise NoAnswerError(f"marker {name}: {detections.reason}", code="marker_not_seen")
        found.append(detections)
    return found


def _map(
    case: ServoCase, calibration: RobotCalibration, seen: list[Detections], markers_m: Floats, targets_m: Floats
) -> Mapping:
    points = [in_space(calibration.cameras, detections) for detections in seen]
    markers = SeenMarkers(np.concatenate([p.points_c for p in points]), np.concatenate([p.covariance for p in points]))
    names = case.markers.names
    return map_head(names, markers, markers_m, case.errors.marker_mm, targets_m, where=f"{case.path}: mapping")


def _try_stereo(
    workcell: StereoWorkcell, calibration: RobotCalibration, detector: Detector, rng: np.random.Generator
) -> Floats:
    """Error of the stereo at points anywhere in the calibrated volume, shape (10,), mm."""
    T_c_base = np.asarray(np.linalg.inv(calibration.T_base_c), dtype=np.float64)
    tool = workcell.case.file.tool
    grid = grid_points(workcell.case)
    rod_c = -T_c_base[:3, :3] @ carried_rod(workcell.case, workcell).R_base_flange[:, 2]
    errors = []
    for point in rng.uniform(grid.min(axis=0), grid.max(axis=0), (TEST_POINTS, 3)):
        ball = LocatedPair(apply(workcell.T_c_base, point), tool.ball_diameter_mm / 2, rod_c, head_there=False)
        searches = _searches(workcell.case, calibration, apply(T_c_base, point))
        detections = look_at(detector, ball, searches, workcell.case.file.servo.frames)
        if isinstance(detections, Lost):
            raise NoAnswerError(f"stereo test: {detections.reason}", code="marker_not_seen")
        errors.append(np.linalg.norm(in_space(calibration.cameras, detections).points_c[0] - ball.center_c))
    return np.array(errors)


def _searches(case: ServoCase, calibration: RobotCalibration, predicted_c: Floats) -> tuple[Search, ...]:
    return tuple(Search(camera, predicted_c, case.file.servo.search_px) for camera in calibration.cameras)


def _reach_all(
    workcell: StereoWorkcell,
    guide: Guide,
    mapping: Mapping,
    targets_m: Floats,
    calibration: RobotCalibration,
    rng: np.random.Generator,
    wanted: tuple[str, ...] | None,
) -> tuple[Reached, ...]:
    case, rod = workcell.case, carried_rod(workcell.case, workcell)
    names = case.targets.names
    chosen = [i for i, name in enumerate(names) if wanted is None or name in wanted]
    checker = workcell_checker(case, calibration.T_base_c @ mapping.T_c_m)
    aims_base = apply(calibration.T_base_c, mapping.to_c(targets_m[chosen]))
    hovers = path_upward(rod, aims_base, case.file.servo.hover_mm)
    q = configurations(rod, np.concatenate([aims_base, hovers]), checker, first=calibration.branch).q
    limits = case.file.servo
    steps = StepLimits(
        limits.max_step_mm, float(np.radians(limits.max_joint_step_deg)), float(np.radians(limits.max_drift_deg))
    )
    task = Task(rod, calibration.T_base_c, limits.tolerance_mm, limits.max_steps, limits.looks, steps, checker)
    expected = mapping.expected_tre_mm(targets_m, case.errors.target_mm)
    q_true, reached = calibration.q_true[-1], []
    for row, index in enumerate(chosen):
        q_true = workcell.arm.settle(q[len(chosen) + row], q_true, rng)
        guide.aim_at(targets_m[index])
        one = _Aim(index, names[index], workcell.targets_c[index], float(expected[index]))
        done = _reach(workcell, guide, task, q[len(chosen) + row], q[row], q_true, one, rng)
        q_true = workcell.arm.settle(q[len(chosen) + row], done.servoed.q_true, rng)
        reached.append(done)
    return tuple(reached)


class _Aim(NamedTuple):
    number: int
    name: str
    target_c: Floats
    expected_mm: float


def _reach(
    workcell: StereoWorkcell,
    guide: Guide,
    task: Task,
    q_hover: Floats,
    q_aim: Floats,
    q_true: Floats,
    aim: _Aim,
    rng: np.random.Generator,
) -> Reached:
    """Move from the hovering point onto the target by the robot alone, then by the servo."""
    contact, unseen, seen = path_contact(task.checker, np.stack([q_hover, q_aim])), None, None
    if contact is None:
        q_true = workcell.arm.settle(q_aim, q_true, rng)
        unseen = _outcome(workcell, guide.needle_unseen(q_aim), q_true, aim)
    before = float(np.linalg.norm(workcell.ball_c(q_true) - aim.target_c))
    if contact is None:
        state = [q_true]

        def move(q_command: Floats) -> Floats:
            state[0] = workcell.arm.settle(q_command, state[0], rng)
            return state[0]

        done = servo(task, q_aim, q_true, guide.look, move)
        seen = _outcome(workcell, guide.needle_seen(), done.q_true, aim) if _was_seen(done) else None
    else:
        done = Servoed(ServoStop.CONTACT, (), q_hover, q_true, f"{contact.body} and {contact.other}")
    ball, estimated = workcell.ball_c(done.q_true), guide.target_c
    return Reached(
        aim.name,
        done,
        float(np.linalg.norm(estimated - aim.target_c)),
        aim.expected_mm,
        before,
        float(np.linalg.norm(ball - aim.target_c)),
        float(np.linalg.norm(ball - estimated)),
        unseen,
        seen,
    )


def _was_seen(done: Servoed) -> bool:
    """Whether the ball was seen where the arm ended."""
    return bool(done.visits) and done.visits[-1].q_true is done.q_true


def _outcome(workcell: StereoWorkcell, believed: NeedleError | None, q_true: Floats, aim: _Aim) -> NeedleOutcome | None:
    radius = workcell.case.file.target.hit_radius_mm
    return None if believed is None else needle_outcome(believed, workcell.needle_m(q_true, aim.number), radius)
