"""What a rigid motion leaves of all points: per axis of the CT, against a declaration, and by one strain.

With z the stacked residuals in CT axes, A the motion's design and C the declaration's covariance:

    chi^2 = z' P z,   P = C^-1 - C^-1 A (A' C^-1 A)^-1 A' C^-1,   3 p - 6 degrees of freedom for p points,

and a strain that moves the points by k b takes (b' M z)^2 / (b' M b) off the sum of squares, M = I - A (A' A)^-1 A'.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType

import numpy as np
from scipy.linalg import block_diag

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.least_squares import design, fit_rigid
from puncture_twin.twin.experiment.declarations import Declaration
from puncture_twin.twin.experiment.printed import READ, SETUPS, rows_of

POINTS = tuple("".join(touched) for touched in SETUPS)
"""Names of the points of each setup."""

FREEDOM = sum(3 * len(names) - 6 for names in POINTS)
"""24: of both setups together."""

STRAINS: Mapping[str, tuple[int, int]] = MappingProxyType(
    {
        "scale of x": (0, 0),
        "scale of y": (1, 1),
        "scale of z": (2, 2),
        "x against y": (0, 1),
        "x against z": (0, 2),
        "y against z": (1, 2),
    }
)
"""What one number may be wrong with a CT's frame: an axis that moves along another, or along itself."""


def rigid_residuals(touched: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Of each setup: touched minus fitted by all its points, CT axes, shape (n, p, 3), from touches (n, 8, 3), mm."""
    found = []
    for names, points in zip(POINTS, touched, strict=True):
        rows = rows_of(names)
        T = fit_rigid(np.broadcast_to(READ[rows], (len(points), len(rows), 3)), points[:, rows])
        fitted = READ[rows] @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        found.append((points[:, rows] - fitted) @ T[:, :3, :3])
    return tuple(found)


def axis_squares(residuals: tuple[Floats, ...]) -> Floats:
    """Sums of squares per axis of the CT, both setups, shape (n, 3), mm^2."""
    return np.asarray(sum(np.sum(one**2, axis=1) for one in residuals))


def chi_squared(residuals: tuple[Floats, ...], declaration: Declaration) -> Floats:
    """Of both setups against a declaration, shape (n,); `FREEDOM` degrees. Both touch one carton: C is not diagonal."""
    rows = np.array([row for names in POINTS for row in rows_of(names)])
    axes = (3 * rows[:, None] + np.arange(3)).ravel()
    cov = declaration.carton_covariance(READ)[np.ix_(axes, axes)] + declaration.touch_mm**2 * np.eye(len(axes))
    A, weights = block_diag(*(_design(names) for names in POINTS)), np.linalg.inv(cov)
    P = weights - weights @ A @ np.linalg.solve(A.T @ weights @ A, A.T @ weights)
    z = np.concatenate([one.reshape(len(one), -1) for one in residuals], axis=1)
    return np.asarray(np.einsum("na,ab,nb->n", z, P, z))


def _design(names: str) -> Floats:
    points = READ[rows_of(names)]
    return design(points, points.mean(axis=0))


def strain_gains(residuals: tuple[Floats, ...]) -> dict[str, Floats]:
    """Fraction of both setups' sum of squares that each strain alone takes away, shape (n,) each."""
    whole = axis_squares(residuals).sum(axis=1)
    gains = {}
    for name, (moved, along) in STRAINS.items():
        # one number for both setups: numerator and denominator add up before the square
        dot, norm = np.zeros(len(whole)), 0.0
        for names, one in zip(POINTS, residuals, strict=True):
            points = READ[rows_of(names)] - READ[rows_of(names)].mean(axis=0)
            b = np.zeros(points.shape)
            b[:, moved] = points[:, along]
            A = design(points, np.zeros(3))
            left = b.ravel() - A @ np.linalg.lstsq(A, b.ravel(), rcond=None)[0]
            dot, norm = dot + one.reshape(len(one), -1) @ left, norm + float(left @ left)
        gains[name] = dot**2 / norm / whole
    return gains
