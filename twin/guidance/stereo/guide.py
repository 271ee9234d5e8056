"""Who tells the servo where ball and target are: the paper's chain, or the joint estimate of everything."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.detection import Detections, Detector, LocatedPair, Search, in_space, look_at
from puncture_twin.twin.guidance.stereo.joint_model import Guess, Observed, Unknowns
from puncture_twin.twin.guidance.stereo.mapping import Mapping
from puncture_twin.twin.guidance.stereo.optimum import Adjusted, adjust
from puncture_twin.twin.guidance.stereo.robot_calibration import RobotCalibration, held_rod
from puncture_twin.twin.guidance.stereo.servo_law import ball_base
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, Seen
from puncture_twin.twin.guidance.stereo.stereo_room import StereoWorkcell, arm_errors, planned_cameras


class Known(NamedTuple):
    """What a session knows when the servo begins, and the room for its pictures."""

    room: StereoWorkcell
    """Of which only the pictures are used."""
    calibration: RobotCalibration
    mapping: Mapping
    markers: list[Detections]
    """The markers' pixels."""
    markers_m: Floats
    """Shape (n, 3), mm: the markers as the image has them."""
    detector: Detector


class Guide:
    """The chain: calibrated cameras triangulate the ball; the target is where the mapping put it."""

    def __init__(self, known: Known) -> None:
        room, calibration, mapping, markers, markers_m, detector = known
        self._room, self._case, self._detector = room, room.case, detector
        self._calibration, self._mapping = calibration, mapping
        self._markers, self._markers_m = markers, markers_m
        self._held = held_rod(room.case, room)
        self._T_c_base = np.asarray(np.linalg.inv(calibration.T_base_c))
        self._q = [*calibration.q_command]
        self._pixels = [*calibration.pixels.transpose(1, 0, 2)]
        self._covariances = [*calibration.covariances.transpose(1, 0, 2, 3)]
        self.target_m = np.zeros(3)
        self.target_c = np.zeros(3)

    def aim_at(self, target_m: Floats) -> None:
        """Name the target, shape (3,), mm, image frame."""
        self.target_m = target_m
        self.target_c = self._mapping.to_c(target_m)

    def look(self, q_command: Floats, q_true: Floats) -> Seen | Lost:
        """Take pictures of the ball and say where it and the target are.

        Args:
            q_command: Shape (6,), rad: where the arm was sent; predicts where to search.
            q_true: Shape (6,), rad: where it truly is, for the pictures alone.
        """
        tool, limits = self._case.file.tool, self._case.file.servo
        ball = LocatedPair(self._room.ball_c(q_true), tool.ball_diameter_mm / 2, self._room.rod_c(q_true))
        predicted = apply(self._T_c_base, ball_base(self._held, q_command))
        searches = tuple(Search(camera, predicted, limits.search_px) for camera in self._calibration.cameras)
        detections = look_at(self._detector, ball, searches, limits.frames)
        if isinstance(detections, Lost):
            return detections
        self._q.append(q_command)
        self._pixels.append(detections.pixels)
        self._covariances.append(detections.covariances)
        return self._judge(detections)

    def _judge(self, detections: Detections) -> Seen:
        points = in_space(self._calibration.cameras, detections)
        return Seen(points.points_c[0], self.target_c, points.covariance[0])

    def observed(self) -> Observed:
        """Everything measured so far: the stays of the calibration first, then every look that found the ball."""
        case = self._case
        return Observed(
            planned_cameras(case),
            self._held,
            arm_errors(case),
            np.array(self._q),
            np.stack(self._pixels, axis=1),
            np.stack(self._covariances, axis=1),
            self._calibration.measured_c,
            case.file.calibration.measuring_arm_mm,
            np.stack([m.pixels for m in self._markers], axis=1),
            np.stack([m.covariances for m in self._markers], axis=1),
            self._markers_m,
            case.file.head.marker_mm,
        )


class JointGuide(Guide):
    """The joint estimate: every picture of the session, the servo's own among them, is adjusted together."""

    def __init__(self, known: Known) -> None:
        super().__init__(known)
        self._spheres = [*known.calibration.measured_c]
        self._last: Unknowns | None = None

    def aim_at(self, target_m: Floats) -> None:
        """Name the target; it moves as the estimate does."""
        self.target_m = target_m
        self.target_c = self._adjusted().offset(0, target_m).target_c

    def _judge(self, detections: Detections) -> Seen:
        self._spheres.append(in_space(self._calibration.cameras, detections).points_c[0])
        found = self._adjusted().offset(-1, self.target_m)
        self.target_c = found.target_c
        return Seen(found.ball_c, found.target_c, found.ball_covariance)

    def _adjusted(self) -> Adjusted:
        guess = Guess(self._T_c_base, self._mapping.T_c_m, np.array(self._spheres))
        start = None if self._last is None else self._with_new_ball(self._last)
        found = adjust(self.observed(), guess, start)
        self._last = found.unknowns
        return found

    def _with_new_ball(self, last: Unknowns) -> Unknowns:
        new = np.array(self._spheres[len(last.balls_c) :]).reshape(-1, 3)
        return last._replace(balls_c=np.concatenate([last.balls_c, new]))
