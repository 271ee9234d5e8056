"""A needle as it was predicted beside the needle as it came to stand, as plain values."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import chdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import log_rotation
from puncture_twin.twin.guidance.stereo.joint.needle_error import REGION, NeedleError

LEAST_VARIANCE = 1e-12
"""mm^2 and rad^2, added to every axis where a covariance is inverted: what cannot err must not divide by zero."""


class TrueNeedle(NamedTuple):
    """Where a needle truly is against the anatomy, image axes."""

    error_m: Floats
    """Shape (3,), mm: true tip minus true target."""
    R_m_needle: Floats
    """Shape (3, 3): its axes as columns, z to the tip."""


class NeedleOutcome(NamedTuple):
    """One needle; mm and degrees."""

    predicted_rms_mm: float
    """Expected (rms) distance of tip and target."""
    offset_mm: float
    """The part of it that is known: the tip believed, to the target."""
    half_axes_mm: tuple[float, float, float]
    """Of the 95 % ellipsoid about the tip believed, longest first."""
    lateral_mm: float
    """Deviation across the needle."""
    depth_mm: float
    """Deviation along it."""
    predicted_direction_deg: float
    """Expected (rms) angle of the needle and where it is believed to point."""
    p_hit: float | None
    """Chance that the tip is within the case's radius; None where it states none."""
    realised_mm: float
    """True tip to true target."""
    realised_direction_deg: float
    square: float
    """Of the tip's error about what is believed, in deviations: chi-squared of 3."""
    square_of_pose: float
    """Likewise of tip and rotation together: chi-squared of 6."""
    hit: bool | None
    """Whether the tip is within the radius."""

    @property
    def in_region(self) -> bool:
        """Whether the 95 % ellipsoid holds the tip."""
        return bool(self.square <= chdtri(3, 1 - REGION))


def needle_outcome(believed: NeedleError, true: TrueNeedle, radius_mm: float | None) -> NeedleOutcome:
    """Compare.

    Args:
        believed: As predicted.
        true: As it came.
        radius_mm: Within which of the target the tip hits, where a case states one.
    """
    realised = float(np.linalg.norm(true.error_m))
    turn = log_rotation(true.R_m_needle @ believed.R_m_needle.T)
    error = np.concatenate([true.error_m - believed.offset_m, turn])
    covariance = believed.covariance + np.pad(believed.target_covariance, (0, 3))
    cosine = true.R_m_needle[:, 2] @ believed.R_m_needle[:, 2]
    longest, middle, shortest = (float(mm) for mm in believed.half_axes_mm)
    return NeedleOutcome(
        predicted_rms_mm=believed.rms_mm,
        offset_mm=float(np.linalg.norm(believed.offset_m)),
        half_axes_mm=(longest, middle, shortest),
        lateral_mm=believed.lateral_mm,
        depth_mm=believed.depth_mm,
        predicted_direction_deg=float(np.degrees(believed.direction_rms)),
        p_hit=None if radius_mm is None else believed.p_hit(radius_mm),
        realised_mm=realised,
        realised_direction_deg=float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))),
        square=_square(error[:3], believed.tip_covariance),
        square_of_pose=_square(error, covariance),
        hit=None if radius_mm is None else realised < radius_mm,
    )


def _square(error: Floats, covariance: Floats) -> float:
    return float(error @ np.linalg.solve(covariance + LEAST_VARIANCE * np.eye(len(error)), error))
