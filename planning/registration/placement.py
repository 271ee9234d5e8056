"""Where the patient lies for the robot: T_base_ct from markers or from the stated mount, and its expected error."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.errors import ErrorModel
from puncture_twin.planning.case.tables import MarkerSection
from puncture_twin.planning.formats.points import NamedPoints, parse_points
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.aim import aim_at, reached_insertion
from puncture_twin.planning.registration.aim_correction import aimed
from puncture_twin.planning.registration.marker_noise import marker_noise
from puncture_twin.planning.registration.marker_pairs import check_pairs, match
from puncture_twin.planning.registration.registration import Registration, register

MAX_AIM_OFF_MM = 20.0
"""A plan's joints are at the target as it was corrected then: no nominal arm errs by so much."""


@dataclass(frozen=True, eq=False)
class Placement:
    """The belief of where CT and base are to each other.

    Attributes:
        T_base_ct: Shape (4, 4), mm.
        registration: How markers gave it, or None where the case states a mount.
        target_error_mm: Expected (rms) error at the target, NaN without markers.
    """

    T_base_ct: Floats
    registration: Registration | None
    target_error_mm: float


def load_placement(case: Case) -> Placement | None:
    """Register the case's markers, or take its mount; None where it has neither.

    Raises:
        InputError: Marker files that cannot be read, matched or trusted.
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
    """The registration of two lists of markers as a case states it; nothing is corrected.

    Raises:
        InputError: Marker files that cannot be read, matched or trusted.
    """
    where = f"{case.path}: registration"
    errors = case.errors
    method = "joint" if settings.correct else settings.method or default_method(errors)
    markers = match(
        _points(case, settings.markers_ct, case.space),
        _points(case, settings.markers_base, Space.LOCAL),
        use=settings.use,
        where=where,
    )
    check_pairs(markers, where)
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

    Raises:
        InputError: Nobody says how the arm stood at the touches, the stated insertion is not at the target, or none is
            reached.
    """
    if registration.markers.joints is None:
        message = "correct = true, but the touches do not say how the arm stood: they tell nothing of its errors"
        raise InputError(message, where=where, allowed="q1_deg to q6_deg in markers_base; or correct = false")
    model, tip = case.robot.model, case.needle.length_mm
    q = _aimed_insertion(case, registration.T_base_ct, where)
    return aimed(registration, aim_at(model, tip, case.target_ct, q))


def _aimed_insertion(case: Case, T_base_ct: Floats, where: str | Path) -> Floats:
    """Joints (6,), rad, of the insertion that is corrected for."""
    assert case.registration is not None  # its markers were registered
    if case.registration.correct_joints_deg is None:
        reached = reached_insertion(case, T_base_ct)
        if reached is None:
            message = "correct = true, but the arm reaches the target in none of the directions tried"
            raise InputError(
                message, where=where, allowed="correct_joints_deg, how the arm stands at the insertion's end"
            )
        return reached
    q = np.radians(np.asarray(case.registration.correct_joints_deg))
    T = flange_pose(case.robot.model, q)
    away = float(np.linalg.norm(T[:3, 3] + case.needle.length_mm * T[:3, 2] - apply(T_base_ct, case.target_ct)))
    if away > MAX_AIM_OFF_MM:
        raise InputError(
            f"correct_joints_deg put the tip {away:.1f} mm from the target",
            where=where,
            allowed=f"within {MAX_AIM_OFF_MM:g} mm: joints at an insertion's end, with this needle",
        )
    return q


def default_method(errors: ErrorModel | None) -> Literal["rigid", "weighted"]:
    """Weighted where markers are declared to be read better along some axes than along others."""
    return "weighted" if errors is not None and errors.anisotropic else "rigid"


def _points(case: Case, name: str, space: Space) -> NamedPoints:
    return parse_points(case.files.content(name), case.folder / name, default_space=space)
