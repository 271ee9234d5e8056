"""The patient's pose for the robot, T_base_ct, from markers or from the stated mount, and its expected error.

A pose corrected for what its own residuals tell of the arm: pose and arm errors estimated together.

Stacked readings are off by z = n - J eta, of covariance C = Omega + J Sigma_eta J'. With W = C^-1, L = (A' W A)^-1 A' W
and the residuals r = M z, M = I - A L, the arm's parameters are expected to be

    E[eta | r] = -Sigma_eta J' W r,

and the needle at an insertion, whose Jacobian is J_f, to be displaced by J_f E[eta | r]. The pose is moved by the
opposite. It is linear in z as every fit is, and M A = 0 leaves it unbiased:

    X L'' = X L + J_f Sigma_eta J' W M

stands in place of X L in every covariance. This is Gauss-Newton over pose and eta, with eta's declared prior. It is the
best for the one insertion whose J_f was taken, and honest for all others.

What would make a registration better: which marker to leave out, and where one more would help most.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import branch_of, inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import away_from_singularities, error_jacobian, flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, read_only
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.tables import MarkerSection
from puncture_twin.planning.formats.points import NamedPoints, parse_points
from puncture_twin.planning.geometry.rigid import apply, exp_rotation, pose
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.fits import (
    Aim,
    FitUncertainty,
    ReadingNoise,
    carried,
    design,
    fit_joint,
    noise_test,
)
from puncture_twin.planning.registration.marker_noise import marker_noise
from puncture_twin.planning.registration.marker_pairs import MIN_MARKERS, match
from puncture_twin.planning.registration.registration import Registration, register

MAX_AIM_OFF_MM = 20.0
"""A plan's joints are at the target as it was corrected then: no nominal arm errs by so much."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The belief of where CT and base are to each other."""

    T_base_ct: Floats  # shape (4, 4), mm
    registration: Registration | None  # how markers gave it, or None where the case states a mount
    target_error_mm: float  # expected (rms) error at the target, NaN without markers


def load_placement(case: Case) -> Placement | None:
    """Register the case's markers, or take its mount; None where it has neither.

    Raises InputError: Marker files that cannot be read, matched or trusted.
    """
    if case.registration is None:
        mount = case.robot.T_base_ct_mount
        return None if mount is None else Placement(mount, None, float("nan"))
    settings = case.registration
    registration = registered(case, settings)
    if settings.correct:
        registration = corrected(case, registration, where=f"{case.path}: registration")
    error = float(registration.expected_tre_mm(case.target_ct[None])[0])
    return Placement(registration.T_base_ct, registration, error)


def registered(case: Case, settings: MarkerSection) -> Registration:
    """The registration of two lists of markers as a case states it, uncorrected; raises as `load_placement`."""
    where, errors = f"{case.path}: registration", case.errors
    method = "joint" if settings.correct else settings.method or default_method(errors)
    in_ct, in_base = _points(case, settings.markers_ct, case.space), _points(case, settings.markers_base, Space.LOCAL)
    markers = match(in_ct, in_base, use=settings.use, where=where)
    return register(
        markers,
        method=method,
        target_ct=case.target_ct,
        fle_mm=settings.fle_mm if errors is None else None,
        noise=None if errors is None else marker_noise(case, errors, markers, where=where),
        noise_found=errors is not None and errors.found,
        accept_residuals=settings.accept_residuals,
        where=where,
    )


def corrected(case: Case, registration: Registration, *, where: str | Path) -> Registration:
    """A joint registration whose aim is corrected for the insertion that the case states, or for one that is reached.

    Raises InputError: No joints at the touches, or a stated insertion that is not at the target, or none is reached.
    """
    if registration.markers.joints is None:
        message = "correct = true, but the touches have no joint angles: they give no information on the arm's errors"
        refuse(message, where, "q1_deg to q6_deg in markers_base; or correct = false", "no_touch_joints")
    assert case.registration is not None  # its markers were registered
    model, tip, stated = case.robot.model, case.needle.length_mm, case.registration.correct_joints_deg
    if stated is None:
        q = reached_insertion(case, registration.T_base_ct)
        if q is None:
            message = "correct = true, but the arm reaches the target in none of the directions tried"
            refuse(message, where, "correct_joints_deg, the joints at the end of the insertion", "out_of_reach")
    else:
        q = np.radians(np.asarray(stated))
        T = flange_pose(model, q)
        away = float(np.linalg.norm(T[:3, 3] + tip * T[:3, 2] - apply(registration.T_base_ct, case.target_ct)))
        if away > MAX_AIM_OFF_MM:
            allowed = f"within {MAX_AIM_OFF_MM:g} mm: joints at the end of an insertion, with this needle"
            refuse(f"correct_joints_deg put the tip {away:.1f} mm from the target", where, allowed, "aim_beside_target")
    return aimed(registration, aim_at(model, tip, case.target_ct, q))


def default_method(errors: ErrorModel | None) -> Literal["rigid", "weighted"]:
    """Weighted where markers are declared to be read better along some axes than along others."""
    return "weighted" if errors is not None and errors.anisotropic else "rigid"


def _points(case: Case, name: str, space: Space) -> NamedPoints:
    return parse_points(case.files.content(name), case.folder / name, default_space=space)


def aimed_fit(points_ct: Floats, points_base: Floats, noise: ReadingNoise, T_start: Floats, aim: Aim) -> Floats:
    """T_base_ct, shape (..., 4, 4), of pose and arm together, corrected for one insertion; as `fit_joint` otherwise."""
    return _aimed(fit_joint(points_ct, points_base, noise, T_start), points_ct, points_base, noise, aim)


def _aimed(T_base_ct: Floats, points_ct: Floats, points_base: Floats, noise: ReadingNoise, aim: Aim) -> Floats:
    """Joint fits (..., 4, 4) moved at the target by what their residuals tell of the arm."""
    R = T_base_ct[..., :3, :3]
    t = T_base_ct[..., None, :3, 3]
    residuals = points_base - points_ct @ np.swapaxes(R, -1, -2) - t
    weights = np.asarray(np.linalg.inv(noise.covariance(R).whole), dtype=np.float64)
    stacked = residuals.reshape(*residuals.shape[:-2], -1, 1)
    step = (aim.response(noise, weights) @ stacked)[..., 0]
    at = (R @ aim.target_ct) + t[..., 0, :]
    dR = exp_rotation(step[..., 3:])
    return pose(dR @ R, (dR @ (t[..., 0, :] - at)[..., None])[..., 0] + at + step[..., :3])


def aimed(registration: Registration, aim: Aim) -> Registration:
    """A joint registration, corrected for one insertion; its residuals stay those of the fit."""
    fit, markers = registration.uncertainty, registration.markers
    assert fit is not None  # a joint fit weighs by declared errors
    T = read_only(_aimed(registration.T_base_ct, markers.points_ct, markers.points_base, fit.noise, aim))
    target = apply(registration.T_base_ct, aim.target_ct)
    uncertainty = aimed_uncertainty(fit, markers.points_ct, T, target, aim)
    return replace(registration, T_base_ct=T, uncertainty=uncertainty, aim=aim)


def aimed_uncertainty(
    fit: FitUncertainty, points_ct: Floats, T_base_ct: Floats, target_base: Floats, aim: Aim
) -> FitUncertainty:
    """The uncertainty of a joint fit of markers (N, 3), mm, whose pose was corrected.

    ``T_base_ct`` (4, 4) is the corrected pose, ``target_base`` (3,), mm, where it was turned about.
    """
    A = design(apply(T_base_ct, points_ct), fit.center_base)
    M = np.eye(len(A)) - A @ fit.fit_map
    weights = np.asarray(np.linalg.inv(fit.noise.covariance(fit.R_base_ct).whole), dtype=np.float64)
    at_center = carried(target_base, fit.center_base)  # the inverse of what carries from there to the target
    fit_map = fit.fit_map + at_center @ aim.response(fit.noise, weights) @ M
    return replace(fit, R_base_ct=T_base_ct[:3, :3], fit_map=np.asarray(fit_map))


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


APART_MM = 20.0
"""Least distance of a further marker from those that are there."""


@dataclass(frozen=True)
class WithoutMarker:
    """A registration without one of its markers."""

    name: str
    rms_mm: float
    """Expected error at the target by the readings of the others, scaled as the registration's is."""
    probability: float
    """Of residuals as large as those of the others, if the declaration holds; NaN where three are left and two are not
    enough."""


@dataclass(frozen=True, eq=False)
class OneMore:
    """The place on the skin where a further marker would help most."""

    point_ct: Floats  # shape (3,), mm
    rms_mm: float
    """Expected error at the target with it, by the readings, scaled to the residuals where they are."""


def without_each(registration: Registration, target_ct: Floats) -> tuple[WithoutMarker, ...]:
    """Expected error without each marker in turn; empty with three markers or without declared errors."""
    uncertainty, markers = registration.uncertainty, registration.markers
    if uncertainty is None or len(markers) <= MIN_MARKERS:
        return ()
    fitted = apply(registration.T_base_ct, markers.points_ct)
    target, residuals = apply(registration.T_base_ct, target_ct), markers.points_base - fitted
    omega, shared = uncertainty.noise.covariance(uncertainty.R_base_ct)
    whole = omega + shared
    without = []
    for row, name in enumerate(markers.names):
        others = np.delete(np.arange(len(markers)), row)
        axes = (3 * others[:, None] + np.arange(3)).ravel()
        A, center = design(fitted[others], fitted[others].mean(axis=0)), fitted[others].mean(axis=0)
        information, X = A.T @ np.linalg.inv(omega[np.ix_(axes, axes)]) @ A, carried(center, target)[:3]
        rms = uncertainty.test.scale * float(np.sqrt(np.trace(X @ np.linalg.inv(information) @ X.T)))
        test = noise_test(residuals[others].ravel(), whole[np.ix_(axes, axes)], A)
        without.append(WithoutMarker(name, rms, test.probability))
    return tuple(without)


def one_more(registration: Registration, target_ct: Floats, skin_points_ct: Floats) -> OneMore | None:
    """The place among skin points (n, 3), mm, where one more marker, read and touched alike, leaves the least error.

    That is the error at the target (3,), mm. None without declared errors.
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
