"""The noise of markers that were touched in given configurations, from the declared errors of CT, touch and arm."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.arm.error_jacobian import N_PARAMETERS, PARAMETERS, error_jacobian
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.errors import ArmUncertainty, ErrorModel
from puncture_twin.planning.registration.reading_noise import ReadingNoise


def parameter_variances(arm: ArmUncertainty) -> Floats:
    """The diagonal of Sigma_eta, shape (28,), in the order of `error_jacobian`'s columns; mm^2 and rad^2."""
    deviations = np.empty(N_PARAMETERS)
    for kind, value in (
        ("link", arm.link_mm),
        ("twist", arm.twist),
        ("joint", arm.joint),
        ("tip_offset", arm.tip_offset_mm),
        ("needle_direction", arm.needle_direction),
    ):
        deviations[PARAMETERS[kind]] = value
    return np.asarray(deviations**2)


def reading_noise(errors: ErrorModel, model: UrModel, tip_mm: float, q_touch: Floats, *, known: bool) -> ReadingNoise:
    """The noise of markers that were touched in given configurations.

    Args:
        errors: As declared.
        model: The arm.
        tip_mm: Flange to tip.
        q_touch: Shape (N, 6), rad.
        known: Whether these are the real ones.
    """
    eta_variances = parameter_variances(errors.arm)
    J = error_jacobian(model, q_touch, tip_mm)[:, :3]
    Jq = J[..., PARAMETERS["joint"]]
    cov_base = errors.touch_mm**2 * np.eye(3) + errors.arm.repeatability**2 * Jq @ np.swapaxes(Jq, -1, -2)
    return ReadingNoise(errors.marker_cov_ct, cov_base, J.reshape(-1, N_PARAMETERS), eta_variances, known)
