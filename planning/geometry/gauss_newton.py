"""Least squares for whichever value is estimated: whitening, Gauss-Newton damped where a step fails, and an F-test.

At an estimate x the residuals r, each in its standard deviation, have the slopes J. A step s solves

    (J^T J + d l I) s = -J^T r

along the axes (eigenvectors) of J^T J that are more than rounding; l is its largest eigenvalue, and the damping d is 0
until a step raises the cost |r|^2 (Levenberg-Marquardt). The estimate may be of any kind that can be moved, and the
weights may follow it. Where it is a vector and the weights are fixed, `scipy.optimize.least_squares` serves.

Whitening. Residuals come in rows, each with a noise Omega_i of its own, whitened alone. Errors that all rows share (N
per standard deviation of each) couple them: the residuals' covariance is C = Omega + N N^T, and with S = Omega^-1/2 N

    C^-1/2 = (I + S S^T)^-1/2 Omega^-1/2,   (I + S S^T)^-1/2 = I - S V diag(1 / (s (s + 1))) V^T S^T,   s^2 = 1 + d^2,

where S^T S = V diag(d^2) V^T. The same estimate comes from taking the shared errors as unknowns with a prior.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Generic, NamedTuple, TypeVar

import numpy as np
from scipy.special import fdtrc

from puncture_twin.planning.base.arrays import Bools, Floats

X = TypeVar("X")
"""Type of the estimate."""
NO_PIVOT = 1e-15
"""An eigenvalue of the normal equations below this fraction of the largest is rounding: no step is made along it."""
SMALL_GAIN, NOT_HIGHER = 1e-10, 1 + 1e-12
"""A step that would lower the cost by a smaller fraction is not made: the fit has settled. And a cost that rises by no
more than rounding has not risen."""
MOST_DAMPINGS = 30
"""Dampings of one step; from 1e-6 by tens, far beyond any step that moves the estimate."""
UNSEEN = 1e-6
"""Relative length of a column outside of the model's own below which the data cannot show it."""
LEAST_WEIGHT = 1e-12
"""A residual that is set aside has this weight: its standard deviation is a million times as large."""


def whitener(sigma: Floats, weights: Floats) -> Floats:
    """W (n, k, k) with W^T W the inverse of sigma (n, k, k), each times its weight (n, k); 0 sets a residual aside."""
    spread = 1.0 / np.sqrt(np.maximum(weights, LEAST_WEIGHT))  # a weight divides the variance
    scaled = sigma * spread[:, :, None] * spread[:, None, :]
    return np.asarray(np.linalg.inv(np.linalg.cholesky(scaled)))


class Whitening(NamedTuple):
    """C^-1/2 of residuals in n rows of k, which share m errors."""

    own: Floats  # whitener of each row alone, shape (n, k, k)
    shared: Floats | None  # S, shape (n k, m); None where nothing is shared
    inner: Floats  # V diag(1 / (s (s + 1))) V^T, shape (m, m)

    @classmethod
    def of(cls, sigma: Floats, slopes: Floats | None, weights: Floats) -> Whitening:
        """C^-1/2 of rows with noise of their own, sigma (n, k, k), and shared errors, N (n, k, m); weights (n, k)."""
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
        return x if self.shared is None else np.asarray(x - self.shared @ (self.inner @ (self.shared.T @ x)))


class System(NamedTuple, Generic[X]):
    """A problem, linearised at an estimate."""

    residuals: Floats  # shape (m,), in standard deviations
    slopes: Floats  # shape (m, p): their derivative by the unknowns
    cost: Callable[[X], float] | None = None
    """Sum of the squared residuals near the estimate, under its weights: a step that raises it is damped.

    None: each step is made as it is, so a start that is far off does not settle.
    """

    @property
    def information(self) -> Floats:
        """Fisher's information J^T J, shape (p, p)."""
        return np.asarray(self.slopes.T @ self.slopes)


class Fit(NamedTuple, Generic[X]):
    """Result of Gauss-Newton."""

    estimate: X
    system: System[X]  # linearised where the last step began
    step: Floats  # shape (p,): the last step, in the unknowns' units; 0 where none was left to make
    iterations: int
    settled: bool  # whether it arrived within the steps it was given
    determined: bool  # whether no unknown was left alone by the last step


def gauss_newton(
    start: X,
    linearised: Callable[[X], System[X]],
    moved: Callable[[X, Floats], X],
    arrived: Callable[[System[X], Floats], bool],
    most_steps: int,
) -> Fit[X]:
    """The estimate of least squares near a start.

    Args:
        moved: An estimate with a step (p,) added.
        arrived: Whether a step (p,) of a system is so small that the next would not matter.

    Raises:
        numpy.linalg.LinAlgError: The system holds what is no number.
    """
    estimate, damping = start, 0.0
    for iteration in range(1, most_steps + 1):
        system = linearised(estimate)
        normal = _Normal.of(system)
        step, estimate, damping = _descend(normal, system, estimate, moved, damping)
        if not step.any() or arrived(system, step):
            return Fit(estimate, system, step, iteration, True, bool(normal.known.all()))
    return Fit(estimate, system, step, most_steps, False, bool(normal.known.all()))


class _Normal(NamedTuple):
    """The normal equations, along their own axes."""

    values: Floats
    axes: Floats
    pull: Floats
    known: Bools

    @classmethod
    def of(cls, system: System[X]) -> _Normal:
        information = system.information
        if not np.isfinite(information).all():
            raise np.linalg.LinAlgError("the normal equations are not finite")
        values, axes = np.linalg.eigh(information)  # ascending
        return cls(values, axes, axes.T @ (system.slopes.T @ system.residuals), values > NO_PIVOT * values[-1])

    def step(self, damping: float) -> Floats:
        """The step under a damping, shape (p,)."""
        damped = np.where(self.known, self.values + damping * self.values[-1], 1.0)  # 1 only avoids a division by 0
        return np.asarray(-self.axes @ (np.where(self.known, 1.0 / damped, 0.0) * self.pull))


def _descend(
    normal: _Normal, system: System[X], estimate: X, moved: Callable[[X, Floats], X], damping: float
) -> tuple[Floats, X, float]:
    """A step that lowers the cost, the estimate after it, and the next damping; a step of 0 where none lowers it."""
    if system.cost is None:
        step = normal.step(damping)
        return step, moved(estimate, step), damping
    before = float(system.residuals @ system.residuals)
    gain = np.sum(normal.pull[normal.known] ** 2 / normal.values[normal.known])  # of the undamped step, if linear
    if gain > SMALL_GAIN * before:
        for _ in range(MOST_DAMPINGS):
            step = normal.step(damping)
            after = moved(estimate, step)
            if system.cost(after) <= before * NOT_HIGHER:
                return step, after, damping / 10 if damping > 1e-9 else 0.0  # trust the model more again
            damping = max(10 * damping, 1e-6)
    return np.zeros(len(normal.values)), estimate, damping


class Lacking(NamedTuple):
    """Explanation of a linear model's residuals by k unknowns that it lacks."""

    found: Floats  # shape (k,): their values
    sd: Floats  # shape (k,): their standard deviations, by the residuals that they leave
    probability: float
    """Chance of residuals that they explain so well, where all are zero: F(k, freedom)."""
    freedom: int  # residuals less p and k
    variance: float  # of one residual, with them
    variance_without: float  # of one residual, in the model without them


def lacking(z: Floats, A: Floats, more: Floats, *, count: int | None = None) -> Lacking | None:
    """The F-test of z = A x + more y + noise against y = 0; None where the data cannot show y.

    Args:
        z: Shape (m,), in standard deviations (of one common size, which need not be known).
        A: Shape (m, p): columns of the model.
        more: Shape (m, k): columns that it lacks.
        count: How many residuals count, where others have next to no weight; None for all.
    """
    basis, values, _ = np.linalg.svd(A, full_matrices=False)
    basis = basis[:, values > UNSEEN * values[0]]  # columns that depend on others count once
    outside, left = more - basis @ (basis.T @ more), z - basis @ (basis.T @ z)
    (m, k), p = more.shape, basis.shape[1]
    m = m if count is None else count
    freedom = m - p - k
    size = np.linalg.norm(more, axis=0)
    if freedom < 1 or not (size > 0.0).all():
        return None
    shown = np.linalg.svd(outside / size, compute_uv=False)
    if not shown[-1] > UNSEEN:
        return None
    found = np.asarray(np.linalg.lstsq(outside, left, rcond=None)[0], dtype=np.float64)
    before, after = float(left @ left), float(np.sum((left - outside @ found) ** 2))
    f = np.inf if after == 0.0 else (before - after) / k / (after / freedom)  # explained over left, by degree
    sd = np.sqrt(after / freedom * np.diag(np.linalg.inv(outside.T @ outside)))
    return Lacking(found, sd, float(fdtrc(k, freedom, max(f, 0.0))), freedom, after / freedom, before / (m - p))
