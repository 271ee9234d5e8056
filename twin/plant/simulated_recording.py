"""Recordings with known truth (spec 3, section 4): two arms, a probe and a needle that lies in the image."""

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import exp_rotation, pose
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import SPEC_NOISE, Noise, Recording
from puncture_twin.twin.guidance.ultrasound.pose_choice import needle_orientations


class PoseRanges(NamedTuple):
    """Uniform ranges from which poses are drawn (spec 3, section 4)."""

    tilt: float = float(np.radians(25.0))  # each component of the probe's rotation vector about its mean pose, +- rad
    shift_mm: float = 60.0  # each coordinate of the probe's flange about its mean, +-
    roll: float = float(np.pi)  # the needle about its own axis, +- rad
    u_mm: tuple[float, float] = (-25.0, 25.0)  # where the tip lies across the image
    v_mm: tuple[float, float] = (5.0, 65.0)  # where the tip lies in depth
    insertion: tuple[float, float] = (float(np.radians(20.0)), float(np.radians(75.0)))
    """Angle of the needle in the image, from its u axis, rad."""
    lean: float = 0.0
    """Standard deviation of how far the needle leans out of the slice, rad; spec 3 has it lie in the slice."""
    at_ends: float = 0.0
    """Fraction of all values that lie at an end of their range instead of anywhere in it: candidates that tell more."""

    def draw(self, rng: np.random.Generator, low: float, high: float, size: int | tuple[int, int]) -> Floats:
        """Values of a range, shape ``size``."""
        values = rng.uniform(low, high, size)
        if self.at_ends == 0.0:
            return values
        ends = np.where(rng.random(size) < 0.5, low, high)
        return np.where(rng.random(size) < self.at_ends, ends, values)


USUAL = PoseRanges()


class SimulatedTruth(NamedTuple):
    """Ground truth that a calibration estimates."""

    X: Floats  # T_end1_image, shape (4, 4), mm
    Y: Floats  # T_base1_base2, shape (4, 4), mm
    tip_end2: Floats  # shape (3,), mm
    direction_end2: Floats  # shape (3,), unit, toward the tip
    A_mean: Floats  # T_base1_end1, shape (4, 4), mm, about which the probe's poses are drawn


class ImagePose(NamedTuple):
    """The needle in the image at n poses: the tip (n, 2); angles (n,), rad, ``lean`` out of the slice."""

    tip_mm: Floats  # shape (n, 2)
    insertion: Floats  # shape (n,), rad
    roll: Floats  # shape (n,), rad
    lean: Floats


def draw_truth(rng: np.random.Generator) -> SimulatedTruth:
    """A probe, two bases 0.9 m apart and a needle of 140 to 200 mm, each at random about its usual place."""
    X = pose(exp_rotation(rng.uniform(-0.5, 0.5, 3)), np.array([0.0, 30.0, 80.0]) + rng.uniform(-20, 20, 3))
    R_Y = exp_rotation(np.array([0.0, 0.0, np.pi])) @ exp_rotation(rng.uniform(-0.3, 0.3, 3))
    Y = pose(R_Y, np.array([900.0, 0.0, 0.0]) + rng.uniform(-60, 60, 3))
    direction = exp_rotation(rng.uniform(-0.3, 0.3, 3))[:, 2]
    tip = rng.uniform(140.0, 200.0) * direction + np.append(rng.uniform(-15, 15, 2), 0.0)
    R_mean = exp_rotation(np.array([np.pi, 0.0, 0.0])) @ exp_rotation(rng.uniform(-0.3, 0.3, 3))
    return SimulatedTruth(X, Y, tip, direction, pose(R_mean, np.array([450.0, 0.0, 300.0])))


def draw_probe_poses(rng: np.random.Generator, truth: SimulatedTruth, n: int, ranges: PoseRanges = USUAL) -> Floats:
    """A within the ranges, shape (n, 4, 4)."""
    R = truth.A_mean[:3, :3] @ exp_rotation(ranges.draw(rng, -ranges.tilt, ranges.tilt, (n, 3)))
    return pose(R, truth.A_mean[:3, 3] + ranges.draw(rng, -ranges.shift_mm, ranges.shift_mm, (n, 3)))


def draw_image_poses(rng: np.random.Generator, n: int, ranges: PoseRanges = USUAL) -> ImagePose:
    """The needle in the image within the ranges."""
    tip = np.column_stack([ranges.draw(rng, *ranges.u_mm, n), ranges.draw(rng, *ranges.v_mm, n)])
    angles = ranges.draw(rng, *ranges.insertion, n), rng.uniform(-ranges.roll, ranges.roll, n)
    return ImagePose(tip, *angles, rng.normal(0.0, ranges.lean, n) if ranges.lean else np.zeros(n))


def exact_recording(truth: SimulatedTruth, A: Floats, seen: ImagePose) -> Recording:
    """The recording without noise, of A (n, 4, 4): B such that the needle shows in the image as wished."""
    n = len(A)
    shown = np.column_stack([np.cos(seen.insertion), np.sin(seen.insertion)])
    along = np.column_stack([shown * np.cos(seen.lean)[:, None], np.sin(seen.lean)])
    M = needle_orientations(along, truth.direction_end2, seen.roll)
    R_AX = A[:, :3, :3] @ truth.X[:3, :3]
    tip = R_AX[:, :, :2] @ seen.tip_mm[:, :, None]
    tip_base1 = tip[:, :, 0] + A[:, :3, :3] @ truth.X[:3, 3] + A[:, :3, 3]
    B = np.tile(np.eye(4), (n, 1, 1))
    B[:, :3, :3] = truth.Y[:3, :3].T @ R_AX @ M
    B[:, :3, 3] = (tip_base1 - truth.Y[:3, 3]) @ truth.Y[:3, :3] - B[:, :3, :3] @ truth.tip_end2
    return Recording(A, B, seen.tip_mm, shown)


def with_noise(rng: np.random.Generator, exact: Recording, noise: Noise) -> Recording:
    """The recording as it would be read."""
    n = len(exact)
    v = None
    if exact.v is not None:
        angle = np.arctan2(exact.v[:, 1], exact.v[:, 0]) + rng.normal(0.0, noise.direction_rad, n)
        v = np.column_stack([np.cos(angle), np.sin(angle)])
    A, B = (_shaken(rng, T, noise) for T in (exact.A, exact.B))
    return Recording(A, B, exact.P + rng.normal(0.0, noise.image_mm, (n, 2)), v)


def simulate_recording(
    rng: np.random.Generator, n: int, truth: SimulatedTruth | None = None, *,
    noise: Noise | None = SPEC_NOISE, ranges: PoseRanges = USUAL,
) -> tuple[Recording, SimulatedTruth]:  # fmt: skip
    """Draw a recording of n poses, and the truth where none is given; ``noise=None`` leaves it exact."""
    truth = draw_truth(rng) if truth is None else truth
    exact = exact_recording(truth, draw_probe_poses(rng, truth, n, ranges), draw_image_poses(rng, n, ranges))
    return (exact if noise is None else with_noise(rng, exact, noise)), truth


def _shaken(rng: np.random.Generator, T: Floats, noise: Noise) -> Floats:
    shaken = np.array(T)
    shaken[:, :3, :3] = T[:, :3, :3] @ exp_rotation(rng.normal(0.0, noise.robot_rad, (len(T), 3)))
    shaken[:, :3, 3] += rng.normal(0.0, noise.robot_mm, (len(T), 3))
    return shaken
