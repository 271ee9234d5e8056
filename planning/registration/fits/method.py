"""The methods of registration, and whether one can weigh the declared noise."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits.least_squares import (
    _least_squares,
    fit_joint,
    fit_rigid,
    fit_triad,
    fit_weighted,
)
from puncture_twin.planning.registration.fits.marker_ambiguity import better_names
from puncture_twin.planning.registration.marker_pairs import MarkerPairs
from puncture_twin.planning.registration.reading_noise import ReadingNoise

Method = Literal["triad", "rigid", "weighted", "joint", "affine"]

Fit = Callable[[Floats, Floats], Floats]
"""From points (..., n, 3) in both frames, mm, to T_base_ct."""


LEAST_FOUND_MM = 0.01
"""FRE from which on the markers can say how large the errors are: no arm repeats so well, so one side was computed."""

SINGULAR = 1e-12
"""Least over greatest variance of the readings below which some of them count as free of error."""

WEIGHING = frozenset({"weighted", "joint"})
"""Methods that cannot do without declared errors."""


def checked_fit(
    markers: MarkerPairs, method: Method, noise: ReadingNoise | None, found_in_mm: float | None, *, where: str | Path
) -> Fit:
    """The fit of a method, which the declared noise has passed.

    Args:
        markers: To be fitted.
        method: Its name.
        noise: What is declared of each marker.
        found_in_mm: The FRE, where the noise's size is to be found in it.
        where: What errors name.

    Raises:
        InputError: ``affine``, ``weighted`` or ``joint`` without noise, or noise that cannot be weighed.
    """
    _check_method(method, noise, where)
    fit = _fit_by(method, noise)
    if noise is not None:
        _check_noise(markers, method, noise, found_in_mm, where=where)
    return fit


def _fit_by(method: Method, noise: ReadingNoise | None) -> Fit:
    if method == "weighted" and noise is not None:
        return lambda ct, base: fit_weighted(ct, base, noise, fit_rigid(ct, base))
    if method == "joint" and noise is not None:
        return lambda ct, base: fit_joint(ct, base, noise, fit_rigid(ct, base))
    return fit_triad if method == "triad" else fit_rigid


def _check_method(method: Method, noise: ReadingNoise | None, where: str | Path) -> None:
    if method == "affine":
        raise InputError(
            "method 'affine' bends the patient",
            where=where,
            allowed="triad, rigid or weighted; affine only reproduces the paper's Table 6",
        )
    if method not in get_args(Method):
        raise InputError(f"method {method!r}", where=where, allowed=", ".join(get_args(Method)), code="method")
    if method in WEIGHING and noise is None:
        raise InputError(
            f"method '{method}' weighs by declared errors", where=where, allowed="[errors], or method rigid"
        )


def _check_noise(
    markers: MarkerPairs, method: Method, noise: ReadingNoise, found_in_mm: float | None, *, where: str | Path
) -> None:
    """Refuse noise that cannot be weighed, and an FRE (mm, where the noise is found in it) that holds none."""
    R = fit_rigid(markers.points_ct, markers.points_base)[:3, :3]
    covariance = noise.covariance(R)
    values = np.linalg.eigvalsh(covariance.independent if method in WEIGHING else covariance.whole)
    if not values[0] > SINGULAR * values[-1]:
        message = "the declared errors leave readings of the markers without any"
        raise InputError(message, where=where, allowed="ct_in_plane_mm, ct_slice_mm or touch_mm above 0")
    if found_in_mm is not None and found_in_mm < LEAST_FOUND_MM:
        message = f"marker_noise = 'found', but the residuals ({found_in_mm:.2g} mm) hold none"
        raise InputError(message, where=where, allowed="markers measured on both sides, or marker_noise = 'declared'")


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
