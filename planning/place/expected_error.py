"""How far a tip is expected to miss from another stand of the arm, its markers touched anew from there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.marker_noise import reading_noise, touches
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.placement import Placement, default_method
from puncture_twin.planning.registration.registration import Registration, register
from puncture_twin.planning.uncertainty.pose_error import PoseError


def expected_tip_error_mm(case: Case, placement: Placement | None, T_base_ct: Floats, q: Floats) -> float | None:
    """Root mean square over insertions (n, 6) of sqrt(trace(Sigma_dd)); None without declared errors, markers or q.

    How the arm will touch the markers from there nobody has said, so that the arm's own errors do not cancel (2 J_f
    Sigma_eta J_f' stands for them); the residuals of the old touches say nothing of the new ones.

    Args:
        case: Declares the errors.
        placement: Where the case has the arm; gives the markers.
        T_base_ct: Shape (4, 4), mm: where the arm is to stand.
        q: Joints (rad) with the tip on the target from there.
    """
    registration = None if placement is None else placement.registration
    if case.errors is None or registration is None or not len(q):
        return None
    covariance = pose_error_from(case, registration, T_base_ct).covariance(q)
    return float(np.sqrt(np.trace(covariance[:, :3, :3], axis1=1, axis2=2).mean()))


def pose_error_from(case: Case, registration: Registration, T_base_ct: Floats) -> PoseError:
    """The needle's pose error from another stand of the arm; arguments as above, the case with errors."""
    assert case.errors is not None  # the caller has looked
    errors, old = replace(case.errors, found=False), registration.markers
    markers = MarkerPairs(old.names, old.points_ct, apply(T_base_ct, old.points_ct))
    model, tip = case.robot.model, case.needle.length_mm
    noise = reading_noise(errors, model, tip, touches(case, markers), known=False)
    method = (None if case.registration is None else case.registration.method) or default_method(errors)
    fitted = register(markers, method=method, target_ct=case.target_ct, noise=noise)
    assert fitted.uncertainty is not None  # its markers have noise
    return PoseError(model, tip, apply(T_base_ct, case.target_ct), errors, fitted.uncertainty)
