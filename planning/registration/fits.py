"""T_base_ct by each method: rigid, mirrored, triad, affine, weighted, joint; and the map from reading errors to it.

With A_i = [I, -[p_i - c]x] stacked and weights W, a reading error z moves the fitted pose by L z, L = (A' W A)^-1 A' W:
a shift of the centroid c, then a rotation about it, base axes. The weighted fit is Gauss-Newton along this map:
Moghari, Abolmaesumi, IEEE TMI 26(12), 2007; Danilchenko, Fitzpatrick, IEEE TMI 30(3), 2011.

Is one list of markers scaled, stretched or sheared against the other? A rigid fit beside fits of one parameter more.

A unit that is a little off, slices whose step is wrong, a gantry tilt that nobody took back: each deforms what one side
shows, and a rigid motion leaves that to the residuals, where it looks like noise. Seven deformations of the CT's frame
are tried, one at a time: a similarity, a stretch along each axis, a shear in each plane. With z the residuals of the
rigid fit, whitened by what is declared of the readings, A its design and d the column of a deformation:

    F = (SSE_6 - SSE_7) / (SSE_7 / (3 N - 7))   follows F(1, 3 N - 7) where there is none,

and the best one's probability counts seven times (Bonferroni). It is reported and never applied: a marker that was
misread can look the same.

The covariance of markers read in a CT and touched by an arm: y_i = T x_i - J_i eta - Jq_i eps_i + n_i, stacked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.geometry.gauss_newton import lacking
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, frame_of_points, log_rotation, pose, skew
from puncture_twin.planning.registration.marker_pairs import MarkerPairs

NUDGE_MM = 1e-4
"""Of central differences of a method that has no formula of its own; their error is 1e-9 of the map."""


def design(points_base: Floats, center_base: Floats) -> Floats:
    """A, shape (3 N, 6), of points (N, 3) about a centre (3,): how a shift and a rotation (rad) move them."""
    return design_blocks(points_base, center_base).reshape(-1, 6)


def least_squares_map(A: Floats, weights: Floats | None = None) -> Floats:
    """L, shape (6, 3 N), of a design (3 N, 6) and weights (3 N, 3 N); None weighs all alike."""
    weighted = A.T if weights is None else A.T @ weights
    return np.asarray(np.linalg.solve(weighted @ A, weighted))


def design_blocks(points: Floats, center: Floats) -> Floats:
    """A_i = [I, -[p_i - c]x], shape (..., N, 3, 6)."""
    eye = np.broadcast_to(np.eye(3), (*points.shape, 3))
    return np.concatenate([eye, -skew(points - center[..., None, :])], axis=-1)


def differenced_map(fit: Callable[[Floats, Floats], Floats], points_ct: Floats, points_base: Floats) -> Floats:
    """L, shape (6, 3 N), of any method, by central differences of its pose over the base readings."""
    center = points_base.mean(axis=0)
    T = fit(points_ct, points_base)
    center_ct, columns = apply(np.linalg.inv(T), center), []
    for nudge in NUDGE_MM * np.eye(points_base.size):
        plus, minus = (fit(points_ct, points_base + sign * nudge.reshape(-1, 3)) for sign in (1.0, -1.0))
        shift = (apply(plus, center_ct) - apply(minus, center_ct)) / (2 * NUDGE_MM)
        columns.append(np.concatenate([shift, log_rotation(plus[:3, :3] @ minus[:3, :3].T) / (2 * NUDGE_MM)]))
    return np.array(columns).T


def carried(center_base: Floats, point_base: Floats) -> Floats:
    """X, shape (6, 6): a shift and rotation about a centre (3,) as they arrive at another point (3,)."""
    X = np.eye(6)
    X[:3, 3:] = -skew(point_base - center_base)
    return X


def carried_along(points: Floats, cov: Floats) -> Floats:
    """Sigma6 at each of points (m, 3) of a rigid body, shape (m, 6, 6), of that at the first, (6, 6)."""
    X = np.stack([carried(points[0], point) for point in points])
    return np.asarray(X @ cov @ X.transpose(0, 2, 1))


def fit_rigid(points_ct: Floats, points_base: Floats, *, mirrored: bool = False) -> Floats:
    """T_base_ct that minimises the squared residuals over rotations (Arun 1987, by SVD; det = +1 after Umeyama 1991).

    Of points (..., n, 3), n >= 3, not collinear, mm, one set or many; ``mirrored``: over the reflections instead.
    """
    center_ct, center_base = points_ct.mean(axis=-2), points_base.mean(axis=-2)
    spread = np.swapaxes(points_base - center_base[..., None, :], -1, -2) @ (points_ct - center_ct[..., None, :])
    U, _, Vt = np.linalg.svd(spread)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    U = U * np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None, :]
    R = U @ Vt
    return read_only(pose(R, center_base - (R @ center_ct[..., None])[..., 0]))


def rms(vectors: Floats) -> float:
    """Root mean square of the lengths of vectors (n, 3)."""
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def rigid_fre_mm(points_ct: Floats, points_base: Floats) -> float:
    """The FRE (rms residual), mm, of `fit_rigid`: the chi-squared test is about that.

    Of points (n, 3), n >= 3, not collinear, mm.
    """
    return rms(apply(fit_rigid(points_ct, points_base), points_ct) - points_base)


def fit_triad(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct by the frames that three markers span, points (..., 3, 3), mm, one set or many (Chen 2019, Eq. 1-9).

    R_base_ct = R_base R_ct^T; the translation is the mean over the three markers.
    """
    R_ct = np.swapaxes(frame_of_points(points_ct), -1, -2)
    R = frame_of_points(points_base) @ R_ct
    return read_only(pose(R, np.mean(points_base - points_ct @ np.swapaxes(R, -1, -2), axis=-2)))


def fit_affine(points_ct: Floats, points_base: Floats) -> Floats:
    """The unconstrained 12-parameter least squares of the paper's Table 6, shape (4, 4). Not a rigid motion.

    With fewer than four markers that span space it is not unique, and the solution of least norm is taken.
    """
    homogeneous = np.column_stack([points_ct, np.ones(len(points_ct))])
    solution, *_ = np.linalg.lstsq(homogeneous, points_base, rcond=None)
    T = np.eye(4)
    T[:3] = solution.T
    return T


STEPS = 6
"""Gauss-Newton steps of the weighted fit: from the least-squares fit its error falls below 1e-12 mm in four."""


def fit_weighted(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats) -> Floats:
    """T_base_ct, shape (..., 4, 4), that minimises z' Omega^-1 z over rigid motions, z the stacked residuals.

    Of points (..., N, 3), mm, one set or many of one noise, which gives Omega for the rotation found so far; from
    T_start (..., 4, 4) on, such as the least-squares fit.
    """

    def step(R: Floats, blocks: Floats, residuals: Floats) -> Floats:
        weighted = np.swapaxes(blocks, -1, -2) @ np.linalg.inv(noise.blocks(R))
        normal, right = (weighted @ blocks).sum(axis=-3), weighted @ residuals[..., None]
        return np.asarray(np.linalg.solve(normal, right.sum(axis=-3))[..., 0])

    return _gauss_newton(points_ct, points_base, T_start, step)


def fit_joint(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats) -> Floats:
    """T_base_ct, shape (..., 4, 4), that minimises z' C^-1 z: the arm's errors, common to all markers, count too.

    The arguments are those of `fit_weighted`. C is taken at T_start, from which the fit turns by little.
    """
    weights = np.linalg.inv(noise.covariance(T_start[..., :3, :3]).whole)

    def step(_: Floats, blocks: Floats, residuals: Floats) -> Floats:
        A = blocks.reshape(*blocks.shape[:-3], -1, 6)
        weighted = np.swapaxes(A, -1, -2) @ weights
        return np.asarray(np.linalg.solve(weighted @ A, weighted @ residuals.reshape(*A.shape[:-1], 1))[..., 0])

    return _gauss_newton(points_ct, points_base, T_start, step)


def _gauss_newton(
    points_ct: Floats, points_base: Floats, T_start: Floats, step: Callable[[Floats, Floats, Floats], Floats]
) -> Floats:
    """Follow the steps (..., 6) that a rotation, the blocks of its design and its residuals (..., N, 3) call for."""
    R, t, center = T_start[..., :3, :3], T_start[..., :3, 3], points_base.mean(axis=-2)
    for _ in range(STEPS):
        fitted = points_ct @ np.swapaxes(R, -1, -2) + t[..., None, :]
        moved = step(R, design_blocks(fitted, center), points_base - fitted)
        turn = exp_rotation(moved[..., 3:])
        t = (turn @ (t - center)[..., None])[..., 0] + center + moved[..., :3]
        R = turn @ R
    U, _, Vt = np.linalg.svd(R)  # products of rotations drift from one by rounding
    return pose(U @ Vt, t)


SIGNIFICANT, SURE = 0.05, 0.01
"""True lists look so deformed once in 20 registrations, and once in 100: it is said, and nothing is refused for it.
Where one axis is read five times as badly as the others and nobody declares it, the second is up to one in ten (1,000
draws each, 3 to 12 markers)."""
LEAST_MM = 0.05
"""Rms of what a deformation moves the markers by, below which it does not matter, however sure it is."""
KINDS = ("xyz", "x", "y", "z", "xy", "xz", "yz")
"""A similarity, three stretches, and shears: the first axis runs askew along the second."""


@dataclass(frozen=True)
class Distortion:
    """The deformation that explains most of the residuals."""

    axes: str  # of ``KINDS``, in the case's CT frame
    amount: float
    """The factor less 1 by which markers_base are longer; of a shear by how much a point moves along the first axis per
    mm along the second."""
    probability: float  # of one so sure in any of the seven, where there is none
    moved_mm: float  # what it moves the markers by beside a rigid motion, rms
    reading_mm: float  # the standard deviation per coordinate that it leaves to the readings
    rms_mm: float  # expected error at the target by the residuals of the rigid fit
    rms_without_mm: float  # the rms by the residuals of the fit with the deformation

    @property
    def significant(self) -> bool:
        """Whether true lists would seldom look so deformed, by so much that it matters: then it is reported."""
        return self.probability < SIGNIFICANT and self.moved_mm >= LEAST_MM

    def finding(self) -> Finding:
        """The deformation as a warning."""
        noise = "not noise, because" if self.probability < SURE else "probably more than noise:"
        said = (
            f"{self.brief()}: {noise} besides it, the readings have errors of {self.reading_mm:.2g} mm a "
            "coordinate; without it the expected TRE at the target would be about "
            f"{self.rms_without_mm:.1f} mm instead of {self.rms_mm:.1f}; the registration does not use this"
        )
        numbers: dict[str, float | str] = {"axes": self.axes, "amount": self.amount, "probability": self.probability}
        return Finding("lists_deformed", Severity.WARNING, said, numbers)

    def brief(self) -> str:
        """How the lists differ, by how much, and how sure that is."""
        along = "" if self.axes == "xyz" else f" along the CT's {self.axes}"
        said = f"markers_base appear {1 + self.amount:.4f} times as large as markers_ct{along}"
        if len(self.axes) == 2:
            angle = np.degrees(abs(np.arctan(self.amount)))
            said = f"the CT's frame looks {angle:.1f} degrees out of square, {self.axes[0]} against {self.axes[1]}"
        return f"{said} (F test, p {self.probability:.2g})"


def distortion(
    T_base_ct: Floats, markers: MarkerPairs, noise: ReadingNoise | None, target_ct: Floats
) -> Distortion | None:
    """The likeliest deformation of a registration's lists; None where its markers cannot show any.

    T_base_ct (4, 4) is near the least-squares fit, the error matters at target_ct (3,), mm; without noise all weigh
    alike.
    """
    fitted = apply(T_base_ct, markers.points_ct)
    cov = np.eye(fitted.size) if noise is None else noise.covariance(T_base_ct[:3, :3]).whole
    root = np.linalg.inv(np.linalg.cholesky(cov))
    gaps, A = (markers.points_base - fitted).ravel(), design(fitted, fitted.mean(axis=0))
    center_ct = markers.points_ct.mean(axis=0)
    found = []
    for axes in KINDS:
        moved = _moved(axes, T_base_ct, markers.points_ct - center_ct).ravel()
        tested = lacking(root @ gaps, root @ A, root @ moved[:, None])
        if tested is not None:
            found.append((tested, axes, moved))
    if not found:
        return None
    best, axes, moved = min(found, key=lambda one: one[0].probability)
    amount, back = float(best.found[0]), np.linalg.pinv(A)
    beside, rigid = (column - A @ (back @ column) for column in (moved, gaps))
    at, at_moved = carried(fitted.mean(axis=0), apply(T_base_ct, target_ct))[:3], target_ct - center_ct
    whole = np.column_stack([A, moved]), np.column_stack([at, _moved(axes, T_base_ct, at_moved[None])[0]])
    return Distortion(
        axes,
        amount,
        min(1.0, len(KINDS) * best.probability),
        abs(amount) * float(np.linalg.norm(beside)) / float(np.sqrt(len(markers))),
        float(np.linalg.norm(rigid - amount * beside)) / float(np.sqrt(best.freedom)),
        _weighted_rms(root @ A, at, best.variance_without),
        _weighted_rms(root @ whole[0], whole[1], best.variance),
    )


def _moved(axes: str, T_base_ct: Floats, from_center_ct: Floats) -> Floats:
    """How points (n, 3) of the CT, from the markers' centroid, move in base axes per unit of amount, shape (n, 3)."""
    rows = ["xyz".index(axis) for axis in axes]
    M = np.zeros((3, 3))
    if len(axes) == 2:
        M[rows[0], rows[1]] = 1.0
    else:
        M[rows, rows] = 1.0
    return np.asarray(from_center_ct @ M.T @ T_base_ct[:3, :3].T)


def _weighted_rms(B: Floats, X: Floats, variance: float) -> float:
    """Expected error (rms, mm) of what X (3, p) carries from a fit of design B (m, p), whitened, to the target."""
    return float(np.sqrt(np.trace(X @ np.linalg.inv(B.T @ B) @ X.T) * variance))


class NoiseCovariance(NamedTuple):
    """The covariance of N stacked readings, mm^2, base axes."""

    independent: Floats  # Omega, shape (..., 3 N, 3 N): what errs anew at each marker
    shared: Floats
    """J Sigma_eta J', shape (3 N, 3 N): what the arm does wrong at all markers together."""

    @property
    def whole(self) -> Floats:
        """C, shape (..., 3 N, 3 N): both."""
        return self.independent + self.shared

    @property
    def greatest_fle_mm(self) -> float:
        """The noise of the isotropic test that other pairings of the names are compared with: the worst axis in all.

        Residuals that pass the weighted test have |r|^2 <= lambda_max chi-squared: the given names pass this one too.
        """
        return float(np.sqrt(3 * np.linalg.eigvalsh(self.whole)[-1]))


@dataclass(frozen=True, eq=False)
class ReadingNoise:
    """Declared errors of the readings of N markers, all normal with mean zero."""

    cov_ct: Floats  # shape (3, 3), mm^2, of each reading in the CT
    cov_base: Floats  # shape (N, 3, 3), mm^2, of each touch: its own noise, and the arm's repeatability there
    arm_jacobian: Floats  # shape (3 N, 28), how the arm's parameters move the tip at the touches
    eta_variances: Floats  # shape (28,), of those parameters
    touches_known: bool
    """Whether the file says how the arm stood at the touches; else they are the planner's guess."""

    def covariance(self, R_base_ct: Floats) -> NoiseCovariance:
        """Covariance of all readings stacked, CT axes rotated by (..., 3, 3)."""
        blocks = self.blocks(R_base_ct)
        count = blocks.shape[-3]
        omega = np.zeros((*blocks.shape[:-3], 3 * count, 3 * count))
        for row in range(count):
            omega[..., 3 * row : 3 * row + 3, 3 * row : 3 * row + 3] = blocks[..., row, :, :]
        shared = np.asarray((self.arm_jacobian * self.eta_variances) @ self.arm_jacobian.T)
        return NoiseCovariance(omega, shared)

    def blocks(self, R_base_ct: Floats) -> Floats:
        """Omega's blocks, shape (..., N, 3, 3), one a marker, for rotations (..., 3, 3)."""
        read = R_base_ct @ self.cov_ct @ np.swapaxes(R_base_ct, -1, -2)
        return np.asarray(read[..., None, :, :] + self.cov_base)
