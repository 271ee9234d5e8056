"""Where the patient lies for the robot: T_base_ct from markers or from the stated mount, and its expected error."""

from __future__ import annotations

from dataclasses import dataclass

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.formats.points.point_files import NamedPoints, parse_points
from puncture_twin.planning.geometry.spaces import Space
from puncture_twin.planning.registration.registration import Registration, match, register


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
    markers_ct = _points(case, settings.markers_ct, case.space)
    markers_base = _points(case, settings.markers_base, Space.LOCAL)
    where = f"{case.path}: registration"
    registration = register(
        match(markers_ct, markers_base, use=settings.use, where=where),
        method=settings.method,
        target_ct=case.target_ct,
        fle_mm=settings.fle_mm,
        accept_residuals=settings.accept_residuals,
        where=where,
    )
    error = float(registration.expected_tre_mm(case.target_ct[None])[0])
    return Placement(registration.T_base_ct, registration, error)


def _points(case: Case, name: str, space: Space) -> NamedPoints:
    return parse_points(case.files.content(name), case.folder / name, default_space=space)
