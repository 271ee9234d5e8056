"""Weighted least squares (Gauss-Newton on the rotations' tangent space), and the test for errors of the image.

Each pose's own noise Omega_i is whitened alone. Errors that all poses share (N per standard deviation of each) couple
the poses: the residuals' covariance is C = Omega + N N^T, and with S = Omega^-1/2 N

    C^-1/2 = (I + S S^T)^-1/2 Omega^-1/2,   (I + S S^T)^-1/2 = I - S V diag(1 / (s (s + 1))) V^T S^T,   s^2 = 1 + d^2,

where S^T S = V diag(d^2) V^T. The same estimate comes from taking the shared errors as unknowns with a prior.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton, lacking
from puncture_twin.twin.guidance.ultrasound.axp_ybq.closed_form import SCALE, Estimate, parameter_units
from puncture_twin.twin.guidance.ultrasound.axp_ybq.direction import directions_image, linearised_tip
from puncture_twin.twin.guidance.ultrasound.axp_ybq.problem import (
    Problem,
    Weights,
    linear_model,
    residual_weights,
    residuals,
)
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording

LEAST_WEIGHT = 1e-12
"""A pose that is set aside keeps this weight: its residual's standard deviation is a million times as large."""


def whitener(sigma: Floats, weights: Floats) -> Floats:
    """W with W^T W the inverse covariance, each pose's times its weight; shape (n, k, k).

    Args:
        sigma: Shape (n, k, k).
        weights: Shape (n, k): one per residual; 0 sets it aside.
    """
    spread = 1.0 / np.sqrt(np.maximum(weights, LEAST_WEIGHT))  # a weight divides the variance
    scaled = sigma * spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(scaled)))


class Whitening(NamedTuple):
    """C^-1/2, applied to residuals and slopes."""

    own: Floats
    """Whitener of each pose alone, shape (n, k, k)."""
    shared: Floats | None
    """S, shape (n k, m); None where nothing is shared."""
    inner: Floats
    """V diag(1 / (s (s + 1))) V^T, shape (m, m)."""

    @classmethod
    def of(cls, sigma: Floats, slopes: Floats | None, weights: Floats) -> Whitening:
        """C^-1/2 of poses with noise of their own and errors in common.

        Args:
            sigma: Covariance of each pose's own noise, shape (n, k, k).
            slopes: N: the residuals' derivative by what is shared, in standard deviations, shape (n, k, m); or None.
            weights: Shape (n, k): one per residual; 0 sets it aside.
        """
        own = whitener(sigma, weights)
        if slopes is None:
            return cls(own, None, np.zeros((0, 0)))
        shared = (own @ slopes).reshape(-1, slopes.shape[2])
        squared, V = np.linalg.eigh(shared.T @ shared)
        s = np.sqrt(1.0 + np.maximum(squared, 0.0))  # s^2 = 1 + d^2
        return cls(own, shared, (V / (s * (s + 1.0))) @ V.T)

    def residuals(self, r: Floats) -> Floats:
        """Whitened residuals (n, k), shape (n k,)."""
        return self._coupled((self.own @ r[:, :, None]).reshape(-1))

    def slopes(self, J: Floats) -> Floats:
        """Whitened slopes (n, k, p), shape (n k, p)."""
        return self._coupled((self.own @ J).reshape(-1, J.shape[2]))

    def _coupled(self, x: Floats) -> Floats:
        if self.shared is None:
            return x
        return np.asarray(x - self.shared @ (self.inner @ (self.shared.T @ x)))


class RobustFit(NamedTuple):
    """A fit, and the poses that it used."""

    estimate: Estimate
    tip_kept: Bools
    """Shape (n,): the tip of this pose was used."""
    direction_kept: Bools
    """Shape (n,): its direction was used."""
    iterations: int


class Fitted(NamedTuple):
    """A problem linearised at its fit; errors that the poses share stand behind the free parameters as unknowns."""

    residuals: Floats
    """Shape (n, k), without what the shared errors explain."""
    jacobian: Floats
    """Shape (n, k, p + m): by the free parameters, then by the shared errors, each in its standard deviation."""
    sigma: Floats
    """Expected covariance of each pose's own noise, shape (n, k, k)."""
    white: Floats
    """The residuals of the poses that were used, over their spread, shape (n, k)."""
    covariance: Floats
    """Covariance of the free parameters and the shared errors together, shape (p + m, p + m)."""
    shared: Floats
    """The shared errors' posterior mean, in standard deviations, shape (m,)."""
    whitener: Floats
    """Whitener of each pose's own noise, shape (n, k, k)."""

    @property
    def chi_squared(self) -> float:
        """r^T C^-1 r: the residuals' squares, and what the shared errors cost."""
        return float(np.sum(self.white**2) + self.shared @ self.shared)


def weighed(problem: Problem, fit: RobustFit) -> Fitted:
    """A problem linearised at its fit, with the poses that made it."""
    weights = residual_weights(problem, fit.tip_kept, fit.direction_kept)
    r, J, sigma, N = linear_model(problem, fit.estimate)
    W, p = whitener(sigma, weights), J.shape[2]
    if N is not None:
        J = np.concatenate([J, N], axis=2)
    slopes = (W @ J).reshape(-1, J.shape[2])
    information = slopes.T @ slopes
    information[p:, p:] += np.eye(J.shape[2] - p)
    C = np.asarray(np.linalg.pinv(information, hermitian=True), dtype=np.float64)
    shared = np.zeros(0)
    if N is not None:
        shared = -C[p:] @ (slopes.T @ (W @ r[:, :, None]).reshape(-1))
        r = r + N @ shared
    return Fitted(r, J, sigma, (W @ r[:, :, None])[:, :, 0], C, shared, W)


MAX_STEPS = 50
"""A good start needs five; what has not settled after fifty does not."""

SMALL_STEP = 1e-7
"""A step whose largest part (rad, 100 mm) is smaller ends the refinement: it is off by less than 1e-5 mm."""


class Refined(NamedTuple):
    """Result of the refinement."""

    estimate: Estimate
    iterations: int


def refine(
    problem: Problem, start: Estimate, tip_weights: Weights, direction_weights: Weights, *, max_steps: int = MAX_STEPS
) -> Refined:
    """The estimate of least weighted squares near a start; the pose covariances follow the estimate.

    Args:
        start: Such as the closed form's.
        tip_weights: One per pose for its tip, shape (n,); a flag counts as 1 or 0.
        direction_weights: One per pose for its direction, shape (n,).
        max_steps: The most steps taken.
    """

    def linearised(estimate: Estimate) -> System[Estimate]:
        units = parameter_units(problem.active, estimate.scale)
        weights = residual_weights(problem, tip_weights, direction_weights)
        model = linear_model(problem, estimate)
        whitening = Whitening.of(model.sigma, model.shared, weights)
        white = whitening.residuals(model.residuals)
        return System(
            white,
            whitening.slopes(model.jacobian) * units,
            lambda near: float(np.sum(whitening.residuals(residuals(problem, near)) ** 2)),
        )

    fit = gauss_newton(
        start,
        linearised,
        lambda estimate, step: estimate.moved_by(problem.active, step),
        lambda _, step: bool(np.abs(step).max() < SMALL_STEP),
        max_steps,
    )
    return Refined(fit.estimate, fit.iterations)


SIGNIFICANT = 0.01
"""A recording without such errors is said to have them once in a hundred."""
CLEAR = 3.0
"""An error so many standard deviations from zero is named with the largest one."""

TEXT = ("mm per unit of P along u: {:.3f} times", "along v: {:.3f} times", "skew {:+.2f} deg", "v rotated {:+.2f} deg")


class ImageErrors(NamedTuple):
    """The errors of the image that the residuals show.

    A tip that is read as p lies at S p, S = [[1 + a, k], [0, 1 + b]]: mm per unit of P that are off, axes not square.
    A direction read as v points along S v, rotated by w. The residuals' derivatives by (a, b, k, w) join the Jacobian,
    and the F-test of all of them together says whether residuals that are only noise would be so well explained: once
    in a hundred recordings. The calibration does not use them; what they leave at the tips
    counts in its error.
    """

    names: tuple[str, ...]
    """Names of those that were tested: ``scale_u``, ``scale_v``, ``skew``, ``turn``."""
    found: Floats
    """Shape (k,): a, b, k (per mm) and w (rad)."""
    sd: Floats
    probability: float
    """Chance of residuals so well explained where there are none: F(k, freedom)."""
    rms_mm: float
    """What they leave at the recorded tips, whatever the calibration does to make up for them."""

    @property
    def significant(self) -> bool:
        """Whether the test finds errors of the image."""
        return self.probability < SIGNIFICANT

    def finding(self) -> Finding:
        """One sentence: which errors, how large, how sure, and their effect at the tips."""
        size = np.abs(self.found / self.sd)
        shown = [
            TEXT[NAMES.index(name)].format(1 + value if name in NAMES[:2] else np.degrees(value))
            for name, value, over in zip(self.names, self.found, size, strict=True)
            if over >= min(CLEAR, size.max())
        ]
        text = (
            f"the residuals are more than noise: they fit better with {', '.join(shown)} (F test of "
            f"{len(self.names)} errors of the image, p {self.probability:.2g}), which leaves {self.rms_mm:.2f} mm "
            "(rms) at the tips; the calibration does not use this: columns P_u_px, P_v_px let it estimate mm per pixel"
        )
        numbers = dict(zip(self.names, self.found.tolist(), strict=True))
        return Finding("image_errs", Severity.WARNING, text, {**numbers, "p": self.probability, "rms_mm": self.rms_mm})


NAMES = ("scale_u", "scale_v", "skew", "turn")


def image_errors(problem: Problem, fit: RobustFit) -> ImageErrors | None:
    """The errors of the image at a fit; None where the poses cannot show them."""
    weights = residual_weights(problem, fit.tip_kept, fit.direction_kept)
    model = linear_model(problem, fit.estimate)
    free = SCALE.start not in problem.active
    wanted = np.array([free, free, True, problem.with_direction])
    columns = _columns(problem.recording, fit.estimate, problem.with_direction)[:, :, wanted]
    whitening = Whitening.of(model.sigma, model.shared, weights)
    A, more = whitening.slopes(model.jacobian), whitening.slopes(columns)
    found = lacking(-whitening.residuals(model.residuals), A, more, count=int(weights.sum()))
    if found is None:
        return None
    pulled = np.linalg.lstsq(A, more @ found.found, rcond=None)[0]
    left = (columns @ found.found - model.jacobian @ pulled)[fit.tip_kept, :3]
    rms = float(np.sqrt(np.mean(np.sum(left**2, axis=1))))
    return ImageErrors(tuple(np.array(NAMES)[wanted].tolist()), found.found, found.sd, found.probability, rms)


def _columns(recording: Recording, estimate: Estimate, with_direction: bool) -> NDArray[np.float64]:
    """The residuals' derivatives by a, b, k and w, shape (n, 3 or 5, 4)."""
    tip = linearised_tip(estimate, recording).jacobian[:, :, SCALE] * estimate.scale
    skewed = -(recording.A[:, :3, :3] @ estimate.R_X)[:, :, :1] * (recording.P[:, None, 1:2] * estimate.scale[1])
    columns = np.concatenate([tip, skewed, np.zeros_like(skewed)], axis=2)
    if not with_direction:
        return columns
    c, s, _ = directions_image(recording, estimate).T
    turned = np.stack([-c * s, c * s, -(s**2), np.ones(len(recording))], axis=1)
    rows = np.stack([-turned, np.zeros_like(turned)], axis=1)
    return np.concatenate([columns, rows], axis=1)
