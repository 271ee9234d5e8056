"""CT to robot from markers: their fit, its residuals, and the error to expect at the target.

`register` is the list of its stages. `Aim` is the insertion for which a pose is corrected by what the residuals show of
the arm's errors.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration import fits
from puncture_twin.planning.registration.fit_uncertainty import FitUncertainty, fit_uncertainty
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS, MarkerPairs, check_pairs
from puncture_twin.planning.registration.method import Method, better_names, check_residuals, checked_fit
from puncture_twin.planning.registration.residuals import (
    Conditioning,
    Interval,
    ResidualTest,
    conditioning,
    outlier_marker,
)

ALLOWED_RESIDUALS = "check names and readings, declare the true errors, or set registration.accept_residuals = true"


@dataclass(frozen=True, eq=False)
class Registration(Shown):
    """T_base_ct from markers, and what is known of its error."""

    method: str
    T_base_ct: Floats  # shape (4, 4), rigid, mm
    markers: MarkerPairs
    residuals: Floats  # shape (n, 3), T_base_ct markers_ct - markers_base, mm
    residual_test: ResidualTest
    conditioning: Conditioning
    """The three flags of a weak set, for the target given."""
    target_ct: Floats
    """That target, shape (3,), mm."""
    uncertainty: FitUncertainty | None = None
    """Covariance by the declared errors; None where none are declared."""
    aim: Aim | None = None
    """The insertion for which the pose was corrected by what the residuals show of the arm's errors; None where it was
    not. ``residuals`` are those before the correction."""

    def _facts(self) -> Facts:
        yield "method", self.method
        yield "FRE, FLE", f"{self.fre_mm:.2f} mm, {self.fle_mm:.2f} mm: {self.fle_source}"
        for name, residual in zip(self.markers.names, self.residual_mm, strict=True):
            yield f"residual of {name}", f"{residual:.2f} mm"
        yield "expected at the target", f"{self.expected_tre_mm(self.target_ct[None])[0]:.2f} mm rms"
        for flag in self.flags:
            yield "weak", flag.sentence

    @brief
    def __repr__(self) -> str:
        return f"{self.method}, {len(self.markers.names)} markers, FRE {self.fre_mm:.3f} mm, FLE {self.fle_mm:.3f} mm"

    @property
    def fle_mm(self) -> float:
        """The fiducial localisation error (rms) that the expectations use."""
        return self.residual_test.fle_mm if self.uncertainty is None else self.uncertainty.fle_mm

    @property
    def fle_source(self) -> str:
        """Where `fle_mm` comes from: declared, estimated from FRE, or scaled to the residuals."""
        if self.uncertainty is None:
            return self.residual_test.source
        test = self.uncertainty.test
        return "[errors]" + (f", scaled by {test.scale:.2f} to the residuals" if test.scaled else "")

    @property
    def fle_interval_mm(self) -> Interval:
        """The 95 % interval of that number: one value where it is declared and agrees with the residuals."""
        if self.uncertainty is None:
            return self.residual_test.fle_interval_mm
        test, fle = self.uncertainty.test, self.uncertainty.fle_mm
        if not test.scaled:
            return Interval(fle, fle)
        return Interval(*(fle / test.scale * end for end in test.interval))

    @property
    def flags(self) -> tuple[Finding, ...]:
        """Warnings of what weakens it: conditioning, accepted residuals, an outlier marker, lists of two sizes."""
        found = list(self.conditioning.flags)
        test = self.residual_test if self.uncertainty is None else self.uncertainty.test
        if not (self.residual_test.explained if self.uncertainty is None else self.uncertainty.test.agrees):
            scaled = self.uncertainty is not None and test.explained
            said = test.text() + ("; all errors are scaled to them" if scaled else "; accepted by the case")
            numbers = {"chi_squared": test.chi_squared}
            found.append(Finding("residuals_unexplained", Severity.WARNING, said, numbers))
        if (outlier := outlier_marker(self.markers, self.residual_test.declared_fle_mm)) is not None:
            found.append(outlier.finding())
        if self.distortion is not None and self.distortion.significant:
            found.append(self.distortion.finding())
        return tuple(found)

    @cached_property
    def distortion(self) -> fits.Distortion | None:
        """By what one list seems deformed against the other, significant or not; None where markers cannot show it."""
        noise = None if self.uncertainty is None else self.uncertainty.noise
        return fits.distortion(self.T_base_ct, self.markers, noise, self.target_ct)

    @property
    def residual_mm(self) -> Floats:
        """Length of each marker's residual, shape (n,)."""
        return np.asarray(np.linalg.norm(self.residuals, axis=1))

    @property
    def mean_error_mm(self) -> float:
        """Mean residual over the markers (Chen 2019, Eq. 16)."""
        return float(self.residual_mm.mean())

    @property
    def fre_mm(self) -> float:
        """Root mean square residual. It is not the accuracy at the target."""
        return float(np.sqrt(np.mean(self.residual_mm**2)))

    def expected_tre_mm(self, points_ct: Floats) -> Floats:
        """Expected (rms) target registration error at points (n, 3) of the CT frame, shape (n,), mm.

        By the declared errors of the readings where there are any, else by Fitzpatrick's formula. The arm's own errors,
        which partly cancel between touch and insertion, are not in it.
        """
        return np.sqrt([np.trace(self.tre_covariance(point)) for point in points_ct])

    def tre_covariance(self, point_ct: Floats) -> Floats:
        """Covariance of the registration error at a point (3,) of the CT frame, shape (3, 3), mm^2, base axes."""
        point_base = apply(self.T_base_ct, point_ct)
        if self.uncertainty is not None:
            return self.uncertainty.cov_at(point_base)[:3, :3]
        fitted = apply(self.T_base_ct, self.markers.points_ct)
        center = fitted.mean(axis=0)
        at = fits.carried(center, point_base)[:3] @ fits.least_squares_map(fits.design(fitted, center))
        return np.asarray(self.fle_mm**2 / 3.0 * at @ at.T)

    @property
    def freedom(self) -> int | None:
        """Degrees of freedom of the noise where the residuals gave its size; None where it is declared and agrees."""
        if self.uncertainty is not None:
            return self.uncertainty.test.freedom if self.uncertainty.test.scaled else None
        declared = self.residual_test.declared_fle_mm is not None and self.residual_test.explained
        return None if declared else self.residual_test.freedom

    def expected_tre_interval_mm(self, point_ct: Floats) -> Interval:
        """Expected target registration error (rms) at one point (3,), at both ends of the noise's 95 % interval, mm."""
        expected = float(self.expected_tre_mm(point_ct[None])[0])
        return Interval(*(expected * fle / self.fle_mm for fle in self.fle_interval_mm))


def register(
    markers: MarkerPairs,
    *,
    method: Method,
    target_ct: Floats,
    fle_mm: float | None = None,
    noise: fits.ReadingNoise | None = None,
    noise_found: bool = False,
    accept_residuals: bool = False,
    where: str | Path = "registration",
) -> Registration:
    """Fit T_base_ct, and test its residuals against the noise.

    Args:
        method: ``triad`` (Chen 2019, Eq. 1-9, three markers in the order given), ``rigid`` (least squares),
            ``weighted`` (by the declared noise) or ``joint`` (by that and what the arm does wrong at all markers).
        target_ct: Shape (3,), where the error matters.
        fle_mm: Known localisation error (rms, both sides together); None estimates it from FRE. Not beside ``noise``.
        noise: What is declared of each marker, in the order of ``markers``.
        noise_found: Whether ``noise`` is a shape alone, its size to be found from the residuals.
        accept_residuals: Whether residuals beyond the noise are accepted, and the noise is scaled to them.

    Raises:
        InputError: Markers that cannot be fitted, a method without the noise that it needs, noise that is none, or
            residuals that the noise does not explain.
    """
    # 1. The fit.
    check_pairs(markers, where)
    fre_mm = fits.rigid_fre_mm(markers.points_ct, markers.points_base)
    fit = checked_fit(markers, method, noise, fre_mm if noise_found else None, where=where)
    if method == "triad" and len(markers) != MIN_MARKERS:
        refuse(f"triad takes 3 markers, not {len(markers)}", where, "3 names in use", "wrong_count")
    T_base_ct = fit(markers.points_ct, markers.points_base)
    residuals = apply(T_base_ct, markers.points_ct) - markers.points_base
    check_residuals(markers, residuals, target_ct, where)
    # 2. Its uncertainty, by the declared noise.
    uncertainty = None
    if noise is not None:
        points = markers.points_ct, markers.points_base
        uncertainty = fit_uncertainty(method, fit, T_base_ct, *points, noise, found=noise_found)
        fle_mm = None if noise_found else noise.covariance(T_base_ct[:3, :3]).greatest_fle_mm
    # 3. Whether the noise explains the residuals; if not, what may be wrong.
    test = ResidualTest(len(markers), fre_mm, fle_mm)
    noise_test = test if uncertainty is None else uncertainty.test
    if not (noise_test.explained or accept_residuals):
        outlier = outlier_marker(markers, fle_mm)
        what = noise_test.text() if outlier is None else f"{noise_test.text()}; {outlier.text()}"
        what += better_names(markers, target_ct, fre_mm)
        deformed = fits.distortion(T_base_ct, markers, noise, target_ct)
        what += f"; {deformed.brief()}" if deformed is not None and deformed.significant else ""
        refuse(what, where, ALLOWED_RESIDUALS, "residuals_too_large")
    # 4. Whether the markers suit the target: spread, leverage.
    weak = conditioning(markers.points_ct, target_ct)
    return Registration(method, T_base_ct, markers, residuals, test, weak, target_ct, uncertainty)


@dataclass(frozen=True, eq=False)
class Aim:
    """The insertion for which a pose is corrected."""

    target_ct: Floats  # shape (3,), mm
    q: Floats  # shape (6,), rad, the tip on the target
    arm_jacobian: Floats  # shape (6, 28), J_f: motion of the needle there per arm parameter, base axes

    def response(self, noise: fits.ReadingNoise, weights: Floats) -> Floats:
        """Correction of the pose at the target per residual of weights W (..., 3 N, 3 N), shape (..., 6, 3 N).

        J_f Sigma_eta J' W, with Sigma_eta, J the arm's parameters and their effect on the touches.
        """
        return np.asarray((self.arm_jacobian * noise.eta_variances) @ noise.arm_jacobian.T @ weights)


def aim_at(model: UrModel, tip_mm: float, target_ct: Floats, q: Floats) -> Aim:
    """The aim of an insertion in configuration q (6,), rad, at a target (3,), mm."""
    return Aim(target_ct, q, error_jacobian(model, q, tip_mm))


TILTS_DEG = (0.0, 15.0, 30.0, 45.0, 60.0, 75.0)
"""Puncture angles that are tried for an insertion that the arm reaches, in this order."""
AZIMUTHS = 12
"""Directions tried at each."""


def reached_insertion(case: Case, T_base_ct: Floats) -> Floats | None:
    """Joints (6,), rad, that put the tip on the target, at the least puncture angle tried; None where none do.

    Kinematics alone, to estimate an error: organs and collisions are not checked.
    """
    model, target = case.robot.model, apply(T_base_ct, case.target_ct)
    for tilt in np.radians(TILTS_DEG):
        azimuths = np.linspace(0, 2 * np.pi, AZIMUTHS if tilt else 1, endpoint=False)
        local = np.array([outward(float(tilt), float(azimuth)) for azimuth in azimuths])
        directions = local @ (T_base_ct[:3, :3] @ case.T_ct_entry[:3, :3]).T
        q = inverse(model, flange_poses(target, directions, case.needle.length_mm)).reshape(-1, 6)
        q = nearest_within_limits(model, q, np.zeros(6))
        q = q[~np.isnan(q).any(axis=1)]
        q = q[away_from_singularities(model, q)]
        if len(q):
            return np.asarray(q[0])
    return None
