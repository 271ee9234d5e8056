"""Everything that was measured in a session, as one least-squares problem: the bundle adjustment over all images.

Unknown are both cameras, where C lies in the base, the arm's errors, where the head stands, its markers, and the ball
at every stay. Known are the ball and marker pixels, the measuring arm's readings, the markers in the image, what the
arm was commanded, and how far each of these and the drawn errors may be off. Each residual is divided by its standard
deviation, so the normal matrix is Fisher's information and its inverse the Cramer-Rao bound (van Trees' for the drawn
ones). What has a known spread is counted in that spread, so that a spread of 0 fixes it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import System
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose, turned_about
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera
from puncture_twin.twin.guidance.stereo.cameras.lens import coefficient_slope
from puncture_twin.twin.guidance.stereo.mapping import turn_and_shift_slopes
from puncture_twin.twin.guidance.stereo.servo_law import HeldRod, ball_jacobian
from puncture_twin.twin.guidance.stereo.stereo_room import (
    CAMERA_AXIS_PX,
    CAMERA_FOCAL,
    CAMERA_SHIFT_MM,
    CAMERA_TURN_RAD,
)
from puncture_twin.twin.plant.true_arm import ArmErrors, TrueArm

LENS = (0.2, 0.2, 0.002, 0.002)
"""Spread of k1, k2, p1, p2 about 0: what a lens of this kind may have."""

PER_CAMERA = 13
"""Focal length, principal point, four of the lens, turn, shift: square pixels are known."""

ARM = 23
"""a1..a6, d1, d3..d6, alpha1..alpha6, six zeros of the joints."""

FLOOR_MM = 1e-3
"""Nothing is known better than this."""


@dataclass(frozen=True, eq=False)
class Observed:
    """What was measured; n markers, s stays of the arm of which the first k were also measured by the measuring arm.

    Attributes:
        planned: The cameras as they were planned.
        held: The nominal arm.
        arm: Spreads of the arm's errors.
        q_command: Shape (s, 6), rad.
        pixels: Shape (c, s, 2): the ball in each camera.
        pixel_covariance: Shape (c, s, 2, 2), px^2.
        measured_c: Shape (k, 3), mm.
        measuring_mm: Standard deviation per axis of ``measured_c``.
        marker_pixels: Shape (c, n, 2).
        marker_covariance: Shape (c, n, 2, 2), px^2.
        markers_m: Shape (n, 3), mm: the markers in the image.
        image_mm: Standard deviation per axis of ``markers_m``.
    """

    planned: tuple[Camera, ...]
    held: HeldRod
    arm: ArmErrors
    q_command: Floats
    pixels: Floats
    pixel_covariance: Floats
    measured_c: Floats
    measuring_mm: float
    marker_pixels: Floats
    marker_covariance: Floats
    markers_m: Floats
    image_mm: float


class Guess(NamedTuple):
    """Where the adjustment starts; C, mm."""

    T_c_base: Floats
    """Shape (4, 4): counted from here."""
    T_c_m: Floats
    """Shape (4, 4): counted from here."""
    balls_c: Floats
    """Shape (s, 3)."""


class Unknowns(NamedTuple):
    """The unknowns of the session."""

    cameras: Floats
    """Shape (c, 13), in spreads."""
    base: Floats
    """Shape (6,): turn (rad) about the first balls' middle and shift (mm) of the base from the guess."""
    arm: Floats
    """Shape (23,), in spreads."""
    head: Floats
    """Shape (6,): likewise of the head, about the markers' middle."""
    markers_m: Floats
    """Shape (n, 3), mm."""
    balls_c: Floats
    """Shape (s, 3), mm."""

    def vector(self) -> Floats:
        """All of them, shape (N,)."""
        return np.concatenate([np.ravel(part) for part in self])

    def moved(self, step: Floats) -> Unknowns:
        """With a step (N,) added."""
        ends = np.cumsum([part.size for part in self])[:-1]
        parts = np.split(self.vector() + step, ends)
        return Unknowns(*(new.reshape(old.shape) for new, old in zip(parts, self, strict=True)))

    def span(self, name: str) -> slice:
        """Where a part stands in the vector."""
        sizes = [part.size for part in self]
        at = self._fields.index(name)
        return slice(sum(sizes[:at]), sum(sizes[: at + 1]))


def first_unknowns(observed: Observed, guess: Guess) -> Unknowns:
    """All errors 0."""
    cameras = np.zeros((len(observed.planned), PER_CAMERA))
    return Unknowns(cameras, np.zeros(6), np.zeros(ARM), np.zeros(6), observed.markers_m.copy(), guess.balls_c.copy())


def camera_of(planned: Camera, errors: Floats) -> Camera:
    """A planned camera with its errors (13,), in spreads."""
    focal = planned.fx * (1.0 + CAMERA_FOCAL * errors[0])
    cx, cy = np.array([planned.cx, planned.cy]) + CAMERA_AXIS_PX * errors[1:3]
    T = pose(exp_rotation(CAMERA_TURN_RAD * errors[7:10]), CAMERA_SHIFT_MM * errors[10:13])
    lens = np.array(LENS) * errors[3:7]
    return replace(
        planned, fx=focal, fy=focal, cx=float(cx), cy=float(cy), distortion=lens, T_camera_c=T @ planned.T_camera_c
    )


def arm_of(model: UrModel, spreads: ArmErrors, errors: Floats) -> TrueArm:
    """A nominal arm with its errors (23,), in spreads."""
    d = np.array(model.d)
    d[[0, 2, 3, 4, 5]] += spreads.link_mm * errors[6:11]
    return TrueArm(
        model,
        a=np.array(model.a) + spreads.link_mm * errors[:6],
        d=d,
        alpha=np.array(model.alpha) + spreads.twist_rad * errors[11:17],
        joint_offsets=spreads.joint_rad * errors[17:23],
        backlash_rad=spreads.backlash_rad,
        repeatability_rad=spreads.repeatability_rad,
    )


@dataclass(frozen=True, eq=False)
class JointModel:
    """The problem, to be linearised anywhere.

    Attributes:
        observed: What was measured.
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
        return turned_about(self.guess.T_c_m, self._head_center, x.head)

    def head_slopes(self, x: Unknowns, points_c: Floats) -> Floats:
        """Derivative (n, 3, 6) of points (n, 3) of the head by ``x.head``."""
        return _pose_slopes(points_c, self._head_center, x.head[:3], x.head[3:])

    def linearised(self, x: Unknowns) -> System[Unknowns]:
        """Residuals and slopes at x."""
        rows = [*self._seen(x), self._measured(x), self._commanded(x), self._imaged(x), self._drawn(x)]
        return System(np.concatenate([r for r, _ in rows]), np.concatenate([J for _, J in rows]))

    def _seen(self, x: Unknowns) -> list[tuple[Floats, Floats]]:
        """Ball and marker pixels of each camera."""
        o, T_c_m = self.observed, self.pose_of_head(x)
        markers_c = apply(T_c_m, x.markers_m)
        points = np.concatenate([x.balls_c, markers_c])
        pixels = np.concatenate([o.pixels, o.marker_pixels], axis=1)
        roots = _roots(np.concatenate([o.pixel_covariance, o.marker_covariance], axis=1))
        n_balls, rows = len(x.balls_c), []
        for index, planned in enumerate(o.planned):
            camera = camera_of(planned, x.cameras[index])
            J = np.zeros((len(points), 2, x.vector().size))
            start = x.span("cameras").start + PER_CAMERA * index
            J[:, :, start : start + PER_CAMERA] = _camera_slopes(planned, camera, x.cameras[index], points)
            by_point = camera.jacobian(points)
            _diagonal(J, 0, x.span("balls_c").start, by_point[:n_balls])
            J[n_balls:, :, x.span("head")] = by_point[n_balls:] @ self.head_slopes(x, markers_c)
            _diagonal(J, n_balls, x.span("markers_m").start, by_point[n_balls:] @ T_c_m[:3, :3])
            missed = camera.project(points) - pixels[index]
            rows.append(_whitened(missed, J, roots[index]))
        return rows

    def _measured(self, x: Unknowns) -> tuple[Floats, Floats]:
        """The measuring arm's readings."""
        k, sigma = len(self.observed.measured_c), max(self.observed.measuring_mm, FLOOR_MM)
        J = np.zeros((k, 3, x.vector().size))
        _diagonal(J, 0, x.span("balls_c").start, np.tile(np.eye(3), (k, 1, 1)))
        roots = np.tile(np.eye(3) / sigma, (k, 1, 1))
        return _whitened(x.balls_c[:k] - self.observed.measured_c, J, roots)

    def _commanded(self, x: Unknowns) -> tuple[Floats, Floats]:
        """Where the arm, with its errors, should have the ball; its play and repeatability let it stray."""
        o = self.observed
        T = turned_about(self.guess.T_c_base, self._base_center, x.base)
        arm = arm_of(o.held.model, o.arm, x.arm)
        flange = arm.flange_pose(o.q_command)
        balls = apply(T, flange[:, :3, 3] + o.held.rod_mm * flange[:, :3, 2])
        J = np.zeros((len(balls), 3, x.vector().size))
        _diagonal(J, 0, x.span("balls_c").start, np.tile(np.eye(3), (len(balls), 1, 1)))
        J[:, :, x.span("base")] = -_pose_slopes(balls, self._base_center, x.base[:3], x.base[3:])
        J[:, :, x.span("arm")] = -T[:3, :3] @ _arm_slopes(arm, o.arm, o.q_command, o.held.rod_mm)
        return _whitened(x.balls_c - balls, J, self._outlier_roots)

    @cached_property
    def _outlier_roots(self) -> Floats:
        """Roots of the inverse covariance of where the arm has its ball, (s, 3, 3): play (uniform), repeatability."""
        o, R = self.observed, self.guess.T_c_base[:3, :3]
        joint = o.arm.repeatability_rad**2 + o.arm.backlash_rad**2 / 12
        slopes = np.array([R @ ball_jacobian(o.held, q)[:3] for q in o.q_command])
        return _roots(joint * slopes @ slopes.transpose(0, 2, 1) + FLOOR_MM**2 * np.eye(3))

    def _imaged(self, x: Unknowns) -> tuple[Floats, Floats]:
        """The markers in the image."""
        n, sigma = len(x.markers_m), max(self.observed.image_mm, FLOOR_MM)
        J = np.zeros((n, 3, x.vector().size))
        _diagonal(J, 0, x.span("markers_m").start, np.tile(np.eye(3), (n, 1, 1)))
        return _whitened(x.markers_m - self.observed.markers_m, J, np.tile(np.eye(3) / sigma, (n, 1, 1)))

    def _drawn(self, x: Unknowns) -> tuple[Floats, Floats]:
        """What has a known spread about its nominal value."""
        J = np.eye(x.vector().size)
        drawn = np.r_[x.span("cameras"), x.span("arm")]
        return x.vector()[drawn], J[drawn]


def _camera_slopes(planned: Camera, camera: Camera, errors: Floats, points: Floats) -> Floats:
    """Derivative (n, 2, 13) of pixels by a camera's errors."""
    J = np.zeros((len(points), 2, PER_CAMERA))
    pixels, by_point = camera.project(points), camera.jacobian(points)
    inside = apply(camera.T_camera_c, points)
    flat = inside[:, :2] / inside[:, 2:]
    J[:, :, 0] = (pixels - [camera.cx, camera.cy]) * (planned.fx * CAMERA_FOCAL / camera.fx)
    J[:, :, 1:3] = CAMERA_AXIS_PX * np.eye(2)
    J[:, :, 3:7] = camera.fx * coefficient_slope(flat) * LENS
    by_inside = by_point @ camera.T_camera_c[:3, :3].T
    move = _pose_slopes(inside, np.zeros(3), CAMERA_TURN_RAD * errors[7:10], CAMERA_SHIFT_MM * errors[10:13])
    J[:, :, 7:] = by_inside @ move * np.repeat([CAMERA_TURN_RAD, CAMERA_SHIFT_MM], 3)
    return J


def _pose_slopes(points: Floats, center: Floats, turn: Floats, shift: Floats) -> Floats:
    """Derivative (n, 3, 6) of moved points (n, 3) by the turn about a centre and the shift of ``turned``."""
    slopes = turn_and_shift_slopes(points - center - shift)
    x, y, z = turn
    left = np.eye(3) + 0.5 * np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])  # to second order in the turn
    slopes[:, :, :3] = slopes[:, :, :3] @ left
    return slopes


def _arm_slopes(arm: TrueArm, spreads: ArmErrors, q: Floats, rod_mm: float) -> Floats:
    """Derivative (s, 3, 23), base frame, of the ball by the arm's errors: each shifts or turns all that follows it."""
    poses = arm.link_poses(q)
    origins, axes = poses[..., :3, 3], poses[..., :3, :3]
    ball = origins[:, 6] + rod_mm * axes[:, 6, :, 2]
    x, z = axes[:, 1:, :, 0], axes[:, :-1, :, 2]
    twist = np.cross(x, ball[:, None] - origins[:, 1:])
    zero = np.cross(z, ball[:, None] - origins[:, :-1])
    d = np.delete(z, 1, axis=1)
    parts = (spreads.link_mm * x, spreads.link_mm * d, spreads.twist_rad * twist, spreads.joint_rad * zero)
    return np.concatenate(parts, axis=1).transpose(0, 2, 1)


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
