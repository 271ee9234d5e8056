"""A recording made by its devices: go to a pose, let the needle be jogged into the slice, take an image, detect."""

from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, Ints, Pixels
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.progress import Count, uncounted
from puncture_twin.planning.formats.csv_table import pose_values, table_text
from puncture_twin.twin.devices import Arm, JogOperator, Probe
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Noise, Recording
from puncture_twin.twin.guidance.ultrasound.needle_detector import Detection, Missed, detect
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, TwoArms, choose_poses, drawing
from puncture_twin.twin.guidance.ultrasound.recording_file import FILE_NAME, GROUPS
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase
from puncture_twin.twin.pictures import png_bytes

JOG_FAILED = "jog out of reach"
JOG_TOUCHES = "jog would touch"


class ProbeDevices(NamedTuple):
    """Devices that make a recording."""

    probe_arm: Arm
    needle_arm: Arm
    operator: JogOperator
    probe: Probe


class ProbeShot(NamedTuple):
    """One image, of a number from 0, with all that belongs to it."""

    number: int
    candidate: int
    q_probe: Floats  # shape (6,), rad, commanded
    q_needle: Floats  # shape (6,), rad, commanded after the jog
    turn_probe: Floats  # shape (6,), direction in which each joint last rotated: 1, -1, or 0
    turn_needle: Floats  # likewise
    image: Pixels
    found: Detection | Missed


@dataclass(frozen=True, eq=False)
class Acquisition:
    """A recording, its poses as the controllers print them, and how it was made."""

    recording: Recording
    shots: tuple[ProbeShot, ...]  # the images behind it, in the same order
    missed: dict[str, int]  # pictures without a needle, by reason, and poses that were given up
    missed_shots: tuple[ProbeShot, ...]  # images without a needle
    left: Ints  # indices of candidates that were never gone to


class _SentArm:
    """An arm, and where it was sent last: from there its joints rotate."""

    def __init__(self, arm: Arm) -> None:
        self._arm = arm
        self._q: Floats | None = None

    def move(self, q: Floats) -> Floats:
        """Move to joints (6,), rad; returns in which direction each rotated, shape (6,): 1, -1, or 0."""
        turn = np.zeros(6) if self._q is None else np.sign(q - self._q)
        self._arm.move_jp(q)
        self._q = q
        return turn


def acquire(
    case: SelfcalCase, workcell: TwoArms, candidates: CandidatePoses, devices: ProbeDevices, rng: np.random.Generator,
    count: Count = uncounted,
) -> Acquisition:  # fmt: skip
    """Record as many poses as the case asks for, choosing others for those in which the needle is not found.

    The workcell checks the jog too; ``rng`` is for the choice, if it is random.

    Raises:
        NoAnswerError: The candidates are used up before enough images show the needle.
    """
    wanted, arms = case.content.poses.count, (_SentArm(devices.probe_arm), _SentArm(devices.needle_arm))
    shots: list[ProbeShot] = []
    missed: list[ProbeShot] = []
    given_up: Counter[str] = Counter()
    left = np.arange(len(candidates.q_probe))
    while len(shots) < wanted:
        if wanted - len(shots) > len(left):
            shown = f"{len(shots)} of {wanted} poses show the needle. Of {len(candidates.q_probe)} candidates"
            lacking = f"{len(missed)} did not show it and {given_up.total()} were given up"
            what = f"{shown}, {lacking}. More [poses] samples would help"
            raise NoAnswerError(what, counts=candidates.counts, code="too_few_poses")
        chosen = choose(case, candidates, left, wanted - len(shots), rng, shots)
        left = np.setdiff1d(left, chosen)
        for row in chosen:
            taken = _shot(case, workcell, candidates, devices, arms, int(row), len(shots) + len(missed))
            if isinstance(taken, str):
                given_up[taken] += 1
            else:
                (missed if isinstance(taken.found, Missed) else shots).append(taken)
            tried = len(missed) + given_up.total()
            count(len(shots) + tried, wanted + tried)
    play = any(arm.errors.backlash_deg > 0.0 for arm in (case.content.probe_arm, case.content.needle_arm))
    reasons = Counter(str(shot.found) for shot in missed) + given_up
    recording = _recording(case, shots, missed, play=play)
    return Acquisition(recording, tuple(shots), dict(reasons), tuple(missed), left)


def keep_pictures(taken: Acquisition, case: SelfcalCase, folder: Path) -> None:
    """Write a recording with its pictures, found or not, into an empty folder: the tips are to be read from them.

    It has the flanges too, by each arm's nominal model as its controller states them, so that no case is needed.
    """
    groups = ("A", "B", "picture", "pixel", "q", *(("turn",) if taken.recording.turn_probe is not None else ()))
    header = ("name", *(column for group in groups for column in GROUPS[group]))
    rows = []
    for shot in sorted((*taken.shots, *taken.missed_shots), key=lambda shot: shot.number):
        name = f"{shot.number + 1:03d}.png"
        (folder / name).write_bytes(png_bytes(shot.image))
        q = np.array([shot.q_probe, shot.q_needle])
        flanges = [pose_values(flange_pose(model, joints[None])) for model, joints in zip(case.models, q, strict=True)]
        turns = [*shot.turn_probe.tolist(), *shot.turn_needle.tolist()] if "turn" in groups else []
        pixel_mm = case.content.image.pixel_mm
        rows.append((str(shot.number + 1), *np.ravel(flanges).tolist(), name, pixel_mm, *np.degrees(q.ravel()), *turns))
    (folder / FILE_NAME).write_text(table_text(header, rows), encoding="utf-8")


def choose(
    case: SelfcalCase, candidates: CandidatePoses, left: Ints, n: int, rng: np.random.Generator, shots: list[ProbeShot]
) -> Ints:
    """The next n candidates of those left: the most informative given what is recorded, or at random."""
    if case.content.poses.choose == "random":
        return np.sort(rng.choice(left, n, replace=False))
    recorded = candidates.poses.subset(np.array([shot.candidate for shot in shots])) if shots else None
    # the arms' lasting errors are not counted here: that gains 3 % of error, and costs the found region 5 % of coverage
    return left[choose_poses(candidates.poses.subset(left), n, choice_noise(case), drawing(case), recorded=recorded)]


def choice_noise(case: SelfcalCase) -> Noise:
    """The noise that poses are chosen for: the case's, or the usual one."""
    return SPEC_NOISE if case.content.noise is None else case.content.noise.noise()


def _shot(
    case: SelfcalCase, workcell: TwoArms, candidates: CandidatePoses, devices: ProbeDevices,
    arms: tuple[_SentArm, _SentArm], row: int, number: int,
) -> ProbeShot | str:  # fmt: skip
    q_probe, poses = candidates.q_probe[row], candidates.poses
    assert poses.v is not None  # candidates are made with directions
    turn_probe = arms[0].move(q_probe)
    roll = float(candidates.roll[row])
    q_needle = devices.operator.jogged_jp(poses.P[row], poses.v[row], roll, candidates.q_needle[row])
    if np.isnan(q_needle).any():
        return JOG_FAILED
    if workcell.verdict(q_probe, q_needle) is not None:
        return JOG_TOUCHES
    turn_needle = arms[1].move(q_needle)
    image = devices.probe.measured_image()
    detection = detect(image, case.content.image.imager())
    return ProbeShot(number, row, q_probe, q_needle, turn_probe, turn_needle, image, detection)


def _recording(case: SelfcalCase, shots: list[ProbeShot], missed: list[ProbeShot], *, play: bool) -> Recording:
    detections = [shot.found for shot in shots if isinstance(shot.found, Detection)]
    keys = ("q_probe", "q_needle", *(("turn_probe", "turn_needle") if play else ()))
    parts: dict[str, Any] = {key: np.array([getattr(shot, key) for shot in shots]) for key in keys}
    A, B = (flange_pose(model, parts[key]) for model, key in zip(case.models, keys[:2], strict=True))
    P, v = np.array([one.tip_image for one in detections]), np.array([one.direction_image for one in detections])
    parts["shaft_mm"] = np.array([one.shaft_mm for one in detections])
    parts["missed"] = tuple((str(shot.number + 1), str(shot.found)) for shot in missed)
    return Recording(A, B, P, v, tuple(str(shot.number + 1) for shot in shots), **parts)
