"""Monte Carlo trials without physics, many at once: markers read and touched, registered, the needle at the target.

Every trial draws its truth anew from one declaration of errors; the arm's motion is exact kinematics, not linearised.
Under guidance tissue has moved too, and breathes. A needle that bends ends off its line, its bevel to a drawn side.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import inverse, wrap_to_pi
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.breathing.breathing import Breathing, position_at
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.geometry.rigid import apply, exp_rotation
from puncture_twin.planning.needle.insertion_force import Pushed
from puncture_twin.planning.registration.fits import (
    Aim,
    ReadingNoise,
    design,
    fit_joint,
    fit_rigid,
    fit_triad,
    fit_weighted,
    least_squares_map,
)
from puncture_twin.planning.registration.marker_noise import parameter_variances
from puncture_twin.planning.registration.placement import aimed_fit
from puncture_twin.planning.uncertainty.pose_error import Bend
from puncture_twin.twin.plant.true_needle import TrueNeedle, joints_at_points, true_needle


@dataclass(frozen=True, eq=False)
class Puncture:
    """Common part of all trials: the belief, and the commands that follow from it, the tip on the target."""

    model: UrModel
    tip_mm: float
    method: str
    noise: ReadingNoise  # weighs the method ``weighted``
    points_ct: Floats  # shape (N, 3), mm, the markers
    q_touch: Floats  # shape (N, 6), rad, how the arm touches them
    T_base_ct: Floats  # shape (4, 4), mm: where the patient lies
    target_ct: Floats  # shape (3,), mm
    outward_ct: Floats  # shape (3,), unit, from the target along the needle
    q_insertion: Floats  # shape (6,), rad, the tip on the target
    bend: Bend | None = None
    aim: Aim | None = None  # for which the method ``joint`` corrects every pose
    push: Pushed | None = None


class Trials(NamedTuple):
    """Results of n trials; CT frame, mm; positions are relative to the target, which the last three have moved."""

    tip_ct: Floats  # shape (n, 3), where the tip ended
    outward_ct: Floats  # shape (n, 3), unit, from there along the needle
    target_ct: Floats  # shape (n, 3), true target
    T_base_ct: Floats  # shape (n, 4, 4), as each registered
    reached: Bools  # shape (n,), whether the arm could reach the pose that followed
    R_ct_needle: Floats  # shape (n, 3, 3), z to the tip
    chi_squared: Floats  # shape (n,), of the weighted residuals of each trial's markers against the believed noise
    bevel_side: Floats  # shape (n,), rad, whereto the bevel points about the needle's z; 0 where it has none
    motion_ct: Floats  # shape (n, 3), by how much the body about the target has moved since the scan
    breath_ct: Floats  # shape (n, 3), and by how much the breath has moved the target
    pushed_ct: Floats  # shape (n, 3), and by how much the needle has

    def of(self, rows: Bools | Ints) -> Trials:
        """The results of some trials."""
        return Trials._make(column[rows] for column in self)


class Moving(NamedTuple):
    """Motion between scan and insertion: target and surroundings (3, 3), mm^2; markers by a fraction of its breath."""

    cov_ct: Floats  # shape (3, 3), mm^2, of the target and its surroundings
    breathing: Breathing | None
    skin_weight: float


class Truths(NamedTuple):
    """Ground truth of n trials before the needle goes in, the same for every way of guidance; CT frame, mm, rad."""

    eta: Floats  # shape (n, 28), the arm's errors
    read_ct: Floats  # shape (n, N, 3), what the CT shows of the markers
    touched_base: Floats  # shape (n, N, 3), what the touches read
    arrival: Floats  # shape (n, 6), true joints less the encoders', drift since the touches included
    target_ct: Floats
    side: Floats
    motion_ct: Floats
    breath_ct: Floats


def draw_truths(
    puncture: Puncture, errors: ErrorModel, count: int, rng: np.random.Generator, moving: Moving | None = None
) -> Truths:
    """Draw the truth of trials from declared errors; what moves has a generator of its own."""
    motion, breath, skin = _moved(moving, count, rng)
    eta = rng.normal(size=(count, 28)) * np.sqrt(parameter_variances(errors.arm))  # stays for all touches of a trial
    read_ct, touched = _touched(puncture, errors, eta, skin, rng)
    arrival = rng.normal(size=(count, 6)) * np.hypot(errors.arm.arriving, errors.arm.drift)
    target_ct = puncture.target_ct + _normal(rng, errors.target_cov_ct, (count,))
    side = np.zeros(count) if puncture.bend is None else rng.uniform(0, 2 * np.pi, count)
    return Truths(eta, read_ct, touched, arrival, target_ct, side, motion, breath)


def _moved(moving: Moving | None, count: int, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    still = np.zeros((count, 3))
    if moving is None:
        return still, still, still
    own, breathing = rng.spawn(1)[0], moving.breathing
    motion = _normal(own, moving.cov_ct, (count,))
    if breathing is None:
        return motion, still, still
    gate = 1.0 if breathing.gate is None else breathing.gate
    s = position_at(own.uniform(size=(2, count, 1)), gate, breathing.exponent)
    inserted, touched = (s - breathing.scanned_at) * breathing.amplitude_mm * breathing.direction_ct
    return motion, inserted, moving.skin_weight * touched


def draw_trials(puncture: Puncture, errors: ErrorModel, count: int, rng: np.random.Generator) -> Trials:
    """Draw trials from declared errors and rehearse the puncture in each, by its registration."""
    return open_loop(puncture, draw_truths(puncture, errors, count, rng))


def open_loop(puncture: Puncture, truths: Truths) -> Trials:
    """Trials in which the needle goes where the registration puts the target."""
    T_base_ct = registered(puncture, truths)
    q, reached = commanded(puncture, T_base_ct)
    needle = true_needle(puncture.model, q + truths.arrival, truths.eta, puncture.tip_mm)
    return ended(puncture, truths, T_base_ct, needle, reached)


def ended(puncture: Puncture, truths: Truths, T_base_ct: Floats, needle: TrueNeedle, reached: Bools) -> Trials:
    """Trials registered at T_base_ct (n, 4, 4) whose straight needles ended so; each bends if the puncture's does."""
    T_ct_base = np.linalg.inv(puncture.T_base_ct)
    if puncture.bend is not None:
        needle = bent(needle, puncture.bend, truths.side)
    outward_ct = -needle.R_base_needle[:, :, 2] @ T_ct_base[:3, :3].T  # z points to the tip, outward away from it
    R_ct_needle = T_ct_base[:3, :3] @ needle.R_base_needle
    there = apply_each(T_base_ct, truths.read_ct)
    squares = _chi_squared(puncture, (truths.touched_base - there).reshape(len(there), -1))
    pushed_ct = pushed_by(puncture, truths, needle)
    tip_ct = apply(T_ct_base, needle.tip_base) - truths.motion_ct - truths.breath_ct - pushed_ct
    return Trials(
        tip_ct, outward_ct, truths.target_ct, T_base_ct, reached, R_ct_needle, squares, truths.side, truths.motion_ct,
        truths.breath_ct, pushed_ct,
    )  # fmt: skip


def pushed_by(puncture: Puncture, truths: Truths, needle: TrueNeedle) -> Floats:
    """By how much needles have pushed their targets on, shape (n, 3), CT frame: along each, by its own depth."""
    if puncture.push is None:
        return np.zeros_like(truths.motion_ct)
    T_ct_base = np.linalg.inv(puncture.T_base_ct)
    tip_ct = apply(T_ct_base, needle.tip_base) - truths.motion_ct - truths.breath_ct
    depth_mm = puncture.push.target_mm - (tip_ct - puncture.target_ct) @ puncture.outward_ct
    return np.asarray(puncture.push.at(depth_mm)[:, None] * (needle.R_base_needle[:, :, 2] @ T_ct_base[:3, :3].T))


def bent(needle: TrueNeedle, bend: Bend, side: Floats) -> TrueNeedle:
    """Bent needles, each rotated about its clamp so that its straight line ends at the tip; bevel sides (n,), rad."""
    x, y = needle.R_base_needle[:, :, 0], needle.R_base_needle[:, :, 1]
    c, s = np.cos(side)[:, None], np.sin(side)[:, None]
    turn = bend.tip_mm / bend.clamped_mm * (c * y - s * x)  # rotation vector: z x the side that it bends to
    return TrueNeedle(needle.tip_base + bend.tip_mm * (c * x + s * y), exp_rotation(turn) @ needle.R_base_needle)


def _chi_squared(puncture: Puncture, residuals: Floats) -> Floats:
    R, points = puncture.T_base_ct[:3, :3], apply(puncture.T_base_ct, puncture.points_ct)
    A = design(points, points.mean(axis=0))
    weights = np.asarray(np.linalg.inv(puncture.noise.covariance(R).whole), dtype=np.float64)
    left = weights - weights @ A @ least_squares_map(A, weights)  # less what the fit explains
    return np.asarray(np.einsum("na,ab,nb->n", residuals, left, residuals, optimize=True))


def _touched(
    puncture: Puncture, errors: ErrorModel, eta: Floats, moved_ct: Floats, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    count, markers = len(eta), len(puncture.points_ct)
    eta_of = np.broadcast_to(eta[:, None], (count, markers, 28))
    read_ct = puncture.points_ct + _normal(rng, errors.marker_cov_ct, (count, markers))
    there = apply(puncture.T_base_ct, puncture.points_ct + moved_ct[:, None])
    q_true = joints_at_points(puncture.model, there, puncture.q_touch, eta_of, puncture.tip_mm)
    q_encoder = q_true - rng.normal(size=q_true.shape) * errors.arm.repeatability  # true minus arrival
    flange = flange_pose(puncture.model, q_encoder)
    touched = flange[..., :3, 3] + puncture.tip_mm * flange[..., :3, 2]
    return read_ct, touched + rng.normal(size=touched.shape) * errors.touch_mm


def apply_each(T: Floats, points: Floats) -> Floats:
    """Points (n, m, 3), those of each trial carried by its own T (n, 4, 4)."""
    return np.asarray(points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3])


def registered(puncture: Puncture, truths: Truths) -> Floats:
    """T_base_ct of every trial, shape (n, 4, 4), by the puncture's method."""
    read_ct, touched = truths.read_ct, truths.touched_base
    if puncture.method == "triad":
        return fit_triad(read_ct, touched)
    fitted = fit_rigid(read_ct, touched)
    if puncture.aim is not None:
        return aimed_fit(read_ct, touched, puncture.noise, fitted, puncture.aim)
    weigh = {"weighted": fit_weighted, "joint": fit_joint}.get(puncture.method)
    return fitted if weigh is None else weigh(read_ct, touched, puncture.noise, fitted)


def commanded(
    puncture: Puncture, T_base_ct: Floats, moved_base: Floats | float = 0.0, out_mm: float = 0.0,
    q_near: Floats | None = None,
) -> tuple[Floats, Bools]:  # fmt: skip
    """The joints (n, 6) that the nominal arm takes to the target, in the planned branch and roll, and whether.

    By T_base_ct (n, 4, 4), as registered; the needle is corrected by ``moved_base`` (n, 3), mm, and ends so far before
    the target, near joints (6,), rad, that were planned there (None: those of the insertion).
    """
    q_near = puncture.q_insertion if q_near is None else q_near
    R_ct_flange = puncture.T_base_ct[:3, :3].T @ flange_pose(puncture.model, puncture.q_insertion)[:3, :3]
    poses = np.zeros((len(T_base_ct), 4, 4))
    poses[:, :3, :3] = T_base_ct[:, :3, :3] @ R_ct_flange
    target_base = T_base_ct[:, :3, :3] @ puncture.target_ct + T_base_ct[:, :3, 3] + moved_base
    poses[:, :3, 3], poses[:, 3, 3] = target_base - (puncture.tip_mm + out_mm) * poses[:, :3, 2], 1.0
    turns = wrap_to_pi(inverse(puncture.model, poses) - q_near)
    far = np.where(np.isnan(turns).any(axis=2), np.inf, np.abs(turns).max(axis=2))
    branch = far.argmin(axis=1)  # the planned one moves least
    rows = np.arange(len(poses))
    return q_near + turns[rows, branch], np.isfinite(far[rows, branch])


def _normal(rng: np.random.Generator, cov: Floats, shape: tuple[int, ...]) -> Floats:
    """Normal vectors (..., 3) of a covariance (3, 3), which may be singular."""
    values, axes = np.linalg.eigh(cov)  # no Cholesky: it may be singular
    return np.asarray(rng.normal(size=(*shape, 3)) * np.sqrt(np.maximum(values, 0.0)) @ axes.T)
