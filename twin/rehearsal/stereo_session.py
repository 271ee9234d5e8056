"""Stereo sessions in the twin: guidance by its devices, beside each step what is true of it; many seeds of a case."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri

from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.geometry.rigid import apply, log_rotation
from puncture_twin.twin.devices import Arm
from puncture_twin.twin.guidance.stereo.ball import Detector, image_detector, in_space, look_at
from puncture_twin.twin.guidance.stereo.joint_model import REGION, NeedleError
from puncture_twin.twin.guidance.stereo.servo_case import ServoCase, carried_rod, grid_points, workcell_checker
from puncture_twin.twin.guidance.stereo.servo_law import Lost, Mapping, Servoed, ServoStop, servo
from puncture_twin.twin.guidance.stereo.session import (
    Aims,
    Guide,
    ImageReading,
    Recorder,
    RobotCalibration,
    StereoDevices,
    aims_of,
    calibrate_by_robot,
    calibration_commands,
    map_markers,
)
from puncture_twin.twin.plant.stereo_workcell import ShownBall, StereoPlant, StereoWorkcell, TrueNeedle, draw_workcell

TEST_POINTS = 10
"""Points at which the stereo is tried, as in the paper's Table 1."""
DetectorOf = Callable[[StereoPlant], Detector]
LEAST_VARIANCE = 1e-12
"""mm^2 and rad^2, added to every axis where a covariance is inverted: what cannot err must not divide by zero."""


class NeedleOutcome(NamedTuple):
    """Prediction and truth of one needle; mm and degrees; no hit and no chance of one where the case states no radius.

    Squares are of errors about what is believed, in deviations.
    """

    predicted_rms_mm: float
    offset_mm: float  # what is known of the error: the tip believed, to the target
    half_axes_mm: tuple[float, float, float]  # of the 95 % ellipsoid about that tip, longest first: the region
    lateral_mm: float
    depth_mm: float
    predicted_direction_deg: float  # rms angle to where the needle is believed to point
    p_hit: float | None
    realised_mm: float
    realised_direction_deg: float
    square: float  # chi-squared of 3, for the tip
    square_of_pose: float  # chi-squared of 6, with the rotation
    hit: bool | None
    in_region: bool


def needle_outcome(believed: NeedleError, true: TrueNeedle, radius_mm: float | None) -> NeedleOutcome:
    """Compare a predicted needle with the true one."""
    realised = float(np.linalg.norm(true.error_m))
    turn = log_rotation(true.R_m_needle @ believed.R_m_needle.T)
    error = np.concatenate([true.error_m - believed.offset_m, turn])
    covariance = believed.covariance + np.pad(believed.target_covariance, (0, 3))
    cosine = true.R_m_needle[:, 2] @ believed.R_m_needle[:, 2]
    longest, middle, shortest = believed.half_axes_mm.tolist()
    square = _square(error[:3], believed.tip_covariance)
    return NeedleOutcome(
        predicted_rms_mm=believed.rms_mm, offset_mm=float(np.linalg.norm(believed.offset_m)),
        half_axes_mm=(longest, middle, shortest), lateral_mm=believed.lateral_mm, depth_mm=believed.depth_mm,
        predicted_direction_deg=float(np.degrees(believed.direction_rms)),
        p_hit=None if radius_mm is None else believed.p_hit(radius_mm), realised_mm=realised,
        realised_direction_deg=float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))), square=square,
        square_of_pose=_square(error, covariance), hit=None if radius_mm is None else realised < radius_mm,
        in_region=bool(square <= chdtri(3, 1 - REGION)),
    )  # fmt: skip


def _square(error: Floats, covariance: Floats) -> float:
    return float(error @ np.linalg.solve(covariance + LEAST_VARIANCE * np.eye(len(error)), error))


class TargetRow(NamedTuple):
    """One target of one seed; true errors, mm, of the true ball against the true target but where it says otherwise."""

    seed: int
    target: str
    mapping_mm: float  # estimated target to true target
    expected_tre_mm: float  # of the mapping (rms)
    before_mm: float  # where the robot alone brought it; the whole distance if it could not start
    after_mm: float
    servo_only_mm: float  # true ball to estimated target at the end: what the servo answers for
    steps: int
    stop: str
    needle_open_loop: NeedleOutcome | None = None
    """Where the robot alone brought it; None where it could not start, or nothing can be predicted."""
    needle_servoed: NeedleOutcome | None = None
    calibrated_mm: float | None = None
    """Where the arm, corrected by the joint estimate of its errors, would bring it unseen, but for its repeatability;
    None where the estimate does not settle."""


class DeclarationTest(NamedTuple):
    """Whether the measurements are as far apart as the declared errors make them: by the joint estimate's residuals."""

    chi_squared: float
    freedom: int

    @property
    def p(self) -> float:
        """Chance of residuals so large, or larger, if the declaration holds."""
        return float(chdtrc(self.freedom, self.chi_squared))


class ServoTrial(NamedTuple):
    """One seed; without targets where the session failed as a whole, and was refused."""

    seed: int
    stereo_mm: tuple[float, ...] = ()  # at points of the calibrated volume
    calibration_rms_px: tuple[float, ...] = ()
    fre_mm: float = float("nan")
    robot_residual_mm: float = float("nan")  # against C, mean after the rigid fit
    targets: tuple[TargetRow, ...] = ()
    refused: str | None = None
    declaration: DeclarationTest | None = None  # none where the joint estimate does not settle


class Reached(NamedTuple):
    """True joints (6,), rad, at each of the servo's visits to one target, and at the end, for a picture."""

    row: TargetRow
    servoed: Servoed
    rests: tuple[Floats, ...]  # true joints, (6,), rad, at each of the servo's visits
    q_true: Floats  # shape (6,), rad: true joints at the end


@dataclass(frozen=True, eq=False)
class Session:
    """Result of a session."""

    workcell: StereoWorkcell
    calibration: RobotCalibration
    mapping: Mapping
    reached: tuple[Reached, ...]
    trial: ServoTrial


def run_session(
    case: ServoCase, seed: int, *, targets: tuple[str, ...] | None = None, detector_of: DetectorOf | None = None,
    empty: CellChecker | None = None, record: Path | None = None,
) -> Session:  # fmt: skip
    """Run a whole session in a workcell drawn from a seed; `record` is an empty folder for all that the devices say.

    Raises:
        NoAnswerError: The calibration, the mapping or a start pose could not be done; says what blocked it.
    """
    # One generator for each part: one part's draws do not shift another's.
    spawned = np.random.SeedSequence(seed).spawn(5)
    of_workcell, of_pictures, of_arm, of_image, of_tests = map(np.random.default_rng, spawned)
    workcell = draw_workcell(case, of_workcell)
    plant = StereoPlant(workcell, of_pictures, of_arm, of_tests)
    recorder = None if record is None else Recorder(plant, record)
    devices: StereoDevices = recorder or plant
    detector = image_detector(devices, hough_only=case.hough_only) if detector_of is None else detector_of(plant)
    commands = calibration_commands(case, empty or workcell_checker(case, None))
    calibration = calibrate_by_robot(case, commands, devices, devices, detector)
    plain = detector if recorder is None else image_detector(plant, hough_only=case.hough_only)
    stereo_mm = _try_stereo(plant, calibration, plain, of_tests)
    listed, sd = (case.markers.points, case.targets.points), (case.truth_errors.marker_mm, case.truth_errors.target_mm)
    read = (points + of_image.normal(0.0, mm, points.shape) for points, mm in zip(listed, sd, strict=True))
    reading = ImageReading(*read)  # as somebody reads them in the CT
    plant.head_there = True
    guide = map_markers(case, calibration, detector, devices, reading)
    mapping, reached = guide.mapping, []
    aims = aims_of(case, calibration, mapping, reading.targets_m, targets)
    for row, number in enumerate(aims.numbers):
        devices.move_jp(aims.q_hover[row])
        guide.aim_at(reading.targets_m[number])
        if recorder is not None:
            recorder.target = case.targets.names[number]
        reached.append(_reach(plant, devices, guide, aims, row, seed))
        devices.move_jp(aims.q_hover[row])
    if recorder is not None:
        recorder.finish((case.markers.names, case.targets.names), reading)
    declaration = None
    with suppress(NoAnswerError):
        adjusted = guide.adjusted()
        declaration = DeclarationTest(adjusted.chi2, adjusted.freedom)
    rows, residual = tuple(one.row for one in reached), float(np.mean(calibration.robot_residual_mm))
    stereo = tuple(stereo_mm.tolist())
    figures = ServoTrial(seed, stereo, calibration.rms_px, mapping.fre_mm, residual, rows, None, declaration)
    return Session(workcell, calibration, mapping, tuple(reached), figures)


def _try_stereo(
    plant: StereoPlant, calibration: RobotCalibration, detector: Detector, rng: np.random.Generator
) -> Floats:
    """Error of the stereo at points anywhere in the calibrated volume, shape (10,), mm."""
    case, errors = plant.workcell.case, []
    limits, radius_mm = case.file.servo, case.file.tool.ball_diameter_mm / 2
    T_c_base = np.asarray(np.linalg.inv(calibration.T_base_c), dtype=np.float64)
    grid = grid_points(case)
    rod_c = -T_c_base[:3, :3] @ carried_rod(case).R_base_flange[:, 2]
    for point in rng.uniform(grid.min(axis=0), grid.max(axis=0), (TEST_POINTS, 3)):
        ball, predicted = ShownBall(apply(plant.workcell.T_c_base, point), radius_mm, rod_c), apply(T_c_base, point)
        plant.show(ball)
        detections = look_at(detector, calibration.cameras, predicted, radius_mm, limits.search_px, limits.frames)
        if isinstance(detections, Lost):
            raise NoAnswerError(f"stereo test: {detections.reason}", code="marker_not_seen")
        errors.append(np.linalg.norm(in_space(calibration.cameras, detections).points_c[0] - ball.center_c))
    plant.show(None)
    return np.array(errors)


def _reach(plant: StereoPlant, arm: Arm, guide: Guide, aims: Aims, row: int, seed: int) -> Reached:
    workcell, number = plant.workcell, aims.numbers[row]
    true_target, unseen, seen, calibrated = workcell.targets_c[number], None, None, None
    done = aims.bring(row, arm)
    first = len(plant.rests) - 1
    if done is None:
        unseen = _outcome(plant, guide.needle_unseen(aims.q_aim[row]), number)
        if (q := guide.corrected_jp(aims.q_aim[row])) is not None:
            calibrated = float(np.linalg.norm(workcell.ball_c(q) - true_target))
    before = float(np.linalg.norm(workcell.ball_c(plant.rests[-1]) - true_target))
    if done is None:
        done = servo(aims.task, aims.q_aim[row], guide.look, arm)
        seen = _outcome(plant, guide.needle_seen(), number) if done.ended_in_sight else None
    ball, estimated = workcell.ball_c(plant.rests[-1]), guide.target_c
    pairs = (estimated, true_target), (ball, true_target), (ball, estimated)
    mapping, after, only = (float(np.linalg.norm(a - b)) for a, b in pairs)
    name, expected = workcell.case.targets.names[number], float(aims.expected_tre_mm[row])
    errors = mapping, expected, before, after, only
    found = TargetRow(seed, name, *errors, done.steps, str(done.stop), unseen, seen, calibrated)
    return Reached(found, done, tuple(plant.rests[first : first + len(done.visits)]), plant.rests[-1])


def _outcome(plant: StereoPlant, believed: NeedleError | None, target: int) -> NeedleOutcome | None:
    if believed is None:
        return None
    radius_mm = plant.workcell.case.file.target.hit_radius_mm
    return needle_outcome(believed, plant.workcell.needle_m(plant.rests[-1], target), radius_mm)


def run_trial(case: ServoCase, seed: int, empty: CellChecker | None = None) -> ServoTrial:
    """The trial of one seed; a session that fails becomes a trial with its reason. Arguments as of `run_session`."""
    try:
        return run_session(case, seed, empty=empty).trial
    except NoAnswerError as error:
        return ServoTrial(seed, refused=str(error))


def run_trials(case: ServoCase, seeds: Sequence[int], done: Count = uncounted) -> list[ServoTrial]:
    """The trials of every seed, in the order given; they share the checker of the empty workcell."""
    empty, trials = workcell_checker(case, None), []
    for seed in seeds:
        trials.append(run_trial(case, seed, empty))
        done(len(trials), len(seeds))
    return trials


def declaration_test(trials: Sequence[ServoTrial]) -> DeclarationTest | None:
    """Test of the declaration over all seeds together; None where none has a test."""
    known = [one.declaration for one in trials if one.declaration is not None]
    if not known:
        return None
    return DeclarationTest(sum(one.chi_squared for one in known), sum(one.freedom for one in known))


def statistics(trials: Sequence[ServoTrial]) -> dict[str, Any]:
    """Means, roots of mean squares and maxima over all targets of all seeds, mm; fractions 0..1."""
    rows = [row for one in trials for row in one.targets]
    if not rows:
        what = "no session was possible: " + "; ".join(sorted({one.refused or "" for one in trials}))
        raise NoAnswerError(what, code="no_session")
    stereo = np.concatenate([one.stereo_mm for one in trials])
    mapping, expected, before, after, only = np.array([row[2:7] for row in rows]).T
    calibrated = [row.calibrated_mm for row in rows if row.calibrated_mm is not None]
    errors = {
        "seeds": len(trials),
        "targets": len(rows),
        "refused": sum(bool(one.refused) for one in trials),  # seeds whose session failed
        "stereo_mean": stereo.mean(),
        "stereo_max": stereo.max(),
        "mapping_mean": mapping.mean(),
        "expected_tre_rms": rms(expected),
        "mapping_rms": rms(mapping),
        "before_mean": before.mean(),
        "calibrated_mean": np.mean(calibrated) if calibrated else None,
        "after_mean": after.mean(),
        "servo_only_mean": only.mean(),
        "servo_only_max": only.max(),
        "median_steps": np.median([row.steps for row in rows]),
        "not_confirmed": np.mean([row.stop != ServoStop.CONVERGED for row in rows]),
        "after_over_mapping": after.mean() / mapping.mean(),  # 1 is the floor
    }
    return {key: value if isinstance(value, int | None) else float(value) for key, value in errors.items()}


def needle_statistics(outcomes: Sequence[NeedleOutcome | None]) -> dict[str, Any] | None:
    """Predicted and realised errors of needles, mm and degrees; None where none has a prediction."""
    known = [one for one in outcomes if one is not None]
    if not known:
        return None
    angles = ("predicted_direction_deg", "realised_direction_deg")
    chances = [one.p_hit for one in known if one.p_hit is not None]
    return {
        "needles": len(known),
        "predicted_rms_mm": rms([one.predicted_rms_mm for one in known]),
        "realised_rms_mm": rms([one.realised_mm for one in known]),
        **{name: rms([getattr(one, name) for one in known]) for name in angles},
        "coverage_95": float(np.mean([one.in_region for one in known])),
        "hit_share": float(np.mean([bool(one.hit) for one in known])) if chances else None,
        "mean_p_hit": float(np.mean(chances)) if chances else None,
    }
