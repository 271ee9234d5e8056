"""What a corrected aim wins, as facts and text."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.rotations import log_rotation
from puncture_twin.planning.registration.placement import default_method
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.uncertainty.pose_error import expected_error_mm, pose_error
from puncture_twin.twin.jobs.patient.budget import needle_angles


def correction_facts(case: Case, registration: Registration) -> dict[str, Any] | None:
    """What a corrected aim wins at its own insertion, mm; None where the case corrects none."""
    aim, plain = registration.aim, registration.uncertainty
    if aim is None or plain is None or case.errors is None:
        return None
    method = default_method(case.errors)
    other = register(
        registration.markers, method=method, target_ct=aim.target_ct, noise=plain.noise,
        noise_found=case.errors.found, accept_residuals=True,
    )  # fmt: skip
    shift = apply(registration.T_base_ct, aim.target_ct) - apply(other.T_base_ct, aim.target_ct)
    turn = registration.T_base_ct[:3, :3] @ other.T_base_ct[:3, :3].T
    return {
        **needle_angles(case, registration, aim.q),
        "joints_deg": np.degrees(aim.q).tolist(),
        "moved_mm": float(np.linalg.norm(shift)),
        "turned_deg": float(np.degrees(np.linalg.norm(log_rotation(turn)))),
        "expected_mm": _expected_mm(case, registration, aim.q),
        "uncorrected_method": method,
        "uncorrected_mm": _expected_mm(case, other, aim.q),
    }


def correction_lines(facts: dict[str, Any] | None) -> list[str]:
    """Both expectations, and where the correction is the best one."""
    if facts is None:
        return []
    joints = ", ".join(f"{angle:.2f}" for angle in facts["joints_deg"])
    return [
        f"  aim corrected for the insertion at theta {facts['theta_deg']:.0f}, beta {facts['beta_deg']:.0f} "
        f"(joints {joints} deg): moved by {facts['moved_mm']:.2f} mm and {facts['turned_deg']:.2f} deg;",
        f"    expected there {facts['expected_mm']:.2f} mm (rms), not corrected ({facts['uncorrected_method']}) "
        f"{facts['uncorrected_mm']:.2f} mm; it trusts what [errors] says of the arm",
    ]


def _expected_mm(case: Case, registration: Registration, q: Floats) -> float:
    error = pose_error(case, registration)
    assert error is not None  # the caller has looked
    return expected_error_mm(error, q)
