"""From the image to the calibration frame: c_T_m by markers that both cameras see, and the error to expect at a target.

Each marker errs in the image and in the cameras, and the cameras err most along their view. The fit weighs each marker
by both covariances (maximum likelihood; Gauss-Newton from the plain rigid fit), and its normal matrix says how far the
mapped target may be off. With equal round errors both agree with the plain fit and Fitzpatrick's formula.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.gauss_newton import System, gauss_newton
from puncture_twin.planning.geometry.rigid import apply, rotated_about
from puncture_twin.planning.registration.conditioning import Conditioning
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.registration import register

MAX_ITERATIONS = 20
CONVERGED = 1e-12
"""A step of the fit (mm and rad) below which it has arrived."""


class SeenMarkers(NamedTuple):
    """Markers as the cameras have them."""

    points_c: Floats
    """Shape (n, 3), mm."""
    covariances: Floats
    """Shape (n, 3, 3), mm^2."""


@dataclass(frozen=True, eq=False)
class Mapping:
    """c_T_m and what is known of its error.

    Attributes:
        T_c_m: Shape (4, 4), rigid, mm.
        covariance: Shape (6, 6), of a turn (rad) about ``center_c`` and a shift (mm), axes of C.
        center_c: Shape (3,), the markers' centre, mm.
        residuals: Shape (n, 3), T_c_m markers_m - markers_c, mm.
        conditioning: The flags of a weak marker set, at the middle of the targets.
    """

    T_c_m: Floats
    covariance: Floats
    center_c: Floats
    residuals: Floats
    conditioning: Conditioning

    @property
    def fre_mm(self) -> float:
        """Root mean square residual. It is not the accuracy at the target."""
        return float(np.sqrt(np.mean(np.sum(self.residuals**2, axis=1))))

    def to_c(self, points_m: Floats) -> Floats:
        """Points (..., 3) of the image frame, in C, mm."""
        return apply(self.T_c_m, points_m)

    def covariance_at(self, points_m: Floats) -> Floats:
        """Covariance of mapped points (n, 3), shape (n, 3, 3), mm^2, C."""
        slope = turn_and_shift_slopes(self.to_c(points_m) - self.center_c)
        return np.asarray(slope @ self.covariance @ slope.transpose(0, 2, 1))

    def expected_tre_mm(self, points_m: Floats, target_mm: float = 0.0) -> Floats:
        """Expected (rms) error at points (n, 3) of the image frame, shape (n,), mm.

        Args:
            points_m: Where.
            target_mm: Standard deviation per axis with which the image has a target itself.
        """
        variance = np.trace(self.covariance_at(points_m), axis1=1, axis2=2) + 3 * target_mm**2
        return np.asarray(np.sqrt(variance))


def map_head(
    names: tuple[str, ...],
    seen: SeenMarkers,
    markers_m: Floats,
    image_mm: float,
    targets_m: Floats,
    *,
    where: str | Path = "mapping",
) -> Mapping:
    """Fit c_T_m.

    Args:
        names: The markers, n at least 3.
        seen: What the cameras have.
        markers_m: Shape (n, 3), mm: what the image has.
        image_mm: Standard deviation per axis of ``markers_m``.
        targets_m: Shape (k, 3), mm: where the error matters.
        where: What errors name.

    Raises:
        InputError: Fewer than three markers, collinear, mirrored, a unit slip, or a marker far off.
    """
    pairs = MarkerPairs(names, np.asarray(markers_m, dtype=np.float64), seen.points_c)
    plain = register(pairs, method="rigid", target_ct=np.mean(targets_m, axis=0), where=where)
    covariances, center = seen.covariances + max(image_mm, 1e-9) ** 2 * np.eye(3), seen.points_c.mean(axis=0)
    roots = np.linalg.inv(np.linalg.cholesky(covariances))

    def linearised(T: Floats) -> System[Floats]:
        fitted = apply(T, pairs.points_ct)
        slopes = roots @ turn_and_shift_slopes(fitted - center)
        return System((roots @ (fitted - seen.points_c)[:, :, None]).ravel(), slopes.reshape(-1, 6))

    def moved(T: Floats, step: Floats) -> Floats:
        return rotated_about(T, center, step)

    fit = gauss_newton(plain.T_base_ct, linearised, moved, _arrived, MAX_ITERATIONS)
    residuals = apply(fit.estimate, pairs.points_ct) - seen.points_c
    covariance = np.asarray(np.linalg.inv(fit.system.information), dtype=np.float64)
    return Mapping(fit.estimate, covariance, center, residuals, plain.conditioning)


def _arrived(_: System[Floats], step: Floats) -> bool:
    return bool(np.abs(step).max() < CONVERGED)


def turn_and_shift_slopes(offsets: Floats) -> Floats:
    """Derivative (n, 3, 6) of points by a turn about a centre and a shift; ``offsets`` (n, 3), mm, from that centre."""
    x, y, z = offsets.T
    zero = np.zeros_like(x)
    turn = np.stack([np.stack(row, axis=-1) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], axis=1)
    return np.concatenate([turn, np.broadcast_to(np.eye(3), turn.shape)], axis=2)
