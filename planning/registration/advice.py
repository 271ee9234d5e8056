"""What would make a registration better: which marker to leave out, and where one more would help most."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.arm.inverse_kinematics import branch_of
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import carried, design
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS
from puncture_twin.planning.registration.noise_test import noise_test
from puncture_twin.planning.registration.registration import Registration

APART_MM = 20.0
"""One more marker is no nearer than this to those that are there."""


@dataclass(frozen=True)
class WithoutMarker:
    """A registration without one of its markers.

    Attributes:
        name: The one left out.
        rms_mm: Expected error at the target by the readings of the others, scaled as the registration's is.
        probability: Of residuals as large as those of the others, if the declaration holds; NaN where three are left
            and two are not enough.
    """

    name: str
    rms_mm: float
    probability: float


@dataclass(frozen=True, eq=False)
class OneMore:
    """Where a further marker would help most.

    Attributes:
        point_ct: Shape (3,), mm.
        rms_mm: Expected error at the target with it, by the readings, scaled likewise.
    """

    point_ct: Floats
    rms_mm: float


def without_each(registration: Registration, target_ct: Floats) -> tuple[WithoutMarker, ...]:
    """What each marker's absence would do; empty with three markers or without declared errors."""
    uncertainty, markers = registration.uncertainty, registration.markers
    if uncertainty is None or len(markers) <= MIN_MARKERS:
        return ()
    fitted = apply(registration.T_base_ct, markers.points_ct)
    target, residuals = apply(registration.T_base_ct, target_ct), markers.points_base - fitted
    omega, shared = uncertainty.noise.covariance(uncertainty.R_base_ct)
    whole = omega + shared
    found = []
    for row, name in enumerate(markers.names):
        kept = np.delete(np.arange(len(markers)), row)
        axes = (3 * kept[:, None] + np.arange(3)).ravel()
        A, center = design(fitted[kept], fitted[kept].mean(axis=0)), fitted[kept].mean(axis=0)
        rms = uncertainty.test.scale * _rms(A.T @ np.linalg.inv(omega[np.ix_(axes, axes)]) @ A, center, target)
        test = noise_test(residuals[kept].ravel(), whole[np.ix_(axes, axes)], A)
        found.append(WithoutMarker(name, rms, test.probability))
    return tuple(found)


def one_more(registration: Registration, target_ct: Floats, skin_points_ct: Floats) -> OneMore | None:
    """Where on the skin a further marker, read and touched like the others, would leave the least error.

    Args:
        registration: With declared errors; None is returned without them.
        target_ct: Shape (3,).
        skin_points_ct: Shape (n, 3), where a marker could sit, mm.
    """
    uncertainty, markers = registration.uncertainty, registration.markers
    points = skin_points_ct
    gaps = np.linalg.norm(points[:, None] - markers.points_ct, axis=2).min(axis=1, initial=np.inf)
    points = points[gaps >= APART_MM]
    if uncertainty is None or not len(points):
        return None
    T, fitted = registration.T_base_ct, apply(registration.T_base_ct, markers.points_ct)
    center, omega = fitted.mean(axis=0), uncertainty.noise.covariance(uncertainty.R_base_ct).independent
    A = design(fitted, center)
    known = A.T @ np.linalg.inv(omega) @ A
    weight = np.linalg.inv(uncertainty.noise.blocks(uncertainty.R_base_ct).mean(axis=0))
    more = design(apply(T, points), center).reshape(-1, 3, 6)
    X = carried(center, apply(T, target_ct))[:3]
    covs = X @ np.linalg.inv(known + np.swapaxes(more, 1, 2) @ weight @ more) @ X.T
    best = int(np.argmin(np.trace(covs, axis1=1, axis2=2)))
    return OneMore(points[best], uncertainty.test.scale * float(np.sqrt(np.trace(covs[best]))))


def odd_branches(registration: Registration, model: UrModel) -> tuple[str, ...]:
    """Markers touched in another branch of the arm than most: what it does wrong there does not cancel."""
    markers = registration.markers
    if markers.joints is None:
        return ()
    branches = branch_of(model, markers.joints).tolist()
    usual = max(set(branches), key=branches.count)
    return tuple(name for name, branch in zip(markers.names, branches, strict=True) if branch != usual)


def _rms(information: Floats, center: Floats, point: Floats) -> float:
    X = carried(center, point)[:3]
    return float(np.sqrt(np.trace(X @ np.linalg.inv(information) @ X.T)))
