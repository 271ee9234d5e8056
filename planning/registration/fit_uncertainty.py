"""What a registration's method makes of the declared errors of its markers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.least_squares import carried, design, differenced_map, least_squares_map
from puncture_twin.planning.registration.reading_noise import ReadingNoise
from puncture_twin.planning.registration.residual_test import NoiseTest, noise_test


@dataclass(frozen=True, eq=False)
class FitUncertainty:
    """The declared errors of the markers, and the map from them to the pose; base axes, mm and rad.

    Attributes:
        noise: Of the markers.
        R_base_ct: Shape (3, 3), as registered.
        center_base: Shape (3,), the markers' centroid, about which `fit_map` turns.
        fit_map: L, shape (6, 3 N), from the stacked reading errors to shift and rotation.
        test: Whether the residuals agree with the declaration; its scale is not yet in the covariances below.
    """

    noise: ReadingNoise
    R_base_ct: Floats
    center_base: Floats
    fit_map: Floats
    test: NoiseTest

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
    """The uncertainty of a pose that a method fitted.

    Args:
        method: ``rigid``, ``weighted`` and ``joint`` have a formula; of others ``fit`` is differenced.
        fit: From points (N, 3) in both frames to T_base_ct.
        T_base_ct: Shape (4, 4), what it gave.
        points_ct: Shape (N, 3), mm.
        points_base: Shape (N, 3), mm.
        noise: Of the markers.
        found: Whether the residuals give the errors' size.
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
