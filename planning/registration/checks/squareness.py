"""Is the CT's frame out of square? A rigid fit beside one of seven parameters: the motion and one named shear.

A scan whose gantry tilt nobody took back, or a table that creeps while it is scanned, shears what it shows, and a
rigid motion leaves that to the residuals. The shear is offered as a check and never applied: a marker that was misread
can look the same. With r the residuals of a fit of six parameters (the motion) or seven (and a shear), C the readings'
covariance:

    F = (SSE_6 - SSE_7) / (SSE_7 / (3 N - 7)),   SSE = r' C^-1 r,   F ~ F(1, 3 N - 7) where the frame is square

for each of the three planes; the best one's probability counts three times (Bonferroni), for three were looked at.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import fdtrc

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits.fit_map import carried, design
from puncture_twin.planning.registration.registration import Registration

PLANES = ((0, 1), (0, 2), (1, 2))
"""Pairs of CT axes: the first runs askew along the second."""

DOUBTED = 0.01
"""Markers of a square frame look so askew once in 100 registrations."""

FLAT = 1e-6
"""Relative length of a shear's column beside a rigid motion below which these markers cannot show it."""


@dataclass(frozen=True)
class Squareness:
    """The plane of the CT's frame that looks least square.

    Attributes:
        axes: Names of its two axes in the case's CT frame.
        skew: k: a point moves by k along the first axis per mm along the second.
        f: The F statistic, with 1 and ``freedom`` degrees.
        freedom: 3 N - 7.
        probability: Of one so large in any of the three planes, if the frame is square.
        rms_mm: Expected error at the target by the residuals of the rigid fit, times the root of its variance.
        rms_square_mm: The same of the fit with the shear.
    """

    axes: tuple[str, str]
    skew: float
    f: float
    freedom: int
    probability: float
    rms_mm: float
    rms_square_mm: float

    @property
    def angle(self) -> float:
        """By which the two axes miss a right angle, rad."""
        return float(abs(np.arctan(self.skew)))

    @property
    def doubted(self) -> bool:
        """Whether axes that are square would seldom look so skewed: then it is reported."""
        return self.probability < DOUBTED

    def text(self) -> str:
        """The finding, in one sentence."""
        first, second = self.axes
        return (
            f"the CT's frame looks {np.degrees(self.angle):.1f} degrees out of square, {first} against {second} "
            f"(F test, p {self.probability:.2g}); without it the expected TRE at the target would be about "
            f"{self.rms_square_mm:.1f} mm instead of {self.rms_mm:.1f}; the registration does not use this"
        )


def check_squareness(registration: Registration, target_ct: Floats) -> Squareness | None:
    """The least square plane of a registration's CT; None where its markers cannot show any.

    Args:
        registration: Of three markers or more. Its declared errors weigh the residuals, where there are any.
        target_ct: Shape (3,), mm, where the error matters.
    """
    problem = _Problem.of(registration)
    found = [one for plane in PLANES if (one := problem.plane(plane, target_ct)) is not None]
    return min(found, key=lambda one: one.probability, default=None)


@dataclass(frozen=True, eq=False)
class _Problem:
    """The rigid fit, whitened: residuals (3 N,), design (3 N, 6), and what leads there; base axes."""

    T_base_ct: Floats
    points_ct: Floats
    root: Floats
    z: Floats
    A: Floats

    @classmethod
    def of(cls, registration: Registration) -> _Problem:
        T, markers, errors = registration.T_base_ct, registration.markers, registration.uncertainty
        fitted = apply(T, markers.points_ct)
        cov = np.eye(fitted.size) if errors is None else errors.noise.covariance(errors.R_base_ct).whole
        root = np.linalg.inv(np.linalg.cholesky(cov))
        A = root @ design(fitted, fitted.mean(axis=0))
        return cls(T, markers.points_ct, root, root @ (markers.points_base - fitted).ravel(), A)

    def plane(self, plane: tuple[int, int], target_ct: Floats) -> Squareness | None:
        """The test of one plane."""
        freedom = len(self.z) - 7
        column = self.root @ self._shear(plane, self.points_ct).ravel()
        left = column - self.A @ np.linalg.lstsq(self.A, column, rcond=None)[0]
        if freedom < 1 or np.linalg.norm(left) <= FLAT * np.linalg.norm(column):
            return None
        rigid, sheared = (self._fit(B, target_ct, plane) for B in (self.A, np.column_stack([self.A, column])))
        f = float((rigid.sse - sheared.sse) / (sheared.sse / freedom)) if sheared.sse > 0 else np.inf
        return Squareness(
            axes=("xyz"[plane[0]], "xyz"[plane[1]]),
            skew=float(sheared.solution[6]),
            f=f,
            freedom=freedom,
            probability=min(1.0, len(PLANES) * float(fdtrc(1, freedom, f))),
            rms_mm=rigid.rms_mm,
            rms_square_mm=sheared.rms_mm,
        )

    def _fit(self, B: Floats, target_ct: Floats, plane: tuple[int, int]) -> _Fit:
        solution = np.asarray(np.linalg.lstsq(B, self.z, rcond=None)[0], dtype=np.float64)
        sse = float(np.sum((self.z - B @ solution) ** 2))
        center = apply(self.T_base_ct, self.points_ct).mean(axis=0)
        at_target = carried(center, apply(self.T_base_ct, target_ct))[:3]
        if B.shape[1] > at_target.shape[1]:
            at_target = np.column_stack([at_target, self._shear(plane, target_ct[None])[0]])
        cov = at_target @ np.linalg.inv(B.T @ B) @ at_target.T * sse / (len(self.z) - B.shape[1])
        return _Fit(solution, sse, float(np.sqrt(np.trace(cov))))

    def _shear(self, plane: tuple[int, int], points_ct: Floats) -> Floats:
        """How points (n, 3) of the CT move in base axes per unit of k, about the markers' centroid, shape (n, 3)."""
        first, second = plane
        return np.outer((points_ct - self.points_ct.mean(axis=0))[:, second], self.T_base_ct[:3, first])


@dataclass(frozen=True, eq=False)
class _Fit:
    """Parameters, whitened sum of squares, and the expected error at the target by it."""

    solution: Floats
    sse: float
    rms_mm: float
