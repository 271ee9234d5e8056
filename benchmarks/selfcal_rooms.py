"""Two arms in many hidden rooms: does the 95 % region hold the truth, and how far is the tip from where it should be?

Each room is drawn anew: arms that are not their nominal models, mounts and a needle off the drawing. The chosen poses
are recorded, by tips read with a stated noise or from rendered pictures, and calibrated; then 60 other poses are
predicted and compared with the truth.

.venv/bin/python -m benchmarks.selfcal_rooms              # 150 rooms a row, 20 of rendered pictures: some minutes
.venv/bin/python -m benchmarks.selfcal_rooms --rooms 30   # a look
.venv/bin/python -m benchmarks.selfcal_rooms --only play  # rows whose name contains a word
"""

import time
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from benchmarks.shared import options
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.twin.guidance.ultrasound.acquisition import ProbeDevices, acquire, choose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.arm_errors import DeclaredArms
from puncture_twin.twin.guidance.ultrasound.axp_ybq.calibration import Calibration, ShotByShot, calibrate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.equation import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Noise, Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import CandidatePoses, TwoArms, find_candidates
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase, load_selfcal_case
from puncture_twin.twin.plant.bmode_image import NeedleInImage
from puncture_twin.twin.plant.ultrasound_workcell import UltrasoundPlant, WorkcellTruth, draw_workcell, jog_into_slice

CASE = Path(__file__).resolve().parents[1] / "meshes" / "selfcal"
IMAGE_MM, DIRECTION_RAD = 0.1, float(np.radians(0.3))
"""Noise of tips that are read without a picture."""
RENDERED_MM, RENDERED_RAD = 0.06, float(np.radians(0.12))
"""What is told of tips that are detected in pictures."""
HELD_OUT = 60
SEED = 100
OUTLIER_MM = 5.0


class Kind(NamedTuple):
    """One row of the table: how rooms are drawn, and what the calibration is told."""

    arms: float = 1.0
    """The declared errors of the arms over the true ones; 0: none are declared."""
    told: bool = True
    """Whether the noise is told."""
    rendered: bool = False
    """Whether tips are detected in pictures."""
    play_deg: float = 0.0
    """Of every joint, as declared."""
    true_play: float = 1.0
    """The true play over the declared one."""
    uniform: bool = False
    """Whether all errors are uniform instead of normal, of the same deviation."""
    outliers: int = 0
    """Tips that are 5 mm off."""


class Outcome(NamedTuple):
    """One room."""

    inside: bool
    """Whether the 95 % region of all parameters holds the truth."""
    mahalanobis: float
    """e^T C^-1 e / p."""
    errors_mm: Floats
    """Of the held-out tips, shape (60,)."""
    predicted_mm: Floats
    """Expected (rms) of each."""
    held: float
    """Share of the held-out tips within their 95 % ellipsoid."""
    chi2_per_freedom: float
    lost: int
    """Poses that were set aside."""


ROWS = {
    "noise told, arms not declared": Kind(arms=0.0),
    "noise told, arms declared": Kind(),
    "noise told, arms declared half": Kind(arms=0.5),
    "noise told, arms declared twice": Kind(arms=2.0),
    "noise found, arms not declared": Kind(arms=0.0, told=False),
    "noise found, arms declared": Kind(told=False),
    "uniform errors, noise told": Kind(uniform=True),
    "uniform errors, noise found": Kind(uniform=True, told=False),
    "play .02 deg, noise told": Kind(play_deg=0.02),
    "play .02 deg, noise found": Kind(play_deg=0.02, told=False),
    "play .02 deg, a quarter more, noise told": Kind(play_deg=0.02, true_play=1.25),
    "play .02 deg, a quarter less, noise found": Kind(play_deg=0.02, true_play=0.75, told=False),
    "3 tips 5 mm off, noise told": Kind(outliers=3),
    "3 tips 5 mm off, noise found": Kind(outliers=3, told=False),
    "rendered, arms not declared, noise told": Kind(arms=0.0, rendered=True),
    "rendered, arms declared, noise told": Kind(rendered=True),
    "rendered, arms declared, noise found": Kind(rendered=True, told=False),
    "rendered, play .02 deg, noise found": Kind(rendered=True, told=False, play_deg=0.02),
}


class UniformErrors(np.random.Generator):
    """Draws uniform errors where normal ones are asked for, of the same standard deviation."""

    def normal(self, loc=0.0, scale=1.0, size=None):  # type: ignore[no-untyped-def] # as numpy has it
        """Uniform about ``loc``."""
        return loc + np.sqrt(3.0) * np.asarray(scale) * self.uniform(-1.0, 1.0, size)


@cache
def room_of(play_deg: float) -> tuple[SelfcalCase, TwoArms, CandidatePoses, NDArray[np.int_]]:
    """The shipped case with a play, its checker, its candidates, and the rows that are recorded."""
    case, room, candidates = shipped()
    content = case.content.model_copy(deep=True)
    arms = {}
    for name in ("probe_arm", "needle_arm"):
        arm = getattr(content, name)
        arms[name] = arm.model_copy(update={"errors": arm.errors.model_copy(update={"backlash_deg": play_deg})})
    case = SelfcalCase(case.path, content.model_copy(update=arms), case.inputs)
    left = np.arange(len(candidates.q_probe))
    chosen = choose(case, candidates, left, case.content.poses.count, np.random.default_rng(0), [])
    return case, room, candidates, chosen


@cache
def shipped() -> tuple[SelfcalCase, TwoArms, CandidatePoses]:
    """The shipped case, its checker and candidates, which no play changes."""
    case = load_selfcal_case(CASE)
    room = TwoArms(case)
    return case, room, find_candidates(case, room, np.random.default_rng(case.content.seed))


def outcome(kind: Kind, seed: int) -> Outcome:
    """Draw a room, record, calibrate, compare."""
    case, room, candidates, chosen = room_of(kind.play_deg)
    bits = np.random.PCG64(np.random.SeedSequence([SEED, seed]))
    rng = UniformErrors(bits) if kind.uniform else np.random.Generator(bits)
    truth = with_play(draw_workcell(case, rng), kind.true_play)
    if kind.rendered:
        plant = UltrasoundPlant(case, truth, rng)
        devices = ProbeDevices(plant.probe_arm, plant.needle_arm, plant, plant)
        taken = acquire(case, room, candidates, devices, rng)
        recording, others = taken.recording, taken.left
    else:
        recording, _ = recorded(case, candidates, truth, chosen, rng, noise=True)
        others = np.setdiff1d(np.arange(len(candidates.q_probe)), chosen)
    recording = with_outliers(recording, kind.outliers, rng)
    off = case.content.truth.off_plane_mm
    sizes = (RENDERED_MM, RENDERED_RAD) if kind.rendered else (IMAGE_MM, DIRECTION_RAD)
    declared = (arm._replace(errors=arm.errors.scaled(kind.arms)) for arm in case.declared_arms)
    arms = DeclaredArms(*declared) if kind.arms else None
    noise = Noise(0.0, 0.0, *sizes, off_plane_mm=off) if kind.told else None
    found = calibrate(recording, noise=noise, arms=arms)
    held_out = rng.permutation(others)[:HELD_OUT]
    standing, seen = recorded(case, candidates, truth, held_out, rng, noise=False)
    return compared(found, truth, standing, seen)


def with_play(truth: WorkcellTruth, factor: float) -> WorkcellTruth:
    """The room with another play."""
    probe, needle = (arm._replace(backlash=factor * arm.backlash) for arm in (truth.probe_arm, truth.needle_arm))
    return truth._replace(probe_arm=probe, needle_arm=needle)


def recorded(
    case: SelfcalCase, candidates: CandidatePoses, truth: WorkcellTruth, rows: NDArray[np.int_],
    rng: np.random.Generator, *, noise: bool,
) -> tuple[Recording, Floats]:  # fmt: skip
    """Poses as the controllers print them with the tips as they are read, and the true tips, (n, 3), image.

    With noise the needle is jogged into the slice first, as for a picture; without, it stands as the candidate has it.
    """
    q_probe, q_needle = candidates.q_probe[rows], np.array(candidates.q_needle[rows])
    rest = [q_probe[0], q_needle[0]]
    seen, turns = [], np.zeros((2, len(rows), 6))
    for i, row in enumerate(rows):
        turns[0, i] = np.sign(q_probe[i] - rest[0])
        rest[0] = truth.probe_arm.settle(q_probe[i], rest[0], rng)
        if noise:
            lean = rng.normal(0.0, np.radians(case.content.truth.lean_deg))
            v = np.asarray(candidates.poses.v)[row]
            tip = np.array([*candidates.poses.P[row], rng.normal(0.0, case.content.truth.off_plane_mm)])
            wanted = NeedleInImage(tip, np.array([*(np.cos(lean) * v), np.sin(lean)]))
            jogged = jog_into_slice(truth, rest[0], q_needle[i], wanted, float(candidates.roll[row]))
            q_needle[i] = np.where(np.isnan(jogged), q_needle[i], jogged)
        turns[1, i] = np.sign(q_needle[i] - rest[1])
        rest[1] = truth.needle_arm.settle(q_needle[i], rest[1], rng)
        seen.append(truth.needle_in_image(*rest))
    tips = np.array([one.tip_image for one in seen])
    ways = np.array([one.direction_image for one in seen])
    P, angle = np.array(tips[:, :2]), np.arctan2(ways[:, 1], ways[:, 0])
    if noise:
        P += rng.normal(0.0, IMAGE_MM, P.shape)
        angle = angle + rng.normal(0.0, DIRECTION_RAD, len(P))
    A, B = flange_pose(truth.probe_arm.nominal, q_probe), flange_pose(truth.needle_arm.nominal, q_needle)
    v = np.column_stack([np.cos(angle), np.sin(angle)])
    way = turns if truth.probe_arm.backlash else (None, None)
    recording = Recording(A, B, P, v, q_probe=q_probe, q_needle=q_needle, turn_probe=way[0], turn_needle=way[1])
    return recording, tips


def with_outliers(recording: Recording, count: int, rng: np.random.Generator) -> Recording:
    """The recording with some tips far off."""
    if not count:
        return recording
    P, rows = np.array(recording.P), rng.choice(len(recording), count, replace=False)
    angle = rng.uniform(0.0, 2.0 * np.pi, count)
    P[rows] += OUTLIER_MM * np.column_stack([np.cos(angle), np.sin(angle)])
    return replace(recording, P=P)


def compared(found: Calibration, truth: WorkcellTruth, standing: Recording, tips: Floats) -> Outcome:
    """A calibration against the truth, and its predictions at held-out poses."""
    X, Y = truth.X, truth.Y
    e = found.parameter_error(Estimate(X[:3, :3], X[:3, 3], Y[:3, :3], Y[:3, 3], truth.tip_end2, np.ones(2), truth.V))
    squared = float(e @ np.linalg.solve(found.covariance_counts, e))
    A, B = found.corrected(standing)
    T_base1_image = A @ found.X
    in_base1 = (found.Y @ B @ np.append(found.tip_end2, 1.0))[:, :3]
    seen_base1 = (T_base1_image @ np.column_stack([tips, np.ones(len(tips))])[:, :, None])[:, :3, 0]
    errors, C = in_base1 - seen_base1, found.tip_covariances(standing)
    inside = np.einsum("ni,ni->n", errors, np.linalg.solve(C, errors[:, :, None])[:, :, 0]) <= chi2.ppf(0.95, 3)
    off, predicted = np.linalg.norm(errors, axis=1), np.sqrt(np.trace(C, axis1=1, axis2=2))
    share, ratio = float(inside.mean()), found.chi_squared_ratio
    return Outcome(squared <= found.region_limit(), squared / len(e), off, predicted, share, ratio, len(found.outliers))


def row_text(name: str, outcomes: list[Outcome]) -> str:
    """One line of the table."""
    inside, squared, errors, predicted, held, ratio, lost = zip(*outcomes, strict=True)
    first = f"{name:42s} {len(outcomes):5d} {np.mean(inside):7.3f} {np.mean(squared):8.2f}"
    sizes = f"{rms(np.concatenate(errors)):7.3f} {rms(np.concatenate(predicted)):7.3f}"
    return f"{first} {sizes} {np.mean(held):8.3f} {np.mean(ratio):8.2f} {np.mean(lost):6.2f}"


def shot_ms(kind: Kind) -> float:
    """Milliseconds by which one shot updates a calibration: the median of 100."""
    case, _, candidates, chosen = room_of(kind.play_deg)
    rng = np.random.default_rng(SEED)
    recording, _ = recorded(case, candidates, draw_workcell(case, rng), chosen, rng, noise=True)
    noise = Noise(0.0, 0.0, IMAGE_MM, DIRECTION_RAD, off_plane_mm=case.content.truth.off_plane_mm)
    following = ShotByShot.of(calibrate(recording, noise=noise, arms=case.declared_arms if kind.arms else None))
    shots = [recording.subset(slice(row, row + 1)) for row in range(20)] * 5
    taken = []
    for shot in shots:
        start = time.perf_counter()
        following = following.with_shot(shot)
        taken.append(time.perf_counter() - start)
    return float(np.median(taken)) * 1e3


def main() -> None:
    """Print the table."""
    arguments = options(__doc__, rooms=150, rendered=20, first=0, only="")
    for words, kind in (("arms not declared", Kind(arms=0.0)), ("arms declared", Kind())):
        print(f"one shot, {words}: {shot_ms(kind):.2f} ms")
    print(" " * 42 + "rooms  region    eCe/p    real    told   within   chi2/f   lost")
    for name, kind in ROWS.items():
        if arguments.only in name:
            rooms = arguments.rendered if kind.rendered else arguments.rooms
            first, start = arguments.first, time.perf_counter()
            text = row_text(name, [outcome(kind, seed) for seed in range(first, first + rooms)])
            print(text, f"{(time.perf_counter() - start) / rooms:6.2f} s", flush=True)


if __name__ == "__main__":
    main()
