"""Residuals that no honest markers leave: a mirrored list, a marker far off."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits.better_names import better_names
from puncture_twin.planning.registration.fits.least_squares import _least_squares
from puncture_twin.planning.registration.marker_pairs import MarkerPairs

MAX_RESIDUAL_MM = 15.0
"""A marker that misses by more was swapped, moved or typed wrongly: the paper's worst set misses by 7 mm."""

MIRROR_GAIN = 2.0
"""A mirrored fit that is better than the proper one by this factor (and 1 mm) says that one side is mirrored."""


def _rms(residuals: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))


def check_residuals(markers: MarkerPairs, residuals: Floats, target_ct: Floats, where: str | Path) -> None:
    """Refuse a fit that is far better mirrored, or that a marker misses by far.

    Args:
        markers: As fitted.
        residuals: Shape (n, 3), mm.
        target_ct: Shape (3,), mm.
        where: What errors name.

    Raises:
        InputError: Naming the markers, and the permutations of their names that would fit.
    """
    mirrored = _least_squares(markers.points_ct, markers.points_base, mirrored=True)
    best = _rms(apply(mirrored, markers.points_ct) - markers.points_base)
    if _rms(residuals) > MIRROR_GAIN * best + 1.0:
        raise InputError(
            f"markers {', '.join(markers.names)} match only mirrored (rms {best:.2f} mm against "
            f"{_rms(residuals):.2f} mm){better_names(markers, target_ct, _rms(residuals))}",
            where=where,
            allowed="both sides right-handed: check LPS/RAS and the marker names",
        )
    lengths = np.linalg.norm(residuals, axis=1)
    worst = int(np.argmax(lengths))
    if lengths[worst] > MAX_RESIDUAL_MM:
        raise InputError(
            f"marker {markers.names[worst]} misses by {lengths[worst]:.1f} mm: swapped, moved or mistyped"
            f"{better_names(markers, target_ct, _rms(residuals))}",
            where=where,
            allowed=f"residuals up to {MAX_RESIDUAL_MM:g} mm",
        )
