"""Bundle adjustment: cameras, poses of rigid bodies and points of those bodies that reproject best, all at once.

A point k of body j is seen by camera i at  pixel = camera_i(T_c_body_j point_k).  Every parameter has a standard
deviation around its start: 0 fixes it, infinity frees it, a number between is a normal prior. So one function is a
camera's refinement from known points (body and points fixed), a chessboard calibration (bodies free, points fixed), and
the joint optimum of cameras, fixed points and frames with all their known errors.

Rotations and translations move as  p -> Exp(w) p + t, in the frame that the map leads to. The solver is
Levenberg-Marquardt (MINPACK, Moré 1978) with a dense analytic Jacobian: fit for thousands of observations and hundreds
of parameters.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from puncture_twin.planning.base.arrays import Floats, Ints, rms
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, left_jacobian, pose, skew
from puncture_twin.twin.guidance.stereo.cameras.camera import Camera, coefficient_slope, distort

CAMERA_PARAMETERS = ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "wx", "wy", "wz", "tx", "ty", "tz")
"""Order of a camera's parameters: px, 1, rad, mm; w and t turn and move the camera's frame (T_camera_c)."""
TOLERANCE = 1e-12
"""Relative change of cost or parameters that ends the search."""


class Observations(NamedTuple):
    """Observed pixels, a row each."""

    camera: Ints
    """Shape (n,): which camera."""
    body: Ints
    """Shape (n,): which body."""
    point: Ints
    """Shape (n,): which point."""
    pixels: Floats
    """Shape (n, 2)."""
    covariance: Floats
    """Shape (n, 2, 2), px^2, or (2, 2) for all."""


class PixelSpreads(NamedTuple):
    """Standard deviations of the parameters around their start: 0 fixes, infinity frees."""

    cameras: Floats
    """Shape (cameras, 14), in the order of ``CAMERA_PARAMETERS``."""
    bodies: Floats
    """Shape (bodies, 6): rad, mm."""
    points: Floats
    """Shape (points, 3), mm."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """The optimum of a bundle adjustment.

    Attributes:
        cameras: Refined.
        T_c_bodies: Shape (bodies, 4, 4).
        points: Shape (points, 3), in the bodies' frame.
        residuals_px: Shape (n, 2), seen minus predicted.
        cost: Sum of the squared, whitened residuals, priors included.
        free: Which of all parameters (cameras, bodies, points, in this order) were not fixed.
        covariance: Shape (all, all), of all parameters, zero where held; from the covariances given, not rescaled.
    """

    cameras: tuple[Camera, ...]
    T_c_bodies: Floats
    points: Floats
    residuals_px: Floats
    cost: float
    free: NDArray[np.bool_]
    covariance: Floats

    @property
    def rms_px(self) -> float:
        """Root mean square distance between seen and predicted pixels."""
        return rms(self.residuals_px)

    def camera_covariance(self, camera: int) -> Floats:
        """Covariance of one camera's 14 parameters, shape (14, 14)."""
        rows = slice(14 * camera, 14 * camera + 14)
        return self.covariance[rows, rows]


def adjust(
    cameras: Sequence[Camera], T_c_bodies: Floats, points: Floats, seen: Observations, spreads: PixelSpreads
) -> Bundle:
    """Adjust everything that is not fixed.

    Args:
        cameras: Where to start.
        T_c_bodies: Shape (bodies, 4, 4), mm: where to start; one identity where the points are in C.
        points: Shape (points, 3), mm: where to start.
        seen: The observations.
        spreads: What is known beforehand.

    Raises:
        InputError: Nothing is free, or the observations leave a parameter free.
    """
    problem = _Problem(tuple(cameras), np.asarray(T_c_bodies), np.asarray(points), seen, spreads)
    if problem.rows() < problem.free.sum() or not problem.free.any():
        what = f"{problem.rows()} equations for {problem.free.sum()} unknowns"
        refuse(what, "bundle", "at least as many", "undetermined")
    start = np.zeros(int(problem.free.sum()))
    fit = least_squares(
        problem.errors, start, problem.jacobian, method="lm", x_scale=problem.scale(), ftol=TOLERANCE, xtol=TOLERANCE
    )
    final = problem.at(fit.x)
    J = problem.jacobian(fit.x)
    covariance = np.zeros((len(problem.free),) * 2)
    covariance[np.ix_(problem.free, problem.free)] = _inverse(J.T @ J)
    residuals = seen.pixels - final.predicted(seen)
    return Bundle(
        final.cameras, final.T_c_bodies, final.points, residuals, float(2 * fit.cost), problem.free, covariance
    )


def _inverse(information: Floats) -> Floats:
    """Inverse after scaling to a unit diagonal: the parameters' units differ by powers of ten."""
    scale = 1 / np.sqrt(np.diag(information))
    if not np.isfinite(scale).all() or np.linalg.cond(information * np.outer(scale, scale)) > 1e15:
        refuse("nothing determines a parameter", "bundle", "fix it, or state its standard deviation", "undetermined")
    return np.asarray(np.linalg.inv(information * np.outer(scale, scale)) * np.outer(scale, scale))


class _Iterate(NamedTuple):
    """Cameras, bodies and points at one iteration."""

    cameras: tuple[Camera, ...]
    T_c_bodies: Floats
    points: Floats

    def points_c(self, seen: Observations) -> Floats:
        T = self.T_c_bodies[seen.body]
        return np.asarray(np.einsum("nij,nj->ni", T[:, :3, :3], self.points[seen.point]) + T[:, :3, 3])

    def predicted(self, seen: Observations) -> Floats:
        points, pixels = self.points_c(seen), np.empty((len(seen.pixels), 2))
        for number, camera in enumerate(self.cameras):
            rows = seen.camera == number
            pixels[rows] = _project(camera, points[rows])
        return pixels


class _Problem:
    """The residuals and their slope as functions of the free parameters."""

    def __init__(
        self, cameras: tuple[Camera, ...], T_c_bodies: Floats, points: Floats, seen: Observations, spreads: PixelSpreads
    ) -> None:
        self.start = _Iterate(cameras, T_c_bodies, points)
        self.seen = seen
        self.sigma = np.concatenate([np.ravel(part) for part in spreads])
        self.free = self.sigma > 0  # a deviation of 0 fixes
        self.prior = np.isfinite(self.sigma[self.free])  # an infinite one has no prior row
        each = np.broadcast_to(seen.covariance, (len(seen.pixels), 2, 2))
        self.whitening = np.linalg.inv(np.linalg.cholesky(each))
        self.first_body = 14 * len(cameras)
        self.first_point = self.first_body + 6 * len(T_c_bodies)

    def rows(self) -> int:
        return 2 * len(self.seen.pixels) + int(self.prior.sum())

    def scale(self) -> Floats:
        slopes = np.linalg.norm(self.jacobian(np.zeros(int(self.free.sum()))), axis=0)
        return np.asarray(1 / np.where(slopes > 0, slopes, 1.0))

    def _all(self, x: Floats) -> Floats:
        every = np.zeros(len(self.free))
        every[self.free] = x
        return every

    def at(self, x: Floats) -> _Iterate:
        every = self._all(x)
        cameras = tuple(
            _moved_camera(camera, every[14 * i : 14 * i + 14]) for i, camera in enumerate(self.start.cameras)
        )
        moves = every[self.first_body : self.first_point].reshape(-1, 6)
        bodies = pose(exp_rotation(moves[:, :3]), moves[:, 3:]) @ self.start.T_c_bodies
        return _Iterate(cameras, bodies, self.start.points + every[self.first_point :].reshape(-1, 3))

    def errors(self, x: Floats) -> Floats:
        miss = self.at(x).predicted(self.seen) - self.seen.pixels
        white = np.einsum("nij,nj->ni", self.whitening, miss)
        return np.concatenate([white.ravel(), (x / self.sigma[self.free])[self.prior]])  # pixels, then priors

    def jacobian(self, x: Floats) -> Floats:
        every, state, seen = self._all(x), self.at(x), self.seen
        points_c = state.points_c(seen)
        slope = np.zeros((len(seen.pixels), 2, len(self.free)))
        for number, camera in enumerate(state.cameras):
            rows = np.flatnonzero(seen.camera == number)
            first = 14 * number
            turn = every[first + 8 : first + 11], every[first + 11 : first + 14]
            slope[rows, :, first : first + 14] = _camera_slope(camera, points_c[rows], turn)
            self._body_and_point_slope(slope, rows, camera, state, every)
        white = self.whitening @ slope
        observed = white.reshape(-1, len(self.free))[:, self.free]
        return np.concatenate([observed, np.diag(1 / self.sigma[self.free])[self.prior]])

    def _body_and_point_slope(self, slope: Floats, rows: Ints, camera: Camera, state: _Iterate, every: Floats) -> None:
        seen = self.seen
        by_point_c = camera.jacobian(state.points_c(seen)[rows])
        for body in np.unique(seen.body[rows]):
            own = seen.body[rows] == body
            T = state.T_c_bodies[body]
            first = self.first_body + 6 * int(body)
            w, t = every[first : first + 3], every[first + 3 : first + 6]
            rotated = state.points[seen.point[rows[own]]] @ T[:3, :3].T + T[:3, 3] - t
            slope[rows[own], :, first : first + 3] = by_point_c[own] @ _turn_slope(rotated, w)
            slope[rows[own], :, first + 3 : first + 6] = by_point_c[own]
            by_point = by_point_c[own] @ T[:3, :3]
            for axis in range(3):
                column = self.first_point + 3 * seen.point[rows[own]] + axis
                slope[rows[own], :, column] = by_point[..., axis]


def _project(camera: Camera, points_c: Floats) -> Floats:
    """Project like ``Camera.project``, but smoothly everywhere: a step of the search may pass behind a camera."""
    points = apply(camera.T_camera_c, points_c)
    flat = points[:, :2] / points[:, 2:]
    return np.asarray(distort(flat, camera.distortion) * [camera.fx, camera.fy] + [camera.cx, camera.cy])


def _camera_slope(camera: Camera, points_c: Floats, turn: tuple[Floats, Floats]) -> Floats:
    """Derivative of the pixels by the camera's 14 parameters, shape (n, 2, 14)."""
    points = apply(camera.T_camera_c, points_c)
    flat = points[:, :2] / points[:, 2:]
    bent = distort(flat, camera.distortion)
    focal = np.array([camera.fx, camera.fy])
    by_point = camera.jacobian(points_c) @ camera.T_camera_c[:3, :3].T
    slope = np.zeros((len(points), 2, 14))
    slope[:, 0, 0], slope[:, 1, 1] = bent[:, 0], bent[:, 1]
    slope[:, 0, 2] = slope[:, 1, 3] = 1.0
    slope[:, :, 4:8] = focal[:, None] * coefficient_slope(flat)
    slope[:, :, 8:11] = by_point @ _turn_slope(points - turn[1], turn[0])
    slope[:, :, 11:14] = by_point
    return slope


def _turn_slope(rotated: Floats, w: Floats) -> Floats:
    """The slope d Exp(w) p / dw = -[Exp(w) p]x J_l(w), for Exp(w) p of shape (n, 3); shape (n, 3, 3)."""
    return np.asarray(-skew(rotated) @ left_jacobian(w))


def _moved_camera(camera: Camera, change: Floats) -> Camera:
    return replace(
        camera,
        fx=camera.fx + float(change[0]),
        fy=camera.fy + float(change[1]),
        cx=camera.cx + float(change[2]),
        cy=camera.cy + float(change[3]),
        distortion=camera.distortion + change[4:8],
        T_camera_c=pose(exp_rotation(change[8:11]), change[11:14]) @ camera.T_camera_c,
    )
