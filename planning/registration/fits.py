"""T_base_ct by each method: rigid, mirrored, triad, affine, weighted, joint; and the covariance of each fit.

With A_i = [I, -[p_i - c]x] stacked and weights W, a reading error z moves the fitted pose by L z, L = (A' W A)^-1 A' W:
a shift of the centroid c, then a rotation about it, base axes. The weighted fit is Gauss-Newton along this map:
Moghari, Abolmaesumi, IEEE TMI 26(12), 2007; Danilchenko, Fitzpatrick, IEEE TMI 30(3), 2011.

The covariance of markers read in a CT and touched by an arm: y_i = T x_i - J_i eta - Jq_i eps_i + n_i, stacked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple, get_args

import numpy as np
from scipy.special import chdtrc, chdtri, fdtri

from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, frame_of_points, log_rotation, pose, skew

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
        increment = step(R, design_blocks(fitted, center), points_base - fitted)
        dR = exp_rotation(increment[..., 3:])
        t = (dR @ (t - center)[..., None])[..., 0] + center + increment[..., :3]
        R = dR @ R
    U, _, Vt = np.linalg.svd(R)  # products of rotations drift from one by rounding
    return pose(U @ Vt, t)


Method = Literal["triad", "rigid", "weighted", "joint", "affine"]
Fit = Callable[[Floats, Floats], Floats]
"""From points (..., n, 3) in both frames, mm, to T_base_ct."""
LEAST_FOUND_MM = 0.01
"""FRE from which on the markers can say how large the errors are: no arm repeats so well, so one side was computed."""
SINGULAR = 1e-12
"""Least over greatest variance of the readings below which some of them count as free of error."""


def checked_fit(
    points_ct: Floats,
    points_base: Floats,
    method: Method,
    noise: ReadingNoise | None,
    found_in_mm: float | None,
    *,
    where: str | Path,
) -> Fit:
    """The fit of a method, which the declared noise has passed; the FRE is given where its size is to be found in it.

    Raises InputError: ``affine``, ``weighted`` or ``joint`` without noise, or noise that cannot be weighed.
    """
    if method == "affine":
        allowed = "triad, rigid or weighted; affine only reproduces the paper's Table 6"
        refuse("method 'affine' bends the patient", where, allowed, "method_bends")
    if method not in get_args(Method):
        refuse(f"method {method!r}", where, ", ".join(get_args(Method)), "unknown_method")
    weighing = method in {"weighted", "joint"}
    if noise is None:
        if weighing:
            what = f"method '{method}' needs declared errors as weights"
            refuse(what, where, "[errors], or method rigid", "method_without_errors")
        return fit_triad if method == "triad" else fit_rigid
    covariance = noise.covariance(fit_rigid(points_ct, points_base)[:3, :3])
    values = np.linalg.eigvalsh(covariance.independent if weighing else covariance.whole)
    if not values[0] > SINGULAR * values[-1]:
        allowed = "ct_in_plane_mm, ct_slice_mm or touch_mm above 0"
        refuse("the declared errors leave some marker readings without error", where, allowed, "no_marker_noise")
    if found_in_mm is not None and found_in_mm < LEAST_FOUND_MM:
        message = f"marker_noise = 'found', but the residuals ({found_in_mm:.2g} mm) show none"
        refuse(message, where, "markers measured on both sides, or marker_noise = 'declared'", "no_marker_noise")
    if weighing:
        weighted = fit_weighted if method == "weighted" else fit_joint
        return lambda ct, base: weighted(ct, base, noise, fit_rigid(ct, base))
    return fit_triad if method == "triad" else fit_rigid


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


REJECT_LEVEL = 0.001
"""Significance level of rejection: honest noise exceeds such residuals once in 1,000 registrations."""
INTERVAL = 0.95
"""Of every interval and region that is printed."""


class Interval(NamedTuple):
    """Lower and upper bound, mm."""

    low: float
    high: float


WARNED = 0.01
"""Residuals that the declared errors exceed once in 100 registrations: it is warned, and the errors are scaled."""


@dataclass(frozen=True)
class NoiseTest:
    """The residuals of a weighted fit against the declared errors."""

    count: int  # markers, N >= 3
    chi_squared: float
    """r' C^-1 r of the weighted residuals: chi-squared with 3 N - 6 degrees where the declaration holds."""
    found: bool = False
    """Whether the declaration gives the errors' shape alone, and the residuals their size."""

    @property
    def freedom(self) -> int:
        """Degrees of freedom, nu = 3 N - 6."""
        return 3 * self.count - 6

    @property
    def probability(self) -> float:
        """Chance of residuals as large as these, if the declaration holds."""
        return float(chdtrc(self.freedom, self.chi_squared))

    @property
    def agrees(self) -> bool:
        """Whether the residuals agree with the declaration, or nothing was declared about their size."""
        return self.found or self.probability >= WARNED

    @property
    def explained(self) -> bool:
        """Whether a registration with such residuals is taken at all without the case's consent."""
        return self.found or self.probability >= REJECT_LEVEL

    @property
    def estimate(self) -> float:
        """s, the size of the errors by the residuals over the declared one."""
        return float(np.sqrt(self.chi_squared / self.freedom))

    @property
    def interval(self) -> Interval:
        """The 95 % interval of the true size over the declared one: nu s^2 over chi-squared."""
        tail = (1 - INTERVAL) / 2
        low, high = (float(np.sqrt(self.chi_squared / chdtri(self.freedom, p))) for p in (tail, 1 - tail))
        return Interval(low, high)

    @property
    def scale(self) -> float:
        """Factor of the declared deviations: 1 where the declaration holds."""
        return self.estimate if self.found or not self.agrees else 1.0

    @property
    def scaled(self) -> bool:
        """Whether the size is that of the residuals, so that chances follow Student's t and regions Fisher's F."""
        return self.found or not self.agrees

    @property
    def region_factor(self) -> float:
        """The k of the 95 % region d' Sigma^-1 d <= k^2 in three dimensions, Sigma scaled: sqrt(chi2) or sqrt(3 F)."""
        if self.scaled:
            return float(np.sqrt(3 * fdtri(3, self.freedom, INTERVAL)))
        return float(np.sqrt(chdtri(3, 1 - INTERVAL)))

    def text(self) -> str:
        """Result of the test, in one sentence."""
        low, high = self.interval
        size = f"the residuals show {self.estimate:.2f} times the declared errors (95 %: {low:.2f} to {high:.2f})"
        if self.found:
            return f"noise found: {size}"
        verdict = "agree with" if self.agrees else "do not agree with"
        return (
            f"residuals {verdict} the declared errors (chi-squared {self.chi_squared:.1f}, {self.freedom} degrees of "
            f"freedom, p {self.probability:.2g}); {size}"
        )


def noise_test(residuals: Floats, cov: Floats, A: Floats, *, found: bool = False) -> NoiseTest:
    """Test the stacked residuals (3 N,) of any fit, whose design is A (3 N, 6), against their covariance (3 N, 3 N).

    They are first freed of what the best weights would have fitted: r = M z, M = I - A (A' C^-1 A)^-1 A' C^-1.
    """
    weights = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    free = residuals - A @ (least_squares_map(A, weights) @ residuals)
    return NoiseTest(len(residuals) // 3, float(free @ weights @ free), found)


@dataclass(frozen=True, eq=False)
class FitUncertainty:
    """The declared errors of the markers, and the map from them to the pose; base axes, mm and rad."""

    noise: ReadingNoise
    R_base_ct: Floats  # shape (3, 3), as registered
    center_base: Floats  # shape (3,), the markers' centroid, about which `fit_map` turns
    fit_map: Floats  # L, shape (6, 3 N), from the stacked reading errors to shift and rotation
    test: NoiseTest
    """Whether the residuals agree with the declaration; its scale is not yet in the covariances below."""

    @property
    def fle_mm(self) -> float:
        """The rms length of one marker's error, CT and touch together, scaled; the arm's own errors not counted."""
        omega = self.noise.covariance(self.R_base_ct).independent
        return self.test.scale * float(np.sqrt(np.trace(omega) / (len(omega) / 3)))

    def map_at(self, point_base: Floats) -> Floats:
        """X L, shape (6, 3 N): shift at a point (3,) and rotation, per reading error."""
        return carried(self.center_base, point_base) @ self.fit_map

    def cov_at(self, point_base: Floats) -> Floats:
        """X L Omega L' X', shape (6, 6): shift (mm) at a point (3,) and rotation, from the readings alone, scaled."""
        at = self.map_at(point_base)
        return np.asarray(self.test.scale**2 * at @ self.noise.covariance(self.R_base_ct).independent @ at.T)

    def parts_at(self, point_base: Floats) -> tuple[Floats, Floats]:
        """`cov_at`'s part of shift, shape (3, 3) each: of the reading in the CT, and of the touch."""
        marks = self.map_at(point_base)[:3].reshape(3, -1, 3)
        read = self.R_base_ct @ self.noise.cov_ct @ self.R_base_ct.T
        of_ct, of_touch = (
            self.test.scale**2
            * np.einsum("anb,nbc,dnc->ad", marks, np.broadcast_to(block, self.noise.cov_base.shape), marks)
            for block in (read, self.noise.cov_base)
        )
        return of_ct, of_touch


def fit_uncertainty(
    method: str,
    fit: Callable[[Floats, Floats], Floats],
    T_base_ct: Floats,
    points_ct: Floats,
    points_base: Floats,
    noise: ReadingNoise,
    *,
    found: bool,
) -> FitUncertainty:
    """The uncertainty of a pose (4, 4) that a method's fit gave of points (N, 3) in both frames, mm.

    ``rigid``, ``weighted`` and ``joint`` have a formula; of others ``fit`` is differenced. ``found``: the residuals
    give the errors' size.
    """
    R, center = T_base_ct[:3, :3], points_base.mean(axis=0)
    fitted = points_ct @ R.T + T_base_ct[:3, 3]
    A, covariance = design(fitted, center), noise.covariance(R)
    if method in {"weighted", "joint"}:
        cov = covariance.independent if method == "weighted" else covariance.whole
        L = least_squares_map(A, np.asarray(np.linalg.inv(cov), dtype=np.float64))
    elif method == "rigid":
        L = least_squares_map(A)
    else:
        L = differenced_map(fit, points_ct, fitted)
    test = noise_test((points_base - fitted).ravel(), covariance.whole, A, found=found)
    return FitUncertainty(noise, R, center, L, test)


@dataclass(frozen=True, eq=False)
class Aim:
    """The insertion for which a pose is corrected."""

    target_ct: Floats  # shape (3,), mm
    q: Floats  # shape (6,), rad, the tip on the target
    arm_jacobian: Floats  # shape (6, 28), J_f: motion of the needle there per arm parameter, base axes

    def response(self, noise: ReadingNoise, weights: Floats) -> Floats:
        """Correction of the pose at the target per residual of weights W (..., 3 N, 3 N), shape (..., 6, 3 N).

        J_f Sigma_eta J' W, with Sigma_eta, J the arm's parameters and their effect on the touches.
        """
        return np.asarray((self.arm_jacobian * noise.eta_variances) @ noise.arm_jacobian.T @ weights)
