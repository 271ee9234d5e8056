"""The joint estimate of a stereo session: one least-squares problem over all images, and the bound of any estimate.

Unknown are both cameras, where C lies in the base, the errors of arm and rod (26, `rod_poses`), the head's pose, its
markers, and the ball at every stay. Known are the ball and marker pixels, the measuring arm's readings, the markers in
the image, what the arm was commanded, and how far each of these may be off, as the case declares it. Each residual is
divided by its standard deviation, so the normal matrix is Fisher's information and its inverse the Cramer-Rao bound
(van Trees' for what has a declared deviation). That is counted in deviations, so that one of 0 fixes it.

The chain of the paper calibrates, triangulates and maps one after the other, and each step forgets what the others
know: the servo's own images also see the cameras, the arm's commands also see the ball. Here all of it is adjusted
together. With normal errors and small curvature that attains the Cramer-Rao bound, which is the same normal matrix
taken at the truth.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import FREE_D, PARAMETERS, erring_arm
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose, rotated_about
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, coefficient_slope
from puncture_twin.twin.guidance.stereo.declared_errors import ServoErrors
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ball_jacobian, turn_and_shift_slopes

PER_CAMERA = 13
"""Focal length, principal point, four of the lens, turn, shift: square pixels are known."""

FLOOR_MM = 1e-3
"""mm: no standard deviation is taken to be less."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Measurements; n markers, s stays of the arm of which the first k were also read by the measuring arm.

    Attributes:
        q_command: Shape (s, 6), rad.
        pixels: Shape (c, s, 2): the ball in each camera.
        pixel_covariance: Shape (c, s, 2, 2), px^2.
        measured_c: Shape (k, 3), mm.
        marker_pixels: Shape (c, n, 2).
        marker_covariance: Shape (c, n, 2, 2), px^2.
        markers_m: Shape (n, 3), mm: the markers in the image.
    """

    planned: tuple[Camera, ...]
    rod: CarriedRod
    errors: ServoErrors
    q_command: Floats
    pixels: Floats
    pixel_covariance: Floats
    measured_c: Floats
    marker_pixels: Floats
    marker_covariance: Floats
    markers_m: Floats


class Guess(NamedTuple):
    """Start of the adjustment; C, mm."""

    T_c_base: Floats
    """Shape (4, 4): counted from here."""
    T_c_m: Floats
    """Shape (4, 4): counted from here."""
    balls_c: Floats
    """Shape (s, 3)."""


class Unknowns(NamedTuple):
    """The unknowns of the session."""

    cameras: Floats
    """Shape (c, 13), in declared deviations."""
    base: Floats
    """Shape (6,): turn (rad) about the first balls' middle and shift (mm) of the base from the guess."""
    arm: Floats
    """Shape (26,), in declared deviations."""
    head: Floats
    """Shape (6,): likewise of the head, about the markers' middle."""
    markers_m: Floats
    """Shape (n, 3), mm."""
    balls_c: Floats
    """Shape (s, 3), mm."""

    def vector(self) -> Floats:
        """All unknowns as one vector, shape (N,)."""
        return np.concatenate([np.ravel(part) for part in self])

    def moved(self, step: Floats) -> Unknowns:
        """The unknowns with a step (N,) added."""
        ends = np.cumsum([part.size for part in self])[:-1]
        parts = np.split(self.vector() + step, ends)
        return Unknowns(*(new.reshape(old.shape) for new, old in zip(parts, self, strict=True)))

    def span(self, name: str) -> slice:
        """Slice of a part in the vector."""
        sizes = [part.size for part in self]
        at = self._fields.index(name)
        return slice(sum(sizes[:at]), sum(sizes[: at + 1]))


def first_unknowns(observed: Observed, guess: Guess) -> Unknowns:
    """The unknowns with all errors 0."""
    cameras = np.zeros((len(observed.planned), PER_CAMERA))
    return Unknowns(cameras, np.zeros(6), np.zeros(N_ROD), np.zeros(6), observed.markers_m.copy(), guess.balls_c.copy())


def camera_of(planned: Camera, errors: Floats) -> Camera:
    """A planned camera with its errors (13,): part of the focal length, px, lens, rad, mm."""
    focal = planned.fx * (1.0 + errors[0])
    T = pose(exp_rotation(errors[7:10]), errors[10:13])
    return replace(
        planned,
        fx=focal,
        fy=focal,
        cx=planned.cx + float(errors[1]),
        cy=planned.cy + float(errors[2]),
        distortion=planned.distortion + errors[3:7],
        T_camera_c=T @ planned.T_camera_c,
    )


@dataclass(frozen=True, eq=False)
class JointModel:
    """The problem, to be linearised anywhere.

    Attributes:
        guess: Where poses are counted from.
    """

    observed: Observed
    guess: Guess

    @property
    def _base_center(self) -> Floats:
        return np.asarray(self.guess.balls_c[: len(self.observed.measured_c)].mean(axis=0))

    @property
    def _head_center(self) -> Floats:
        return apply(self.guess.T_c_m, self.observed.markers_m.mean(axis=0))

    def pose_of_head(self, x: Unknowns) -> Floats:
        """T_c_m, shape (4, 4), mm."""
        return rotated_about(self.guess.T_c_m, self._head_center, x.head)

    def head_slopes(self, x: Unknowns, points_c: Floats) -> Floats:
        """Derivative (n, 3, 6) of points (n, 3) of the head by ``x.head``."""
        return _pose_slopes(points_c, self._head_center, x.head[:3], x.head[3:])

    def pose_of_base(self, x: Unknowns) -> Floats:
        """T_c_base, shape (4, 4), mm."""
        return rotated_about(self.guess.T_c_base, self._base_center, x.base)

    def base_slopes(self, x: Unknowns, points_c: Floats) -> Floats:
        """Derivative (n, 3, 6) of points (n, 3) of the base by ``x.base``."""
        return _pose_slopes(points_c, self._base_center, x.base[:3], x.base[3:])

    def rod_at(self, x: Unknowns, q: Floats) -> RodPoses:
        """Ball and flange at configurations (s, 6), rad, base frame."""
        return rod_poses(self.observed.rod, self.observed.errors.arm_deviations() * x.arm, q)

    def linearised(self, x: Unknowns) -> System[Unknowns]:
        """Residuals and slopes at x."""
        rows = [*self._seen(x), self._measured(x), self._commanded(x), self._imaged(x), self._drawn(x)]
        return System(np.concatenate([r for r, _ in rows]), np.concatenate([J for _, J in rows]))

    def _seen(self, x: Unknowns) -> list[tuple[Floats, Floats]]:
        """Rows of the ball and marker pixels of each camera."""
        o, T_c_m = self.observed, self.pose_of_head(x)
        markers_c = apply(T_c_m, x.markers_m)
        points = np.concatenate([x.balls_c, markers_c])
        pixels = np.concatenate([o.pixels, o.marker_pixels], axis=1)
        roots = _roots(np.concatenate([o.pixel_covariance, o.marker_covariance], axis=1))
        n_balls, rows, deviations = len(x.balls_c), [], o.errors.camera_deviations()
        for index, planned in enumerate(o.planned):
            errors = deviations * x.cameras[index]
            camera = camera_of(planned, errors)
            J = np.zeros((len(points), 2, x.vector().size))
            start = x.span("cameras").start + PER_CAMERA * index
            J[:, :, start : start + PER_CAMERA] = _camera_slopes(planned, camera, errors, points) * deviations
            by_point = camera.jacobian(points)
            _diagonal(J, 0, x.span("balls_c").start, by_point[:n_balls])
            J[n_balls:, :, x.span("head")] = by_point[n_balls:] @ self.head_slopes(x, markers_c)  # chain rule
            _diagonal(J, n_balls, x.span("markers_m").start, by_point[n_balls:] @ T_c_m[:3, :3])
            missed = camera.project(points) - pixels[index]
            rows.append(_whitened(missed, J, roots[index]))
        return rows

    def _measured(self, x: Unknowns) -> tuple[Floats, Floats]:
        """Rows of the measuring arm's readings."""
        k, sigma = len(self.observed.measured_c), max(self.observed.errors.measuring_arm_mm, FLOOR_MM)
        J = np.zeros((k, 3, x.vector().size))
        _diagonal(J, 0, x.span("balls_c").start, np.tile(np.eye(3), (k, 1, 1)))
        roots = np.tile(np.eye(3) / sigma, (k, 1, 1))
        return _whitened(x.balls_c[:k] - self.observed.measured_c, J, roots)

    def _commanded(self, x: Unknowns) -> tuple[Floats, Floats]:
        """The commanded ball: the arm, with its errors, play and repeatability, against the ball's place."""
        q = self.observed.q_command
        missed, J = self.ball_deviations(x, np.arange(len(q)))
        return _whitened(missed, J, self._offset_roots)

    def ball_deviations(self, x: Unknowns, stays: Ints) -> tuple[Floats, Floats]:
        """Deviation of the ball from its arm's prediction at k stays: (k, 3), mm, C, and slopes (k, 3, N)."""
        T, rod = self.pose_of_base(x), self.rod_at(x, self.observed.q_command[stays])
        measured = apply(T, rod.ball)
        J = np.zeros((len(measured), 3, x.vector().size))
        for row, stay in enumerate(stays):
            start = x.span("balls_c").start + 3 * int(stay)
            J[row, :, start : start + 3] = np.eye(3)
        J[:, :, x.span("base")] = -self.base_slopes(x, measured)  # ball minus where base and arm have it
        J[:, :, x.span("arm")] = -T[:3, :3] @ rod.slopes[:, :3] * self.observed.errors.arm_deviations()
        return x.balls_c[stays] - measured, J

    @cached_property
    def _offset_roots(self) -> Floats:
        """Roots of the inverse covariance of where the arm has its ball, (s, 3, 3): play and repeatability."""
        o, R = self.observed, self.guess.T_c_base[:3, :3]
        slopes = np.array([R @ ball_jacobian(o.rod, q)[:3] for q in o.q_command])
        return _roots(o.errors.arrival**2 * slopes @ slopes.transpose(0, 2, 1) + FLOOR_MM**2 * np.eye(3))

    def _imaged(self, x: Unknowns) -> tuple[Floats, Floats]:
        """Rows of the markers in the image."""
        n, sigma = len(x.markers_m), max(self.observed.errors.marker_mm, FLOOR_MM)
        J = np.zeros((n, 3, x.vector().size))
        _diagonal(J, 0, x.span("markers_m").start, np.tile(np.eye(3), (n, 1, 1)))
        return _whitened(x.markers_m - self.observed.markers_m, J, np.tile(np.eye(3) / sigma, (n, 1, 1)))

    def _drawn(self, x: Unknowns) -> tuple[Floats, Floats]:
        """Rows of the unknowns with a declared deviation from their nominal value."""
        J = np.eye(x.vector().size)
        drawn = np.r_[x.span("cameras"), x.span("arm")]
        return x.vector()[drawn], J[drawn]  # counted in deviations: the prior's residual is the unknown itself


def _camera_slopes(planned: Camera, camera: Camera, errors: Floats, points: Floats) -> Floats:
    """Derivative (n, 2, 13) of pixels by a camera's errors."""
    J = np.zeros((len(points), 2, PER_CAMERA))
    pixels, by_point = camera.project(points), camera.jacobian(points)
    inside = apply(camera.T_camera_c, points)
    flat = inside[:, :2] / inside[:, 2:]
    J[:, :, 0] = (pixels - [camera.cx, camera.cy]) * (planned.fx / camera.fx)
    J[:, :, 1:3] = np.eye(2)
    J[:, :, 3:7] = camera.fx * coefficient_slope(flat)
    by_inside = by_point @ camera.T_camera_c[:3, :3].T
    J[:, :, 7:] = by_inside @ _pose_slopes(inside, np.zeros(3), errors[7:10], errors[10:13])
    return J


def _pose_slopes(points: Floats, center: Floats, turn: Floats, shift: Floats) -> Floats:
    """Derivative (n, 3, 6) of moved points (n, 3) by the rotation about a centre and the shift."""
    slopes = turn_and_shift_slopes(points - center - shift)
    x, y, z = turn
    left = np.eye(3) + 0.5 * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # to second order in the turn
    slopes[:, :, :3] = slopes[:, :, :3] @ left
    return slopes


def _diagonal(J: Floats, row: int, column: int, blocks: Floats) -> None:
    """Put blocks (n, r, 3) on the diagonal that starts at a row (of J's first axis) and a column."""
    for i, block in enumerate(blocks):
        J[row + i, :, column + 3 * i : column + 3 * i + 3] = block


def _roots(covariance: Floats) -> Floats:
    """W with W^T W the inverse of each covariance (..., d, d)."""
    return np.asarray(np.linalg.inv(np.linalg.cholesky(covariance)))


def _whitened(missed: Floats, J: Floats, roots: Floats) -> tuple[Floats, Floats]:
    """Rows of the system from misses (n, d), slopes (n, d, N) and roots (n, d, d)."""
    return np.einsum("nij,nj->ni", roots, missed).ravel(), (roots @ J).reshape(-1, J.shape[-1])


MAX_ITERATIONS = 30
ARRIVED = 1e-4
"""A step of the adjustment whose every residual changes by less than this standard deviation has arrived."""

UNSETTLED = "the joint adjustment does not settle: a measurement is an outlier, or the cameras see too little"


class Offset(NamedTuple):
    """Target minus ball, what the servo takes to zero; C."""

    ball_c: Floats
    """Shape (3,), mm."""
    target_c: Floats
    """Shape (3,), mm."""
    ball_covariance: Floats
    """Shape (3, 3), mm^2."""
    target_covariance: Floats
    """Shape (3, 3), mm^2."""
    covariance: Floats
    """Shape (3, 3), mm^2: of target minus ball; less than the sum where both err together."""

    def rms_mm(self) -> float:
        """Root of the mean squared length of the error of target minus ball, mm."""
        return float(np.sqrt(np.trace(self.covariance)))


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The joint estimate.

    Attributes:
        covariance: Shape (N, N): of the unknowns, by Fisher's information.
        chi2: Sum of the squared residuals.
        freedom: Their number, less that of the unknowns: what chi2 is on average if the declaration holds.
    """

    model: JointModel
    unknowns: Unknowns
    covariance: Floats
    chi2: float
    freedom: int
    iterations: int

    def offset(self, stay: int, target_m: Floats) -> Offset:
        """Ball at one stay and a target of the image, with their covariances.

        Args:
            stay: Which of the stays; -1 is the last.
            target_m: Shape (3,), mm.
        """
        x = self.unknowns
        stay = stay % len(x.balls_c)
        target = apply(self.model.pose_of_head(x), target_m)
        ball_rows = np.zeros((3, len(self.covariance)))
        start = x.span("balls_c").start + 3 * stay
        ball_rows[:, start : start + 3] = np.eye(3)
        target_rows = np.zeros_like(ball_rows)
        target_rows[:, x.span("head")] = self.model.head_slopes(x, target[None])[0]
        ball, aim, both = (
            rows @ self.covariance @ rows.T for rows in (ball_rows, target_rows, target_rows - ball_rows)
        )
        return Offset(x.balls_c[stay], target, ball, aim, both)


def adjust(observed: Observed, guess: Guess, start: Unknowns | None = None) -> Adjusted:
    """The joint estimate of everything, by Gauss-Newton.

    Args:
        guess: Where poses are counted from; within a few degrees and centimetres.
        start: Unknowns to start from; all errors 0 when None.

    Raises:
        NoAnswerError: It does not settle: some measurement is grossly wrong.
    """
    model = JointModel(observed, guess)
    x = first_unknowns(observed, guess) if start is None else start
    try:
        fit = gauss_newton(x, model.linearised, Unknowns.moved, _arrived, MAX_ITERATIONS)
    except (InputError, np.linalg.LinAlgError, ValueError) as error:  # a camera that cannot be, or what is no number
        raise NoAnswerError(UNSETTLED, code="not_settled") from error
    if not (fit.settled and fit.determined):
        raise NoAnswerError(UNSETTLED, code="not_settled")
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    chi2 = float(np.sum((fit.system.residuals + fit.system.slopes @ fit.step) ** 2))  # after the last step
    return Adjusted(model, fit.estimate, covariance, chi2, _freedom(fit.system), fit.iterations)


def _freedom(system: System[Unknowns]) -> int:
    rows, unknowns = system.slopes.shape
    return rows - unknowns


def _arrived(system: System[Unknowns], step: Floats) -> bool:
    return bool(np.abs(system.slopes @ step).max() < ARRIVED)


FLANGE_ERRORS = PARAMETERS["joint"].stop
"""How many of these move the flange: 23."""

N_ROD = PARAMETERS["tip_offset"].stop
"""a1..a6, d1, d3..d6, alpha1..alpha6, six zeros of the joints, the ball on the flange: what moves the ball."""


class RodPoses(NamedTuple):
    """Ball and flange of an arm that errs, base frame."""

    ball: Floats
    """Shape (s, 3), mm."""
    slopes: Floats
    """Shape (s, 6, 26): shift of the ball (mm) and turn of the flange (rad) per unit of each parameter's error."""
    R_base_flange: Floats
    """Shape (s, 3, 3)."""


def rod_poses(rod: CarriedRod, eta: Floats, q: Floats) -> RodPoses:
    """Ball and flange at configurations (s, 6), rad, of an arm with errors (26,), mm and rad.

    Each error shifts or turns all that follows it (Mooring, Roth, Driels 1991; `error_jacobian`).
    """
    poses = erring_arm(rod.model, eta[:FLANGE_ERRORS]).link_poses(q)
    origins, axes = poses[..., :3, 3], poses[..., :3, :3]
    R = axes[:, 6]
    ball = origins[:, 6] + R @ (eta[FLANGE_ERRORS:] + np.array([0.0, 0.0, rod.rod_mm]))
    x, z = axes[:, 1:, :, 0], axes[:, :-1, :, 2]  # x behind each joint, z before it
    twist = np.cross(x, ball[:, None] - origins[:, 1:])
    zero = np.cross(z, ball[:, None] - origins[:, :-1])
    slopes = np.zeros((len(q), 6, N_ROD))
    slopes[:, :3] = np.concatenate([x, z[:, list(FREE_D)], twist, zero, R.swapaxes(1, 2)], axis=1).swapaxes(1, 2)
    slopes[:, 3:, PARAMETERS["twist"]] = x.swapaxes(1, 2)
    slopes[:, 3:, PARAMETERS["joint"]] = z.swapaxes(1, 2)
    return RodPoses(ball, slopes, R)
