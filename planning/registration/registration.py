"""CT to robot from markers: triad and rigid fit, their residuals, and the error to expect at the target."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.points.point_files import NamedPoints
from puncture_twin.planning.geometry.rigid import apply, frame_of_points, pose
from puncture_twin.planning.registration.aim import Aim
from puncture_twin.planning.registration.conditioning import Conditioning, conditioning, leverage
from puncture_twin.planning.registration.fit_map import fit_joint, fit_weighted
from puncture_twin.planning.registration.fit_uncertainty import FitUncertainty, fit_uncertainty
from puncture_twin.planning.registration.reading_noise import ReadingNoise
from puncture_twin.planning.registration.residual_test import Interval, OddMarker, ResidualTest, odd_marker

MIN_MARKERS = 3
"""Two points leave a rotation free."""

COLLINEAR = 0.01
"""Second over first singular value of the centred markers below which they count as one line."""

UNIT_SLIP = 5.0
"""Ratio of the two marker sets' spreads from which on a unit (mm, cm, m) is wrong, not a measurement."""

MAX_RESIDUAL_MM = 15.0
"""A marker that misses by more was swapped, moved or typed wrongly: the paper's worst set misses by 7 mm."""

ALLOWED_RESIDUALS = "names and readings checked, the true errors declared, or registration.accept_residuals = true"

LEAST_FOUND_MM = 0.01
"""FRE from which on the markers can say how large the errors are: no arm repeats so well, so one side was computed."""

SINGULAR = 1e-12
"""Least over greatest variance of the readings below which some of them count as free of error."""

Method = Literal["triad", "rigid", "weighted", "joint", "affine"]

WEIGHING = frozenset({"weighted", "joint"})
"""Methods that cannot do without declared errors."""

MIRROR_GAIN = 2.0
"""A mirrored fit that is better than the proper one by this factor (and 1 mm) says that one side is mirrored."""


@dataclass(frozen=True, eq=False)
class MarkerPairs:
    """The same markers in both frames, matched by name; shapes (n, 3), mm.

    Joints: how the arm stood at each touch, shape (n, 6), rad, where the file has them.
    """

    names: tuple[str, ...]
    points_ct: Floats
    points_base: Floats
    joints: Floats | None = None

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class Registration:
    """T_base_ct from markers, and what is known of its error.

    Attributes:
        method: How it was fitted.
        T_base_ct: Shape (4, 4), rigid, mm.
        markers: The matched markers.
        residuals: Shape (n, 3), T_base_ct markers_ct - markers_base, mm.
        residual_test: The residuals of the rigid fit against the noise.
        conditioning: The three flags of a weak set, for the target given.
        uncertainty: What the declared errors make of it; None where none are declared.
        aim: The insertion for which the pose was corrected by what the residuals tell of the arm; None where it was
            not. The residuals are those before.
    """

    method: str
    T_base_ct: Floats
    markers: MarkerPairs
    residuals: Floats
    residual_test: ResidualTest
    conditioning: Conditioning
    uncertainty: FitUncertainty | None = None
    aim: Aim | None = None

    @property
    def fle_mm(self) -> float:
        """The fiducial localisation error (rms) that the expectations use."""
        return self.residual_test.fle_mm if self.uncertainty is None else self.uncertainty.fle_mm

    @property
    def fle_source(self) -> str:
        """Where that number comes from."""
        if self.uncertainty is None:
            return self.residual_test.source
        scaled = (
            f", scaled by {self.uncertainty.test.scale:.2f} to the residuals" if self.uncertainty.test.scaled else ""
        )
        return f"[errors]{scaled}"

    @property
    def fle_interval_mm(self) -> Interval:
        """The 95 % interval of that number: one value where it is declared and holds."""
        if self.uncertainty is None:
            return self.residual_test.fle_interval_mm
        test, fle = self.uncertainty.test, self.uncertainty.fle_mm
        if not test.scaled:
            return Interval(fle, fle)
        return Interval(*(fle / test.scale * end for end in test.interval))

    @property
    def flags(self) -> tuple[str, ...]:
        """What weakens it, in words: the conditioning, residuals that were accepted, a marker that does not fit."""
        odd = _odd_marker(self.markers, self.residual_test.declared_fle_mm)
        return (*self.conditioning.flags, *self._doubts(), *(() if odd is None else (odd.text(),)))

    def _doubts(self) -> tuple[str, ...]:
        if self.uncertainty is None:
            test = self.residual_test
            return () if test.explained else (f"{test.text()}; accepted by the case",)
        declared = self.uncertainty.test
        if declared.agrees:
            return ()
        return (
            declared.text() + ("; all errors are scaled to them" if declared.explained else "; accepted by the case"),
        )

    @property
    def residual_mm(self) -> Floats:
        """Length of each marker's residual, shape (n,)."""
        return np.asarray(np.linalg.norm(self.residuals, axis=1))

    @property
    def mean_error_mm(self) -> float:
        """Mean residual over the markers (Chen 2019, Eq. 16)."""
        return float(self.residual_mm.mean())

    @property
    def fre_mm(self) -> float:
        """Root mean square residual. It is not the accuracy at the target."""
        return float(np.sqrt(np.mean(self.residual_mm**2)))

    def expected_tre_mm(self, points_ct: Floats) -> Floats:
        """Expected (rms) target registration error at points (n, 3) of the CT frame, shape (n,), mm.

        By the declared errors of the readings where there are any, else by Fitzpatrick's formula. The arm's own errors,
        which partly cancel between touch and insertion, are not in it.
        """
        if self.uncertainty is None:
            return self.fle_mm * leverage(self.markers.points_ct, points_ct)
        points_base = apply(self.T_base_ct, points_ct)
        return np.sqrt([np.trace(self.uncertainty.cov_at(point)[:3, :3]) for point in points_base])

    def expected_tre_interval_mm(self, point_ct: Floats) -> Interval:
        """Expected target registration error (rms) at one point (3,), at both ends of the noise's 95 % interval, mm."""
        if self.uncertainty is None:
            lever = float(leverage(self.markers.points_ct, point_ct[None])[0])
            return Interval(*(fle * lever for fle in self.fle_interval_mm))
        expected = float(self.expected_tre_mm(point_ct[None])[0])
        return Interval(*(expected * fle / self.fle_mm for fle in self.fle_interval_mm))


def match(
    markers_ct: NamedPoints,
    markers_base: NamedPoints,
    *,
    use: tuple[str, ...] | None,
    where: str | Path = "registration",
) -> MarkerPairs:
    """Pair markers by name.

    Args:
        markers_ct: Markers in the CT frame.
        markers_base: Markers in the base frame.
        use: The names to use, in this order; None demands the same names on both sides.
        where: What errors name.

    Raises:
        InputError: A name that one side lacks, or fewer than three markers.
    """
    names = markers_ct.names if use is None else use
    for side, points, other in (
        ("CT", markers_ct, markers_base),
        ("base", markers_base, markers_ct),
    ):
        wanted = set(names) if use is not None else set(other.names)
        missing = sorted(wanted - set(points.names))
        if missing:
            raise InputError(
                f"{', '.join(missing)} missing on the {side} side",
                where=where,
                allowed="the same names on both sides, or registration.use = [names]",
            )
    if len(set(names)) < len(names):
        raise InputError(f"names repeat: {', '.join(names)}", where=where, allowed="unique names")
    rows_ct = [markers_ct.names.index(name) for name in names]
    rows_base = [markers_base.names.index(name) for name in names]
    joints = None if markers_base.joints is None else markers_base.joints[rows_base]
    return MarkerPairs(tuple(names), markers_ct.points[rows_ct], markers_base.points[rows_base], joints)


def register(
    markers: MarkerPairs,
    *,
    method: Method,
    target_ct: Floats,
    fle_mm: float | None = None,
    noise: ReadingNoise | None = None,
    noise_found: bool = False,
    accept_residuals: bool = False,
    where: str | Path = "registration",
) -> Registration:
    """Fit T_base_ct, and hold its residuals against the noise.

    Args:
        markers: At least three, matched.
        method: ``triad`` (Chen 2019, Eq. 1-9, three markers in the order given), ``rigid`` (least squares),
            ``weighted`` (by the declared noise) or ``joint`` (by that and what the arm does wrong at all markers).
        target_ct: Shape (3,), where the error matters.
        fle_mm: Known localisation error (rms, both sides together); None estimates it from FRE. Not beside ``noise``.
        noise: What is declared of each marker, in the order of ``markers``.
        noise_found: Whether ``noise`` is a shape alone, its size to be found from the residuals.
        accept_residuals: Whether residuals beyond the noise are taken, and the noise is scaled to them.
        where: What errors name.

    Raises:
        InputError: Fewer than three markers, collinear, mirrored, a unit slip, a marker far off, ``affine``,
            ``weighted`` or ``joint`` without noise, noise that is none, or residuals that the noise does not explain.
    """
    _check_method(method, noise, where)
    check_pairs(markers, where)
    if noise is not None:
        _check_noise(markers, method, noise, found=noise_found, where=where)
    if method == "triad" and len(markers) != MIN_MARKERS:
        raise InputError(f"triad takes 3 markers, not {len(markers)}", where=where, allowed="3 names in use")
    fit = _fit(method, noise)
    T_base_ct = fit(markers.points_ct, markers.points_base)
    residuals = apply(T_base_ct, markers.points_ct) - markers.points_base
    _check_residuals(markers, residuals, where)
    uncertainty = None
    if noise is not None:
        points = markers.points_ct, markers.points_base
        uncertainty = fit_uncertainty(method, fit, T_base_ct, *points, noise, found=noise_found)
        fle_mm = None if noise_found else _greatest_fle_mm(noise, T_base_ct)
    test = ResidualTest(len(markers), rigid_fre(markers), fle_mm)
    noise_test = test if uncertainty is None else uncertainty.test
    if not (noise_test.explained or accept_residuals):
        odd = _odd_marker(markers, fle_mm)
        what = noise_test.text() if odd is None else f"{noise_test.text()}; {odd.text()}"
        raise InputError(what, where=where, allowed=ALLOWED_RESIDUALS)
    weak = conditioning(markers.points_ct, target_ct)
    return Registration(method, T_base_ct, markers, residuals, test, weak, uncertainty)


def _odd_marker(markers: MarkerPairs, fle_mm: float | None) -> OddMarker | None:
    return odd_marker(fit_rigid, markers.names, markers.points_ct, markers.points_base, fle_mm)


def _check_method(method: Method, noise: ReadingNoise | None, where: str | Path) -> None:
    if method == "affine":
        raise InputError(
            "method 'affine' bends the patient",
            where=where,
            allowed="triad, rigid or weighted; affine only reproduces the paper's Table 6",
        )
    if method in WEIGHING and noise is None:
        raise InputError(
            f"method '{method}' weighs by declared errors", where=where, allowed="[errors], or method rigid"
        )


def _check_noise(markers: MarkerPairs, method: Method, noise: ReadingNoise, *, found: bool, where: str | Path) -> None:
    """Refuse noise that cannot be weighed, and residuals in which there is none to be found."""
    R = fit_rigid(markers.points_ct, markers.points_base)[:3, :3]
    values = np.linalg.eigvalsh(noise.independent(R) if method in WEIGHING else noise.whole(R))
    if not values[0] > SINGULAR * values[-1]:
        message = "the declared errors leave readings of the markers without any"
        raise InputError(message, where=where, allowed="ct_in_plane_mm, ct_slice_mm or touch_mm above 0")
    if found and rigid_fre(markers) < LEAST_FOUND_MM:
        message = f"marker_noise = 'found', but the residuals ({rigid_fre(markers):.2g} mm) hold none"
        raise InputError(message, where=where, allowed="markers measured on both sides, or marker_noise = 'declared'")


def _fit(method: Method, noise: ReadingNoise | None) -> Callable[[Floats, Floats], Floats]:
    if method == "weighted" and noise is not None:
        return lambda ct, base: fit_weighted(ct, base, noise, fit_rigid(ct, base))
    if method == "joint" and noise is not None:
        return lambda ct, base: fit_joint(ct, base, noise, fit_rigid(ct, base))
    return fit_triad if method == "triad" else fit_rigid


def _greatest_fle_mm(noise: ReadingNoise, T_base_ct: Floats) -> float:
    """The noise of the isotropic test that other pairings of the names are compared with: the worst axis in all three.

    Residuals that pass the weighted test have |r|^2 <= lambda_max chi-squared: the given names pass this one too.
    """
    return float(np.sqrt(3 * np.linalg.eigvalsh(noise.whole(T_base_ct[:3, :3]))[-1]))


def fit_triad(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct by the frames that three markers span (Chen 2019, Eq. 1-9).

    R_base_ct = R_base R_ct^T; the translation is the mean over the three markers.

    Args:
        points_ct: Shape (..., 3, 3), rows M1, M2, M3, mm; one set, or many.
        points_base: Shape (..., 3, 3), the same markers.
    """
    R_ct = np.swapaxes(frame_of_points(points_ct), -1, -2)
    R = frame_of_points(points_base) @ R_ct
    return _rigid(R, np.mean(points_base - points_ct @ np.swapaxes(R, -1, -2), axis=-2))


def fit_rigid(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct that minimises the squared residuals over rotations (Arun 1987, by SVD; det = +1 after Umeyama 1991).

    Args:
        points_ct: Shape (..., n, 3), n >= 3, not collinear, mm; one set, or many.
        points_base: Shape (..., n, 3), the same markers.
    """
    return _least_squares(points_ct, points_base, mirrored=False)


def _least_squares(points_ct: Floats, points_base: Floats, *, mirrored: bool) -> Floats:
    center_ct, center_base = points_ct.mean(axis=-2), points_base.mean(axis=-2)
    spread = np.swapaxes(points_base - center_base[..., None, :], -1, -2) @ (points_ct - center_ct[..., None, :])
    U, _, Vt = np.linalg.svd(spread)
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    U = U * np.stack([np.ones_like(sign), np.ones_like(sign), sign], axis=-1)[..., None, :]
    R = U @ Vt
    return _rigid(R, center_base - (R @ center_ct[..., None])[..., 0])


def fit_affine(points_ct: Floats, points_base: Floats) -> Floats:
    """The unconstrained 12-parameter least squares of the paper's Table 6, shape (4, 4). Not a rigid motion.

    With fewer than four markers that span space it is not unique, and the solution of least norm is taken.
    """
    homogeneous = np.column_stack([points_ct, np.ones(len(points_ct))])
    solution, *_ = np.linalg.lstsq(homogeneous, points_base, rcond=None)
    T = np.eye(4)
    T[:3] = solution.T
    return T


def rigid_fre(markers: MarkerPairs) -> float:
    """FRE of the least-squares fit, whatever the method: the chi-squared test is about that."""
    fitted = apply(fit_rigid(markers.points_ct, markers.points_base), markers.points_ct)
    return _rms(fitted - markers.points_base)


def _rigid(R: Floats, t: Floats) -> Floats:
    T = pose(R, t)
    T.setflags(write=False)
    return T


def check_pairs(markers: MarkerPairs, where: str | Path) -> None:
    """Whether markers can be fitted at all.

    Raises:
        InputError: Fewer than three, not finite, on a line, or of two sizes.
    """
    if len(markers) < MIN_MARKERS:
        raise InputError(f"{len(markers)} markers", where=where, allowed="3 or more, by the same names")
    both = np.concatenate([markers.points_ct, markers.points_base])
    if not np.isfinite(both).all():
        bad = [n for n, a, b in zip(markers.names, markers.points_ct, markers.points_base, strict=True)
               if not np.isfinite([a, b]).all()]  # fmt: skip
        raise InputError(f"marker {', '.join(bad)} is not finite", where=where, allowed="finite mm")
    spreads = [_singular_values(points) for points in (markers.points_ct, markers.points_base)]
    for side, values in zip(("CT", "base"), spreads, strict=True):
        if values[0] == 0 or values[1] / values[0] < COLLINEAR:
            raise InputError(
                f"markers {', '.join(markers.names)} are collinear on the {side} side",
                where=where,
                allowed="three markers that span a triangle",
            )
    ratio = float(np.linalg.norm(spreads[1]) / np.linalg.norm(spreads[0]))
    if not 1 / UNIT_SLIP < ratio < UNIT_SLIP:
        raise InputError(
            f"base markers spread {ratio:.3g} times as wide as the CT's: a likely mm/cm/m slip",
            where=where,
            allowed="both sides in mm",
        )


def _singular_values(points: Floats) -> Floats:
    return np.asarray(np.linalg.svd(points - points.mean(axis=0), compute_uv=False))


def _check_residuals(markers: MarkerPairs, residuals: Floats, where: str | Path) -> None:
    mirrored = _least_squares(markers.points_ct, markers.points_base, mirrored=True)
    best = _rms(apply(mirrored, markers.points_ct) - markers.points_base)
    if _rms(residuals) > MIRROR_GAIN * best + 1.0:
        raise InputError(
            f"markers {', '.join(markers.names)} match only mirrored (rms {best:.2f} mm against "
            f"{_rms(residuals):.2f} mm)",
            where=where,
            allowed="both sides right-handed: check LPS/RAS and the marker names",
        )
    lengths = np.linalg.norm(residuals, axis=1)
    worst = int(np.argmax(lengths))
    if lengths[worst] > MAX_RESIDUAL_MM:
        raise InputError(
            f"marker {markers.names[worst]} misses by {lengths[worst]:.1f} mm: swapped, moved or mistyped",
            where=where,
            allowed=f"residuals up to {MAX_RESIDUAL_MM:g} mm",
        )


def _rms(residuals: Floats) -> float:
    return float(np.sqrt(np.mean(np.sum(residuals**2, axis=1))))
