"""The joint estimate of a stereo session: one least-squares problem over all images, and the needle's error by it.

Unknown are both cameras, where C lies in the base, the errors of arm and rod (26, `rod_poses`), the head's pose, its
markers, and the ball at every stay. Known are the ball and marker pixels, the measuring arm's readings, the markers in
the image, what the arm was commanded, and how far each of these may be off, as the case declares it. Each residual is
divided by its standard deviation, so the normal matrix is Fisher's information and its inverse the Cramer-Rao bound
(van Trees' for what has a declared deviation). That is counted in deviations, so that one of 0 fixes it.

The chain of the paper calibrates, triangulates and maps one after the other, and each step forgets what the others
know: the servo's own images also see the cameras, the arm's commands also see the ball. Here all of it is adjusted
together. With normal errors and small curvature that attains the Cramer-Rao bound, which is the same normal matrix
taken at the truth.

The needle's error against the anatomy: with F the information matrix, d the tip minus the target and phi the needle's
rotation, both in the image's axes at the target, every row of E says what an unknown does to them:

    Sigma6 = E F^-1 E' + arrival + R_m_flange diag(tip_offset^2, needle_direction^2) R' + what the head moved since

Before the servo the ball's rows are those of base and arm, and the arrival is new: J Jq Sigma_q Jq' J'. After it they
are those of the ball at the last image, so that the arm drops out of d; phi stays the arm's, but for what the last
image says of this arrival: with r the ball's deviation from where the arm should have it, the joints missed by

    eps | r ~ N(K r, Sigma_q - K Jq Sigma_q),   K = Sigma_q Jq' (Jq Sigma_q Jq')^-1
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.arm.kinematics import FREE_D, PARAMETERS, erring_arm
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError, NoAnswerError
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose, rotated_about
from puncture_twin.planning.uncertainty.hit import hit_in_mesh, rays_to_ball
from puncture_twin.twin.guidance.stereo.camera import Camera, coefficient_slope
from puncture_twin.twin.guidance.stereo.servo_case import ServoErrors
from puncture_twin.twin.guidance.stereo.servo_law import CarriedRod, ball_jacobian, turn_and_shift_slopes

Part = Literal["base", "head"]
PER_CAMERA = 13
"""Focal length, principal point, four of the lens, turn, shift: square pixels are known."""
FLOOR_MM = 1e-3
"""mm: no standard deviation is taken to be less."""


@dataclass(frozen=True, eq=False)
class Observed:
    """Measurements; n markers, s stays of the arm of which the first k were also read by the measuring arm."""

    planned: tuple[Camera, ...]
    rod: CarriedRod
    errors: ServoErrors
    q_command: Floats  # shape (s, 6), rad
    pixels: Floats  # shape (c, s, 2), where cameras saw the ball
    pixel_covariance: Floats  # shape (c, s, 2, 2), px^2
    measured_c: Floats  # shape (k, 3), mm
    marker_pixels: Floats  # shape (c, n, 2)
    marker_covariance: Floats  # shape (c, n, 2, 2), px^2
    markers_m: Floats  # shape (n, 3), mm, in the image


class Guess(NamedTuple):
    """Start of the adjustment: T_c_base and T_c_m (4, 4), from which poses are counted, and the balls (s, 3); C, mm."""

    T_c_base: Floats
    T_c_m: Floats
    balls_c: Floats  # shape (s, 3)


class Unknowns(NamedTuple):
    """The unknowns of the session; a pose is a turn (rad) about a point and a shift (mm) from the guess."""

    cameras: Floats  # shape (c, 13), in declared deviations
    base: Floats  # shape (6,), about the first balls' middle
    arm: Floats  # shape (26,), in declared deviations
    head: Floats  # shape (6,), about the markers' middle
    markers_m: Floats  # shape (n, 3), mm
    balls_c: Floats  # shape (s, 3), mm

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
    focal, lens = planned.fx * (1.0 + errors[0]), planned.distortion + errors[3:7]
    cx, cy = planned.cx + float(errors[1]), planned.cy + float(errors[2])
    T = pose(exp_rotation(errors[7:10]), errors[10:13]) @ planned.T_camera_c
    return replace(planned, fx=focal, fy=focal, cx=cx, cy=cy, distortion=lens, T_camera_c=T)


@dataclass(frozen=True, eq=False)
class JointModel:
    """The problem, to be linearised anywhere; poses are counted from the guess."""

    observed: Observed
    guess: Guess

    def _guessed(self, part: Part) -> tuple[Floats, Floats]:
        """Pose of base or head in C, as guessed, and the point (3,) that it turns about."""
        guess, observed = self.guess, self.observed
        if part == "base":
            return guess.T_c_base, np.asarray(guess.balls_c[: len(observed.measured_c)].mean(axis=0))
        return guess.T_c_m, apply(guess.T_c_m, observed.markers_m.mean(axis=0))

    def pose_of(self, part: Part, x: Unknowns) -> Floats:
        """T_c_base or T_c_m, shape (4, 4), mm."""
        return rotated_about(*self._guessed(part), getattr(x, part))

    def slopes_of(self, part: Part, x: Unknowns, points_c: Floats) -> Floats:
        """Derivative (n, 3, 6) of points (n, 3) of base or head by its part of the unknowns."""
        return _pose_slopes(points_c, self._guessed(part)[1], *np.split(getattr(x, part), 2))

    def rod_at(self, x: Unknowns, q: Floats) -> RodPoses:
        """Ball and flange at configurations (s, 6), rad, base frame."""
        return rod_poses(self.observed.rod, self.observed.errors.arm_deviations() * x.arm, q)

    def linearised(self, x: Unknowns) -> System[Unknowns]:
        """Residuals and slopes at x."""
        o = self.observed
        drawn = np.r_[x.span("cameras"), x.span("arm")]  # in deviations: the prior's residual is the unknown itself
        rows = [
            *self._seen(x),
            self._read(x, "balls_c", o.measured_c, o.errors.measuring_arm_mm),
            _whitened(*self.ball_deviations(x, np.arange(len(o.q_command))), self._offset_roots),
            self._read(x, "markers_m", o.markers_m, o.errors.marker_mm),
            (x.vector()[drawn], np.eye(x.vector().size)[drawn]),
        ]
        return System(np.concatenate([r for r, _ in rows]), np.concatenate([J for _, J in rows]))

    def _seen(self, x: Unknowns) -> list[tuple[Floats, Floats]]:
        o, T_c_m = self.observed, self.pose_of("head", x)
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
            J[n_balls:, :, x.span("head")] = by_point[n_balls:] @ self.slopes_of("head", x, markers_c)  # chain rule
            _diagonal(J, n_balls, x.span("markers_m").start, by_point[n_balls:] @ T_c_m[:3, :3])
            missed = camera.project(points) - pixels[index]
            rows.append(_whitened(missed, J, roots[index]))
        return rows

    def _read(self, x: Unknowns, part: str, read: Floats, sigma_mm: float) -> tuple[Floats, Floats]:
        """Rows of points (k, 3), mm, that were read: the first of a part of the unknowns."""
        k = len(read)
        J = np.zeros((k, 3, x.vector().size))
        _diagonal(J, 0, x.span(part).start, np.tile(np.eye(3), (k, 1, 1)))
        roots = np.tile(np.eye(3) / max(sigma_mm, FLOOR_MM), (k, 1, 1))
        return _whitened(getattr(x, part)[:k] - read, J, roots)

    def ball_deviations(self, x: Unknowns, stays: Ints) -> tuple[Floats, Floats]:
        """Deviation of the ball from its arm's prediction at k stays: (k, 3), mm, C, and slopes (k, 3, N)."""
        T, rod = self.pose_of("base", x), self.rod_at(x, self.observed.q_command[stays])
        measured = apply(T, rod.ball)
        J = np.zeros((len(measured), 3, x.vector().size))
        for row, stay in enumerate(stays):
            start = x.span("balls_c").start + 3 * int(stay)
            J[row, :, start : start + 3] = np.eye(3)
        J[:, :, x.span("base")] = -self.slopes_of("base", x, measured)  # ball minus where base and arm have it
        J[:, :, x.span("arm")] = -T[:3, :3] @ rod.slopes[:, :3] * self.observed.errors.arm_deviations()
        return x.balls_c[stays] - measured, J

    @cached_property
    def _offset_roots(self) -> Floats:
        """Roots of the inverse covariance of where the arm has its ball, (s, 3, 3): play and repeatability."""
        o, R = self.observed, self.guess.T_c_base[:3, :3]
        slopes = np.array([R @ ball_jacobian(o.rod, q)[:3] for q in o.q_command])
        return _roots(o.errors.arrival**2 * slopes @ slopes.transpose(0, 2, 1) + FLOOR_MM**2 * np.eye(3))


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
    """Target minus ball, what the servo takes to zero: both (3,), mm, C, with their covariances (3, 3), mm^2."""

    ball_c: Floats  # shape (3,), mm
    target_c: Floats  # shape (3,), mm
    ball_covariance: Floats  # shape (3, 3), mm^2
    target_covariance: Floats  # shape (3, 3), mm^2
    covariance: Floats  # of target minus ball; less than the sum where both err together


@dataclass(frozen=True, eq=False)
class Adjusted:
    """The joint estimate."""

    model: JointModel
    unknowns: Unknowns
    covariance: Floats  # shape (N, N), of the unknowns by Fisher's information
    chi2: float  # sum of the squared residuals
    freedom: int  # their number, less that of the unknowns

    def offset(self, stay: int, target_m: Floats) -> Offset:
        """Ball at one stay, -1 the last, and a target (3,), mm, of the image, with their covariances."""
        x, model = self.unknowns, self.model
        stay = stay % len(x.balls_c)
        target = apply(model.pose_of("head", x), target_m)
        ball_rows, target_rows = np.zeros((2, 3, len(self.covariance)))
        start = x.span("balls_c").start + 3 * stay
        ball_rows[:, start : start + 3] = np.eye(3)
        target_rows[:, x.span("head")] = model.slopes_of("head", x, target[None])[0]
        every = ball_rows, target_rows, target_rows - ball_rows
        ball, aim, both = (rows @ self.covariance @ rows.T for rows in every)
        return Offset(x.balls_c[stay], target, ball, aim, both)


def adjust(observed: Observed, guess: Guess, start: Unknowns | None = None) -> Adjusted:
    """The joint estimate of everything, by Gauss-Newton; the guess is within a few degrees and centimetres.

    Raises:
        NoAnswerError: It does not settle: some measurement is grossly wrong.
    """

    def arrived(system: System[Unknowns], step: Floats) -> bool:
        return bool(np.abs(system.slopes @ step).max() < ARRIVED)

    model = JointModel(observed, guess)
    x = first_unknowns(observed, guess) if start is None else start
    try:
        fit = gauss_newton(x, model.linearised, Unknowns.moved, arrived, MAX_ITERATIONS)
    except (InputError, np.linalg.LinAlgError, ValueError) as error:  # a camera that cannot be, or what is no number
        raise NoAnswerError(UNSETTLED, code="not_settled") from error
    if not (fit.settled and fit.determined):
        raise NoAnswerError(UNSETTLED, code="not_settled")
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    chi2 = float(np.sum((fit.system.residuals + fit.system.slopes @ fit.step) ** 2))  # after the last step
    rows, unknowns = fit.system.slopes.shape
    return Adjusted(model, fit.estimate, covariance, chi2, rows - unknowns)


FLANGE_ERRORS = PARAMETERS["joint"].stop
"""How many of these move the flange: 23."""
N_ROD = PARAMETERS["tip_offset"].stop
"""a1..a6, d1, d3..d6, alpha1..alpha6, six zeros of the joints, the ball on the flange: what moves the ball."""


class RodPoses(NamedTuple):
    """Ball and flange of an arm that errs at s configurations, base frame."""

    ball: Floats  # shape (s, 3), mm
    slopes: Floats  # shape (s, 6, 26): shift of the ball (mm) and turn of the flange (rad) by each parameter's error
    R_base_flange: Floats  # shape (s, 3, 3)


def rod_poses(rod: CarriedRod, eta: Floats, q: Floats) -> RodPoses:
    """Ball and flange at joints (s, 6), rad, of an arm with errors (26,), mm and rad (Mooring, Roth, Driels 1991)."""
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


REGION = 0.95
"""Chance of the reported ellipsoid."""


@dataclass(frozen=True, eq=False)
class NeedleError:
    """Predicted error of a needle in place, image axes."""

    offset_m: Floats  # shape (3,), mm: the tip as believed, minus the target: what a tolerance or a wrong arm leaves
    R_m_needle: Floats  # shape (3, 3): the needle's axes as believed, as columns, z to the tip
    covariance: Floats  # shape (6, 6), about that: shift (mm) of the tip against the anatomy, then rotation (rad)
    target_covariance: Floats  # shape (3, 3), mm^2, of the reading of the target

    def __post_init__(self) -> None:
        for field in fields(self):
            getattr(self, field.name).setflags(write=False)

    @property
    def tip_covariance(self) -> Floats:
        """Covariance of the tip about the intended point, its reading included, shape (3, 3), mm^2."""
        return np.asarray(self.covariance[:3, :3] + self.target_covariance)

    @property
    def rms_mm(self) -> float:
        """Expected (rms) distance of the tip from the intended point, mm."""
        return float(np.sqrt(self.offset_m @ self.offset_m + np.trace(self.tip_covariance)))

    @property
    def direction_rms(self) -> float:
        """Expected (rms) angle between the needle and where it is believed to point, rad."""
        across = self.R_m_needle[:, :2]
        return float(np.sqrt(np.trace(across.T @ self.covariance[3:, 3:] @ across)))

    @property
    def half_axes_mm(self) -> Floats:
        """Half axes of the tip's 95 % ellipsoid about `offset_m`, shape (3,), mm, longest first."""
        return np.asarray(np.sqrt(chdtri(3, 1 - REGION) * np.linalg.eigvalsh(self.tip_covariance)[::-1]))

    @property
    def depth_mm(self) -> float:
        """Standard deviation of the tip along the needle, mm."""
        return float(np.sqrt(self.R_m_needle[:, 2] @ self.tip_covariance @ self.R_m_needle[:, 2]))

    @property
    def lateral_mm(self) -> float:
        """Root of the tip's variance across the needle, mm."""
        return float(np.sqrt(max(np.trace(self.tip_covariance) - self.depth_mm**2, 0.0)))

    def p_hit(self, radius_mm: float) -> float:
        """The chance that the tip is within a radius of the target."""
        return float(hit_in_mesh(rays_to_ball(self.offset_m, radius_mm), self.tip_covariance[None])[0])


def servoed_error(adjusted: Adjusted, stay: int, target_m: Floats) -> NeedleError:
    """The needle's error after an image of the ball at a stay, -1 the last; target (3,), mm, as the image has it."""
    model, x = adjusted.model, adjusted.unknowns
    stay = stay % len(x.balls_c)
    miss, slopes = model.ball_deviations(x, np.array([stay]))
    rod = _Flange.of(adjusted, model.observed.q_command[stay])
    variance, Jq = model.observed.errors.arrival**2, rod.arrival_slopes
    K = variance * Jq[:3].T @ np.linalg.inv(variance * Jq[:3] @ Jq[:3].T + FLOOR_MM**2 * np.eye(3))
    rows = np.zeros((6, len(adjusted.covariance)))
    start = x.span("balls_c").start + 3 * stay
    rows[:3, start : start + 3] = np.eye(3)  # the tip follows the ball that was seen
    rows[3:] = rod.rows[3:] + Jq[3:] @ K @ slopes[0]
    again = np.zeros((6, 6))
    again[3:, 3:] = Jq[3:] @ (variance * (np.eye(6) - K @ Jq[:3])) @ Jq[3:].T  # of this arrival, given r
    R_c_flange = exp_rotation(Jq[3:] @ K @ miss[0]) @ rod.R_c_flange  # by its mean, K r
    return _needle(adjusted, target_m, x.balls_c[stay], R_c_flange, rows, again)


def open_loop_error(adjusted: Adjusted, q_command: Floats, target_m: Floats) -> NeedleError:
    """The needle's error where the arm is sent to joints (6,), rad, without an image; target (3,), mm, in the image."""
    rod = _Flange.of(adjusted, q_command)
    Jq = rod.arrival_slopes
    arrival = adjusted.model.observed.errors.arrival**2 * Jq @ Jq.T
    return _needle(adjusted, target_m, rod.ball_c, rod.R_c_flange, rod.rows, arrival)


class _Flange(NamedTuple):
    """Predicted ball and flange of the arm, C, and what shifts the one and rotates the other."""

    ball_c: Floats  # shape (3,), mm
    R_c_flange: Floats  # shape (3, 3)
    rows: Floats  # shape (6, N), by the unknowns
    arrival_slopes: Floats  # shape (6, 6), per rad of each joint

    @classmethod
    def of(cls, adjusted: Adjusted, q_command: Floats) -> _Flange:
        model, x = adjusted.model, adjusted.unknowns
        T, one = model.pose_of("base", x), model.rod_at(x, q_command[None])
        turn = np.kron(np.eye(2), T[:3, :3])
        ball = apply(T, one.ball)
        rows = np.zeros((6, len(adjusted.covariance)))
        rows[:3, x.span("base")] = model.slopes_of("base", x, ball)[0]
        rows[3:, x.span("base")] = _turn_rows(x.base)
        J = turn @ one.slopes[0]
        rows[:, x.span("arm")] = J * model.observed.errors.arm_deviations()
        return cls(ball[0], T[:3, :3] @ one.R_base_flange[0], rows, J[:, PARAMETERS["joint"]])


def _needle(
    adjusted: Adjusted, target_m: Floats, ball_c: Floats, R_c_flange: Floats, rows: Floats, again: Floats
) -> NeedleError:
    """The needle against a target (3,), mm.

    ``rows`` (6, N): what shifts its ball and rotates its flange, C; ``again`` (6, 6): what errs besides the unknowns.
    """
    model, x, errors = adjusted.model, adjusted.unknowns, adjusted.model.observed.errors
    T_c_m, of_target, moved = model.pose_of("head", x), np.zeros_like(rows), np.zeros((6, 6))
    of_target[:3, x.span("head")] = model.slopes_of("head", x, apply(T_c_m, target_m[None]))[0]
    of_target[3:, x.span("head")] = _turn_rows(x.head)
    rows = rows - of_target  # tip minus target
    rotated, turn = np.kron(np.eye(2), R_c_flange), np.kron(np.eye(2), T_c_m[:3, :3])
    tool = np.repeat([errors.tip_offset_mm, errors.needle_direction, 0.0], [3, 2, 1]) ** 2  # no roll
    cov_c = rows @ adjusted.covariance @ rows.T + again + (rotated * tool) @ rotated.T
    moved[:3], moved[3:, :3] = turn_and_shift_slopes((target_m - x.markers_m.mean(axis=0))[None])[0], np.eye(3)
    head = np.repeat([errors.head_turn, errors.head_shift_mm], 3) ** 2  # since its markers were seen, about these
    covariance = turn.T @ cov_c @ turn + (moved * head) @ moved.T
    offset, R_m_needle = T_c_m[:3, :3].T @ (ball_c - apply(T_c_m, target_m)), T_c_m[:3, :3].T @ R_c_flange
    return NeedleError(offset, R_m_needle, covariance, errors.target_mm**2 * np.eye(3))


def _turn_rows(change: Floats) -> Floats:
    """Rotation of a pose by the rotation and shift (6,) of `rotated_about`, shape (3, 6)."""
    return np.concatenate([left_jacobian(change[:3]), np.zeros((3, 3))], axis=1)
