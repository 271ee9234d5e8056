"""Estimates of ball and target for the servo: the paper's chain, or the joint estimate of everything."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.detection import Detections, Detector, in_space, look_at, searches_of
from puncture_twin.twin.guidance.stereo.joint.joint_model import Adjusted, Guess, Observed, Unknowns, adjust
from puncture_twin.twin.guidance.stereo.joint.needle_error import NeedleError, open_loop_error, servoed_error
from puncture_twin.twin.guidance.stereo.planned import carried_rod, planned_cameras
from puncture_twin.twin.guidance.stereo.robot_calibration import RobotCalibration
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase
from puncture_twin.twin.guidance.stereo.servo_law import Mapping, ball_base, ball_jacobian
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, Seen


class Guide:
    """The paper's chain: calibrated cameras triangulate the ball; the mapping gives the target.

    Args:
        markers: Their pixels.
        markers_m: Shape (n, 3), mm: the markers as the image has them.
    """

    def __init__(
        self,
        case: ServoCase,
        calibration: RobotCalibration,
        mapping: Mapping,
        markers: list[Detections],
        markers_m: Floats,
        detector: Detector,
    ) -> None:
        self._case, self._detector = case, detector
        self._calibration, self._mapping = calibration, mapping
        self._markers, self._markers_m = markers, markers_m
        self._held = carried_rod(case)
        self._T_c_base = np.asarray(np.linalg.inv(calibration.T_base_c))
        self._q = [*calibration.q_command]
        self._pixels = [*calibration.pixels.transpose(1, 0, 2)]
        self._covariances = [*calibration.covariances.transpose(1, 0, 2, 3)]
        self._balls = [*calibration.measured_c]
        self._found: Adjusted | None = None
        self.target_m = np.zeros(3)
        self.target_c = np.zeros(3)

    def aim_at(self, target_m: Floats) -> None:
        """Set the target, shape (3,), mm, image frame."""
        self.target_m = target_m
        self.target_c = self._mapping.to_c(target_m)

    def look(self, q_command: Floats) -> Seen | Lost:
        """Measure the ball in new images; returns ball and target.

        Args:
            q_command: Shape (6,), rad: where the arm was sent; predicts where to search.
        """
        predicted, limits = apply(self._T_c_base, ball_base(self._held, q_command)), self._case.file.servo
        searches = searches_of(self._case, self._calibration.cameras, predicted)
        detections = look_at(self._detector, searches, limits.frames)
        if isinstance(detections, Lost):
            return detections
        self._q.append(q_command)
        self._pixels.append(detections.pixels)
        self._covariances.append(detections.covariances)
        return self._assess(detections)

    def _assess(self, detections: Detections) -> Seen:
        points = in_space(self._calibration.cameras, detections)
        self._balls.append(points.points_c[0])
        return Seen(points.points_c[0], self.target_c, points.covariance[0])

    def needle_unseen(self, q_command: Floats) -> NeedleError | None:
        """Predicted needle at commanded joints (6,), rad; None where the estimate does not settle."""
        return self._believed(lambda found: open_loop_error(found, q_command, self.target_m))

    def corrected_jp(self, q_command: Floats) -> Floats | None:
        """Joints (6,), rad, near the commanded ones that bring the ball onto the target by the arm's estimated errors.

        That is what calibrating the arm is worth without looking again; None where the estimate does not settle.
        """
        if (believed := self.needle_unseen(q_command)) is None:
            return None
        R_base_m = self._calibration.T_base_c[:3, :3] @ self._mapping.T_c_m[:3, :3]
        missed = np.append(R_base_m @ believed.offset_m, np.zeros(3))
        return np.asarray(q_command - np.linalg.solve(ball_jacobian(self._held, q_command), missed))

    def needle_seen(self) -> NeedleError | None:
        """Predicted needle after the last image with its ball; None where the estimate does not settle."""
        return self._believed(lambda found: servoed_error(found, -1, self.target_m))

    def _believed(self, estimate: Callable[[Adjusted], NeedleError]) -> NeedleError | None:
        try:
            return estimate(self.adjusted())
        except NoAnswerError:
            return None

    def adjusted(self) -> Adjusted:
        """The joint estimate of everything measured so far.

        Raises:
            NoAnswerError: It does not settle.
        """
        if self._found is None or len(self._found.unknowns.balls_c) < len(self._balls):
            guess = Guess(self._T_c_base, self._mapping.T_c_m, np.array(self._balls))
            start = None if self._found is None else self._with_new_points(self._found.unknowns)
            self._found = adjust(self.observed(), guess, start)
        return self._found

    def _with_new_points(self, last: Unknowns) -> Unknowns:
        new = np.array(self._balls[len(last.balls_c) :]).reshape(-1, 3)
        return last._replace(balls_c=np.concatenate([last.balls_c, new]))

    def observed(self) -> Observed:
        """Everything measured so far: the stays of the calibration first, then every look that found the ball."""
        case, marks = self._case, self._markers
        return Observed(
            planned_cameras(case),
            self._held,
            case.errors,
            np.array(self._q),
            np.stack(self._pixels, axis=1),
            self._of_pixels(np.stack(self._covariances, axis=1)),
            self._calibration.measured_c,
            np.stack([m.pixels for m in marks], axis=1),
            self._of_pixels(np.stack([m.covariances for m in marks], axis=1)),
            self._markers_m,
        )

    def _of_pixels(self, measured: Floats) -> Floats:
        """Covariances (c, n, 2, 2), px^2: what is declared, else what the tracker reported of each image."""
        declared = self._case.errors.ball_px
        return measured if declared is None else np.broadcast_to(declared**2 * np.eye(2), measured.shape)


class JointGuide(Guide):
    """The joint estimate: every image of the session, the servo's own among them, is adjusted together."""

    def aim_at(self, target_m: Floats) -> None:
        """Set the target; it moves as the estimate does."""
        self.target_m = target_m
        self.target_c = self.adjusted().offset(0, target_m).target_c

    def _assess(self, detections: Detections) -> Seen:
        super()._assess(detections)
        found = self.adjusted().offset(-1, self.target_m)
        self.target_c = found.target_c
        return Seen(found.ball_c, found.target_c, found.ball_covariance)
