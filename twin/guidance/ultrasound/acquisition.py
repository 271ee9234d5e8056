"""Recordings made in the twin: go to a pose, jog the needle into the slice, take an image, detect, record.

`WorkcellTruth` is the workcell in which a recording is made: two arms as they move, the mounts, the needle.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Pixels
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.image.needle_detector import Detection, Missed, detect
from puncture_twin.twin.guidance.ultrasound.image.probe_image import NeedleInImage, render
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, choose_poses, drawing, needle_flange
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.guidance.ultrasound.simulate import SPEC_NOISE
from puncture_twin.twin.guidance.ultrasound.two_arms import BetweenArms, TwoArms

JOG_FAILED = "jog out of reach"
JOG_TOUCHES = "jog would touch"


class ProbeShot(NamedTuple):
    """One image with all that belongs to it."""

    candidate: int
    q_probe: Floats
    """Commanded joints of the probe's arm, shape (6,), rad."""
    q_needle: Floats
    """Commanded joints of the needle's arm after the jog, shape (6,), rad."""
    turn_probe: Floats
    """Direction in which each of its joints last rotated, shape (6,): 1, -1, or 0."""
    turn_needle: Floats
    """Directions of the needle arm's joints, shape (6,)."""
    image: Pixels
    found: Detection | Missed
    true_needle: NeedleInImage
    """The true needle in the true image."""
    touched: bool
    """Whether the true arms touched each other."""


@dataclass(frozen=True, eq=False)
class Acquisition:
    """A recording with its ground truth.

    Attributes:
        recording: Poses as the controllers print them, tips and directions as detected.
        shots: The images behind it, in the same order.
        missed: Pictures in which no needle was found, by reason, and poses that were given up.
        missed_shots: Those images.
        left: Indices of candidates that were never gone to.
    """

    recording: Recording
    shots: tuple[ProbeShot, ...]
    missed: dict[str, int]
    missed_shots: tuple[ProbeShot, ...]
    left: NDArray[np.int_]

    def detection_errors(self) -> Floats:
        """Detected minus true tip, along and across the true shaft, mm, and the angle's error, rad; shape (n, 3)."""
        return np.array([_detection_error(shot) for shot in self.shots])


class _Motion:
    """The true motion of both arms, with the play of their last arrivals, and whether they touch."""

    def __init__(self, case: SelfcalCase, truth: WorkcellTruth, rng: np.random.Generator) -> None:
        self._truth, self._rng = truth, rng
        self.between = BetweenArms(case, truth.X, truth.Y, 0.0)
        self._before: list[Floats | None] = [None, None]
        self.turns = [np.zeros(6), np.zeros(6)]

    def settle(self, which: int, q: Floats) -> Floats:
        """Joints of arm 0 (probe) or 1 (needle) at rest, shape (6,), rad."""
        arm = (self._truth.probe_arm, self._truth.needle_arm)[which]
        before = self._before[which]
        before = q if before is None else before
        rest = arm.settle(q, before, self._rng)
        self.turns[which] = np.sign(q - before)
        self._before[which] = rest
        return rest


def acquire(
    case: SelfcalCase,
    workcell: TwoArms,
    candidates: CandidatePoses,
    truth: WorkcellTruth,
    rng: np.random.Generator,
    count: Count = uncounted,
) -> Acquisition:
    """Record as many poses as the case asks for, choosing others for those in which the needle is not found.

    Args:
        case: The self-calibration case.
        workcell: Its collision checker: the jog is checked too.
        candidates: Poses that can be taken.
        truth: The ground truth.
        rng: For the choice, if random, the arms' repeatability, what the jog leaves, and the images.
        count: Called after every image.

    Raises:
        NoAnswerError: The candidates are used up before enough images show the needle.
    """
    motion, wanted = _Motion(case, truth, rng), case.content.poses.count
    shots: list[ProbeShot] = []
    missed: list[ProbeShot] = []
    given_up: Counter[str] = Counter()
    left = np.arange(len(candidates.q_probe))
    while len(shots) < wanted:
        if wanted - len(shots) > len(left):
            what = _too_few(case, candidates, shots, missed, given_up)
            raise NoAnswerError(what, counts=candidates.counts, code="too_few_poses")
        chosen = choose(case, candidates, left, wanted - len(shots), rng, shots)
        left = np.setdiff1d(left, chosen)
        for row in chosen:
            taken = _shot(case, workcell, candidates, truth, motion, int(row), rng)
            if isinstance(taken, str):
                given_up[taken] += 1
            elif isinstance(taken.found, Missed):
                missed.append(taken)
            else:
                shots.append(taken)
            tried = len(missed) + given_up.total()
            count(len(shots) + tried, wanted + tried)
    play = any(arm.backlash_rad > 0.0 for arm in (truth.probe_arm, truth.needle_arm))
    reasons = Counter(shot.found.value for shot in missed if isinstance(shot.found, Missed)) + given_up
    return Acquisition(_recording(workcell, shots, play=play), tuple(shots), dict(reasons), tuple(missed), left)


def choose(
    case: SelfcalCase,
    candidates: CandidatePoses,
    left: NDArray[np.int_],
    n: int,
    rng: np.random.Generator,
    shots: list[ProbeShot],
) -> NDArray[np.int_]:
    """The next n candidates of those left: the most informative given what is recorded, or at random."""
    if case.content.poses.choose == "random":
        return np.sort(rng.choice(left, n, replace=False))
    recorded = candidates.poses.subset(np.array([shot.candidate for shot in shots])) if shots else None
    noise = choice_noise(case)
    # the arms' lasting errors are not counted here: that gains 3 % of error, and costs the found region 5 % of coverage
    return left[choose_poses(candidates.poses.subset(left), n, noise, drawing(case), recorded=recorded)]


def choice_noise(case: SelfcalCase) -> Noise:
    """The noise that poses are chosen for: the case's, or the usual one."""
    return SPEC_NOISE if case.content.noise is None else case.content.noise.noise()


def _shot(
    case: SelfcalCase,
    workcell: TwoArms,
    candidates: CandidatePoses,
    truth: WorkcellTruth,
    motion: _Motion,
    row: int,
    rng: np.random.Generator,
) -> ProbeShot | str:
    """Go to one candidate and take its image, or return why it was given up."""
    q_probe = candidates.q_probe[row]
    rest_probe = motion.settle(0, q_probe)
    wanted = _after_jog(case, candidates.poses, row, rng)
    q_needle = jog_into_slice(truth, rest_probe, candidates.q_needle[row], wanted, float(candidates.roll[row]))
    if np.isnan(q_needle).any():
        return JOG_FAILED
    if workcell.verdict(q_probe, q_needle) is not None:
        return JOG_TOUCHES
    rest_needle = motion.settle(1, q_needle)
    needle = truth.needle_in_image(rest_probe, rest_needle)
    imager = case.content.image.imager()
    image = render(imager, needle, rng, echo=case.content.image.echo())
    touched = not motion.between.apart(rest_probe, rest_needle)
    return ProbeShot(
        row, q_probe, q_needle, motion.turns[0], motion.turns[1], image, detect(image, imager), needle, touched
    )


def _after_jog(case: SelfcalCase, poses: Recording, row: int, rng: np.random.Generator) -> NeedleInImage:
    """Intended needle in the image, with what the operator leaves: off the plane, and leaning."""
    off = case.content.truth
    assert poses.v is not None  # candidates are made with directions
    lean = rng.normal(0.0, np.radians(off.lean_deg))
    tip = np.array([*poses.P[row], rng.normal(0.0, off.off_plane_mm)])
    return NeedleInImage(tip, np.array([*(np.cos(lean) * poses.v[row]), np.sin(lean)]))


def _recording(workcell: TwoArms, shots: list[ProbeShot], *, play: bool) -> Recording:
    """The recording of images and controllers; with the joints' directions of rotation, where these matter."""
    found = [shot.found for shot in shots if isinstance(shot.found, Detection)]
    q_probe, q_needle = (np.array([getattr(shot, key) for shot in shots]) for key in ("q_probe", "q_needle"))
    turns = (np.array([getattr(shot, key) for shot in shots]) for key in ("turn_probe", "turn_needle"))
    turn_probe, turn_needle = turns if play else (None, None)
    return Recording(
        flange_pose(workcell.probe_model, q_probe),
        flange_pose(workcell.needle_model, q_needle),
        np.array([one.tip_image for one in found]),
        np.array([one.direction_image for one in found]),
        q_probe=q_probe,
        q_needle=q_needle,
        turn_probe=turn_probe,
        turn_needle=turn_needle,
        shaft_mm=np.array([one.shaft_mm for one in found]),
    )


def _detection_error(shot: ProbeShot) -> tuple[float, float, float]:
    assert isinstance(shot.found, Detection)  # only those are kept as shots
    d = shot.true_needle.direction_image[:2] / np.linalg.norm(shot.true_needle.direction_image[:2])
    e = shot.found.tip_image - shot.true_needle.tip_image[:2]
    v = shot.found.direction_image
    return float(e @ d), float(d[0] * e[1] - d[1] * e[0]), float(np.arctan2(d[0] * v[1] - d[1] * v[0], d @ v))


def _too_few(
    case: SelfcalCase,
    candidates: CandidatePoses,
    shots: list[ProbeShot],
    missed: list[ProbeShot],
    given_up: Counter[str],
) -> str:
    return (
        f"{len(shots)} of {case.content.poses.count} poses show the needle. Of {len(candidates.q_probe)} candidates, "
        f"{len(missed)} did not show it and {given_up.total()} were given up. More [poses] samples would help"
    )


JOG_STEPS = 4
"""Steps of the operator's correction: each leaves about the arms' relative error, 1e-3, of what was left before."""


class MovingArm(Protocol):
    """An arm commanded by its nominal model that moves as the plant drew it."""

    @property
    def nominal(self) -> UrModel:
        """The nominal model."""

    @property
    def backlash_rad(self) -> float:
        """Full width of the play of every joint."""

    def flange_pose(self, q_true: Floats) -> Floats:
        """T_base_flange, shape (..., 4, 4), mm, of true configurations (..., 6), rad."""

    def settle(self, q_command: Floats, q_before: Floats, rng: np.random.Generator) -> Floats:
        """Joints at rest, shape (6,), rad, after those of the arrival before."""


class WorkcellTruth(NamedTuple):
    """The ground truth of one workcell: whoever calibrates must not look in here."""

    probe_arm: MovingArm
    needle_arm: MovingArm
    X: Floats
    """T_end1_image, shape (4, 4), mm."""
    Y: Floats
    """T_base1_base2, shape (4, 4), mm."""
    tip_end2: Floats
    """Shape (3,), mm."""
    V: Floats
    """The needle's direction in end2, shape (3,), unit."""

    def image_pose(self, q_probe: Floats) -> Floats:
        """The true T_base1_image, shape (4, 4), mm, of the probe's arm at rest at ``q_probe`` (6,), rad."""
        return np.asarray(self.probe_arm.flange_pose(q_probe) @ self.X)

    def needle_in_image(self, q_probe: Floats, q_needle: Floats) -> NeedleInImage:
        """The true needle in the true image, both arms at rest."""
        T = np.linalg.inv(self.image_pose(q_probe)) @ self.Y @ self.needle_arm.flange_pose(q_needle)
        direction = T[:3, :3] @ self.V
        return NeedleInImage(T[:3, :3] @ self.tip_end2 + T[:3, 3], direction / np.linalg.norm(direction))


def jog_into_slice(
    truth: WorkcellTruth, q_probe: Floats, q_needle: Floats, wanted: NeedleInImage, roll: float
) -> Floats:
    """Move the needle's arm until the true needle is in the true image as wanted.

    It stands for the operator, or a servo on the image, that jogs until the needle shows: what is left is in
    ``wanted``. The commands follow from the nominal kinematics, corrected by what the true arm did before.

    Args:
        truth: The ground truth.
        q_probe: Where the probe's joints rest, shape (6,), rad.
        q_needle: Where the needle's arm begins, shape (6,), rad.
        wanted: The needle in the image, after the jog.
        roll: About the needle, rad.

    Returns:
        What the arm is commanded, shape (6,), rad; NaN where no configuration reaches it.
    """
    nominal = truth.needle_arm.nominal
    T_base2_image = (np.linalg.inv(truth.Y) @ truth.image_pose(q_probe))[None]
    tip, along = wanted.tip_image[None], wanted.direction_image[None]
    goal = needle_flange(T_base2_image, tip, along, np.array([roll]), truth.tip_end2, truth.V)[0]
    command, q = goal, np.array(q_needle)
    for _ in range(JOG_STEPS):
        q = nearest_configuration(truth.needle_arm, command, q)
        if np.isnan(q).any():
            return q
        command = flange_pose(nominal, q) @ np.linalg.inv(truth.needle_arm.flange_pose(q)) @ goal
    return q


def nearest_configuration(arm: MovingArm, T_base_flange: Floats, q_near: Floats) -> Floats:
    """The nominal arm's configuration for a flange pose that is nearest to another, shape (6,), rad; NaN for none."""
    q = nearest_within_limits(arm.nominal, inverse(arm.nominal, T_base_flange)[0], q_near)
    away = np.linalg.norm(q - q_near, axis=1)
    return np.array(q[int(np.argmin(np.where(np.isnan(away), np.inf, away)))])
