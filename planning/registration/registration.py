"""CT to robot from markers: their fit, tests of its residuals, and the error to expect at the target.

`register` is the list of its stages. One of them: is one list of markers scaled, stretched or sheared against the
other? A unit that is a little off, slices whose step is wrong, a gantry tilt that nobody took back: each deforms what
one side shows, and a rigid motion leaves that to the residuals, where it looks like noise. Seven deformations of the
CT's frame are tried, one at a time: a similarity, a stretch along each axis, a shear in each plane. With z the
residuals of the rigid fit, whitened by what is declared of the readings, A its design and d the column of a
deformation:

    F = (SSE_6 - SSE_7) / (SSE_7 / (3 N - 7))   follows F(1, 3 N - 7) where there is none,

and the best one's probability counts seven times (Bonferroni). It is reported and never applied: a marker that was
misread can look the same.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, fdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.text import Facts, Shown, brief
from puncture_twin.planning.geometry.gauss_newton import lacking
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration import fits
from puncture_twin.planning.registration.fits import (
    INTERVAL,
    REJECT_LEVEL,
    Aim,
    FitUncertainty,
    Interval,
    Method,
    ReadingNoise,
    carried,
    checked_fit,
    design,
    fit_rigid,
    fit_uncertainty,
    rms,
)
from puncture_twin.planning.registration.marker_pairs import (
    MAX_FRE_MM,
    MIN_MARKERS,
    MarkerPairs,
    better_names,
    check_pairs,
)

MIN_FLE_MM = 0.3
"""An estimate below is luck, not accuracy: a voxel of 0.4 mm leaves 0.2 mm, a touch of 0.1 mm in each axis 0.17 mm."""
ALIKE_MM = 1.0
"""Without a declared noise: a permuted fit with a smaller FRE is always as good as the given one."""
FALSE_ALARM = 0.01
"""One honest set of markers in a hundred is said to have an odd one: it is a warning, and a look at it is cheap."""
MAX_RESIDUAL_MM = 15.0
"""A marker that misses by more was swapped, moved or typed wrongly: the paper's worst set misses by 7 mm."""
MIRROR_GAIN = 2.0
"""Factor (and 1 mm) by which a mirrored fit must be better than the proper one: then one list is mirrored."""


def check_residuals(markers: MarkerPairs, residuals: Floats, target_ct: Floats, where: str | Path) -> None:
    """Refuse a fit that is far better mirrored, or that a marker misses by far; residuals (n, 3), mm.

    Raises InputError: Naming the markers, and the permutations of their names that would fit.
    """
    T_mirrored = fit_rigid(markers.points_ct, markers.points_base, mirrored=True)
    given, mirrored = rms(residuals), rms(apply(T_mirrored, markers.points_ct) - markers.points_base)
    if given > MIRROR_GAIN * mirrored + 1.0:
        what = (
            f"markers {', '.join(markers.names)} match only mirrored (rms {mirrored:.2f} mm against "
            f"{given:.2f} mm){better_names(markers, target_ct, given)}"
        )
        refuse(what, where, "both sides right-handed: check LPS/RAS and the marker names", "markers_mirrored")
    lengths = np.linalg.norm(residuals, axis=1)
    worst = int(np.argmax(lengths))
    if lengths[worst] > MAX_RESIDUAL_MM:
        what = (
            f"marker {markers.names[worst]} misses by {lengths[worst]:.1f} mm: swapped, moved or mistyped"
            f"{better_names(markers, target_ct, given)}"
        )
        refuse(what, where, f"residuals up to {MAX_RESIDUAL_MM:g} mm", "marker_misses")


LEAST_MARKERS = 4
"""The others must fit each other with something left over: three points leave three degrees of freedom."""
LEAST_SPREAD = 0.01
"""Second over first singular value of the others below which they are one line, and place nothing."""


@dataclass(frozen=True)
class ResidualTest:
    """The residuals of a rigid fit against the noise.

    With normal errors of standard deviation fle/sqrt(3) in each axis, both sides together, N markers of a rigid fit
    leave nu s^2 = 3 sum |r_i|^2 / fle^2, distributed as chi-squared with nu = 3 N - 6 degrees of freedom.
    """

    count: int  # markers, N >= 3
    fre_mm: float
    """Root mean square residual of the least-squares rigid fit, whatever method the case takes."""
    declared_fle_mm: float | None = None
    """The noise (rms length, both sides together) that the user states, or None."""

    @property
    def freedom(self) -> int:
        """Degrees of freedom, nu = 3 N - 6."""
        return 3 * self.count - 6

    @property
    def chi_squared(self) -> float:
        """The statistic nu s^2 of the declared noise; NaN where none is declared."""
        if self.declared_fle_mm is None:
            return float("nan")
        return 3 * self.count * (self.fre_mm / self.declared_fle_mm) ** 2

    @property
    def probability(self) -> float:
        """Chance of residuals as large as these by the declared noise; NaN where none is declared."""
        return float(chdtrc(self.freedom, self.chi_squared))

    @property
    def limit_mm(self) -> float:
        """The greatest FRE that passes."""
        if self.declared_fle_mm is None:
            return MAX_FRE_MM
        return self.declared_fle_mm * float(np.sqrt(chdtri(self.freedom, REJECT_LEVEL) / (3 * self.count)))

    @property
    def explained(self) -> bool:
        """Whether noise explains the residuals."""
        return self.fre_mm <= self.limit_mm

    @property
    def scale(self) -> float:
        """s, by which a declared noise is to be multiplied: 1 where it explains the residuals, or none is declared."""
        if self.declared_fle_mm is None or self.explained:
            return 1.0
        return float(np.sqrt(self.chi_squared / self.freedom))

    @property
    def fle_mm(self) -> float:
        """The noise to compute with, rms length: declared (and scaled), or estimated and never below a floor.

        The estimate is <FRE^2> = (1 - 2/N) <FLE^2> (Fitzpatrick 1998).
        """
        if self.declared_fle_mm is not None:
            return self.declared_fle_mm * self.scale
        return max(self.fre_mm / self._free, MIN_FLE_MM)

    @property
    def fle_interval_mm(self) -> Interval:
        """The 95 % interval of an estimated noise by chi-squared with nu degrees; a declared noise is known."""
        if self.declared_fle_mm is not None and self.explained:
            return Interval(self.fle_mm, self.fle_mm)
        tail = (1 - INTERVAL) / 2
        low, high = (self.fle_mm * float(np.sqrt(self.freedom / chdtri(self.freedom, p))) for p in (tail, 1 - tail))
        return Interval(low, high)

    @property
    def source(self) -> str:
        """Where the noise comes from, in words."""
        if self.declared_fle_mm is not None:
            scaled = f", scaled by {self.scale:.2f} to the residuals" if self.scale > 1 else ""
            return f"given{scaled}"
        if self.fre_mm / self._free < MIN_FLE_MM:
            return f"the floor of {MIN_FLE_MM:g} mm: such a small FRE of {self.count} markers is chance"
        return "estimated from FRE of the rigid fit"

    def text(self) -> str:
        """Result of the test, in words."""
        if self.declared_fle_mm is None:
            what = "exceeds" if not self.explained else "keeps"
            return f"FRE {self.fre_mm:.2f} mm {what} the {MAX_FRE_MM:g} mm allowed without a declared fle_mm"
        what = "explains" if self.explained else "does not explain"
        scaled = "" if self.explained else f"; {self.scale:.2f} times that noise would"
        return (
            f"fle_mm = {self.declared_fle_mm:g} {what} FRE {self.fre_mm:.2f} mm (chi-squared {self.chi_squared:.1f}, "
            f"{100 * (1 - REJECT_LEVEL):g} % stay below {chdtri(self.freedom, REJECT_LEVEL):.1f} at "
            f"{self.freedom} degrees of freedom){scaled}"
        )

    @property
    def alike_mm(self) -> float:
        """Other pairings of the markers fit as well within the noise where their FRE stays below this.

        By a declared noise: what the given names would have to pass. Without one: what F(nu, nu) allows at 99.9 %
        for two fits of the same noise, at least `ALIKE_MM`, and at most what a registration is refused for anyway.
        """
        if self.declared_fle_mm is not None:
            alike = self.limit_mm * self.scale
        else:
            alike = min(MAX_FRE_MM, max(ALIKE_MM, self._f_ratio * max(self.fre_mm, MIN_FLE_MM * self._free)))
        return max(alike, self.fre_mm)

    def contradicted_by(self, other_fre_mm: float) -> bool:
        """Whether another pairing with this FRE fits so much better that the given names are likely wrong."""
        if not self.explained:
            return other_fre_mm <= self.limit_mm
        if self.declared_fle_mm is not None:
            return False
        return self.fre_mm > self._f_ratio * max(other_fre_mm, MIN_FLE_MM * self._free)

    @property
    def _free(self) -> float:
        return float(np.sqrt(1 - 2 / self.count))

    @property
    def _f_ratio(self) -> float:
        """The ratio of two FRE of the same noise that is exceeded once in 1,000."""
        return float(np.sqrt(fdtri(self.freedom, self.freedom, 1 - REJECT_LEVEL)))


class OutlierMarker(NamedTuple):
    """A marker that does not fit the others."""

    name: str
    miss_mm: float  # how far off its reading the others place it
    others: int
    others_fre_mm: float  # how well they fit each other, root mean square

    def text(self) -> str:
        """Which marker does not fit, by how much, and what to check; one sentence."""
        return (
            f"marker {self.name} does not fit: the other {self.others} place it {self.miss_mm:.1f} mm from its "
            f"reading, and agree with each other to {self.others_fre_mm:.1f} mm; check its name, touch and position "
            "in the CT"
        )

    def finding(self) -> Finding:
        """The outlier marker as a warning."""
        numbers: dict[str, float | str] = {"miss_mm": self.miss_mm, "others_fre_mm": self.others_fre_mm}
        return Finding("outlier_marker", Severity.WARNING, self.text(), {"marker": self.name, **numbers})


def outlier_marker(markers: MarkerPairs, fle_mm: float | None) -> OutlierMarker | None:
    """The marker that least fits the others, if chance does not explain it; ``fle_mm`` is their declared noise (rms).

    A residual of the common fit hides it, since the outlier pulls the fit. Marker i left out, the others fit with
    residuals r_j and nu = 3 (n-1) - 6 degrees of freedom; they place it d_i off its reading, whose expected square is
    FLE^2 (1 + l_i^2) with l_i the leverage at its place (Fitzpatrick 1998). Where all markers err alike, F_i = (d_i^2 /
    3) / ((1 + l_i^2) s^2) with s^2 = sum |r_j|^2 / nu, no less than declared, follows F(3, nu).
    """
    if len(markers) < LEAST_MARKERS:
        return None
    least, chance = MIN_FLE_MM if fle_mm is None else fle_mm, 1.0
    outlier: OutlierMarker | None = None
    for row, name in enumerate(markers.names):
        ct, base = np.delete(markers.points_ct, row, axis=0), np.delete(markers.points_base, row, axis=0)
        spread = np.linalg.svd(ct - ct.mean(axis=0), compute_uv=False)
        if spread[1] < LEAST_SPREAD * spread[0]:
            continue
        T, point = fit_rigid(ct, base), markers.points_ct[row : row + 1]
        squares, freedom = float(np.sum((apply(T, ct) - base) ** 2)), 3 * len(ct) - 6
        variance = max(squares / freedom, least**2 / 3)
        miss, lever = float(np.linalg.norm(apply(T, point) - markers.points_base[row])), float(leverage(ct, point)[0])
        its_chance = float(fdtrc(3, freedom, miss**2 / 3 / ((1 + lever**2) * variance)))
        if its_chance < chance:
            chance, outlier = its_chance, OutlierMarker(name, miss, len(ct), float(np.sqrt(squares / len(ct))))
    return outlier if chance < FALSE_ALARM / len(markers) else None  # Bonferroni: each of the markers is tested


WEAK_SPREAD = 0.2
"""Conditioning flag: s2/s1 below it (spec: trips on the paper's A-C-D only)."""
WEAK_ALTITUDE_MM = 30.0
"""Conditioning flag: least altitude of the widest triangle below it."""
WEAK_LEVERAGE = 3.0
"""Conditioning flag: TRE(target)/FLE above it."""


@dataclass(frozen=True)
class Conditioning:
    """How well a marker set determines the pose at the target."""

    spread_ratio: float  # s2/s1, singular values of the centred markers
    altitude_mm: float  # least altitude of the widest triangle of markers
    leverage: float  # expected TRE at the target over FLE
    flags: tuple[Finding, ...]


def leverage(markers: Floats, points: Floats) -> Floats:
    """TRE over FLE at points (n, 3), shape (n,) (Fitzpatrick, West, Maurer 1998, Eq. 46).

    <TRE^2> = <FLE^2>/N (1 + 1/3 sum_k d_k^2/f_k^2), d_k the distance of the point from principal axis k of the
    markers and f_k the markers' rms distance from it.
    """
    center = markers.mean(axis=0)
    _, _, axes = np.linalg.svd(markers - center)
    from_axes = _squared_distances(np.atleast_2d(points) - center, axes)
    spread = _squared_distances(markers - center, axes).mean(axis=0)
    return np.asarray(np.sqrt((1 + (from_axes / spread).sum(axis=1) / 3) / len(markers)))


def _squared_distances(points: Floats, axes: Floats) -> Floats:
    """Squared distance of points (n, 3) from each of three axes through the origin, shape (n, 3)."""
    along = (points @ axes.T) ** 2
    return along.sum(axis=1, keepdims=True) - along


def conditioning(markers: Floats, target: Floats) -> Conditioning:
    """The three flags of a marker set; thresholds are the module's constants."""
    values = np.linalg.svd(markers - markers.mean(axis=0), compute_uv=False)
    ratio = float(values[1] / values[0])
    altitude = 0.0
    for three in combinations(markers, 3):
        sides = np.array(three) - np.roll(three, 1, axis=0)
        longest = np.linalg.norm(sides, axis=1).max()  # the least altitude is twice the area over it
        if longest > 0:
            altitude = max(altitude, float(np.linalg.norm(np.cross(sides[0], sides[1])) / longest))
    lever = float(leverage(markers, target)[0])
    flags = []
    if ratio < WEAK_SPREAD:
        said = f"the markers are almost on a line (s2/s1 {ratio:.2f} < {WEAK_SPREAD})"
        flags.append(Finding("markers_on_a_line", Severity.WARNING, said, {"spread_ratio": ratio}))
    if altitude < WEAK_ALTITUDE_MM:
        said = f"the widest marker triangle is flat (altitude {altitude:.0f} < {WEAK_ALTITUDE_MM:.0f} mm)"
        flags.append(Finding("flat_marker_triangle", Severity.WARNING, said, {"altitude_mm": altitude}))
    if lever > WEAK_LEVERAGE:
        said = f"the target is far from the markers (TRE/FLE {lever:.1f} > {WEAK_LEVERAGE:.0f})"
        flags.append(Finding("target_far_from_markers", Severity.WARNING, said, {"leverage": lever}))
    return Conditioning(ratio, altitude, lever, tuple(flags))


SIGNIFICANT, SURE = 0.05, 0.01
"""True lists look so deformed once in 20 registrations, and once in 100: it is said, and nothing is refused for it.
Where one axis is read five times as badly as the others and nobody declares it, the second is up to one in ten (1,000
draws each, 3 to 12 markers)."""
LEAST_MM = 0.05
"""Rms of what a deformation moves the markers by, below which it does not matter, however sure it is."""
KINDS = ("xyz", "x", "y", "z", "xy", "xz", "yz")
"""A similarity, three stretches, and shears: the first axis runs askew along the second."""


@dataclass(frozen=True)
class Distortion:
    """The deformation that explains most of the residuals."""

    axes: str  # of ``KINDS``, in the case's CT frame
    amount: float
    """The factor less 1 by which markers_base are longer; of a shear by how much a point moves along the first axis per
    mm along the second."""
    probability: float  # of one so sure in any of the seven, where there is none
    moved_mm: float  # what it moves the markers by beside a rigid motion, rms
    reading_mm: float  # the standard deviation per coordinate that it leaves to the readings
    rms_mm: float  # expected error at the target by the residuals of the rigid fit
    rms_without_mm: float  # the rms by the residuals of the fit with the deformation

    @property
    def significant(self) -> bool:
        """Whether true lists would seldom look so deformed, by so much that it matters: then it is reported."""
        return self.probability < SIGNIFICANT and self.moved_mm >= LEAST_MM

    def finding(self) -> Finding:
        """The deformation as a warning."""
        noise = "not noise, because" if self.probability < SURE else "probably more than noise:"
        said = (
            f"{self.brief()}: {noise} besides it, the readings have errors of {self.reading_mm:.2g} mm a "
            "coordinate; without it the expected TRE at the target would be about "
            f"{self.rms_without_mm:.1f} mm instead of {self.rms_mm:.1f}; the registration does not use this"
        )
        numbers: dict[str, float | str] = {"axes": self.axes, "amount": self.amount, "probability": self.probability}
        return Finding("lists_deformed", Severity.WARNING, said, numbers)

    def brief(self) -> str:
        """How the lists differ, by how much, and how sure that is."""
        along = "" if self.axes == "xyz" else f" along the CT's {self.axes}"
        said = f"markers_base appear {1 + self.amount:.4f} times as large as markers_ct{along}"
        if len(self.axes) == 2:
            angle = np.degrees(abs(np.arctan(self.amount)))
            said = f"the CT's frame looks {angle:.1f} degrees out of square, {self.axes[0]} against {self.axes[1]}"
        return f"{said} (F test, p {self.probability:.2g})"


def distortion(
    T_base_ct: Floats, markers: MarkerPairs, noise: ReadingNoise | None, target_ct: Floats
) -> Distortion | None:
    """The likeliest deformation of a registration's lists; None where its markers cannot show any.

    T_base_ct (4, 4) is near the least-squares fit, the error matters at target_ct (3,), mm; without noise all weigh
    alike.
    """
    fitted = apply(T_base_ct, markers.points_ct)
    cov = np.eye(fitted.size) if noise is None else noise.covariance(T_base_ct[:3, :3]).whole
    root = np.linalg.inv(np.linalg.cholesky(cov))
    gaps, A = (markers.points_base - fitted).ravel(), design(fitted, fitted.mean(axis=0))
    center_ct = markers.points_ct.mean(axis=0)
    fitted_kinds = []
    for axes in KINDS:
        moved = _moved(axes, T_base_ct, markers.points_ct - center_ct).ravel()
        tested = lacking(root @ gaps, root @ A, root @ moved[:, None])
        if tested is not None:
            fitted_kinds.append((tested, axes, moved))
    if not fitted_kinds:
        return None
    best, axes, moved = min(fitted_kinds, key=lambda one: one[0].probability)
    amount, back = float(best.found[0]), np.linalg.pinv(A)
    beside, rigid = (column - A @ (back @ column) for column in (moved, gaps))
    at, at_moved = carried(fitted.mean(axis=0), apply(T_base_ct, target_ct))[:3], target_ct - center_ct
    whole = np.column_stack([A, moved]), np.column_stack([at, _moved(axes, T_base_ct, at_moved[None])[0]])
    return Distortion(
        axes,
        amount,
        min(1.0, len(KINDS) * best.probability),
        abs(amount) * float(np.linalg.norm(beside)) / float(np.sqrt(len(markers))),
        float(np.linalg.norm(rigid - amount * beside)) / float(np.sqrt(best.freedom)),
        _weighted_rms(root @ A, at, best.variance_without),
        _weighted_rms(root @ whole[0], whole[1], best.variance),
    )


def _moved(axes: str, T_base_ct: Floats, from_center_ct: Floats) -> Floats:
    """How points (n, 3) of the CT, from the markers' centroid, move in base axes per unit of amount, shape (n, 3)."""
    rows = ["xyz".index(axis) for axis in axes]
    M = np.zeros((3, 3))
    if len(axes) == 2:
        M[rows[0], rows[1]] = 1.0
    else:
        M[rows, rows] = 1.0
    return np.asarray(from_center_ct @ M.T @ T_base_ct[:3, :3].T)


def _weighted_rms(B: Floats, X: Floats, variance: float) -> float:
    """Expected error (rms, mm) of what X (3, p) carries from a fit of design B (m, p), whitened, to the target."""
    return float(np.sqrt(np.trace(X @ np.linalg.inv(B.T @ B) @ X.T) * variance))


ALLOWED_RESIDUALS = "check names and readings, declare the true errors, or set registration.accept_residuals = true"


@dataclass(frozen=True, eq=False)
class Registration(Shown):
    """T_base_ct from markers, with its residuals and its expected error."""

    method: str
    T_base_ct: Floats  # shape (4, 4), rigid, mm
    markers: MarkerPairs
    residuals: Floats  # shape (n, 3), T_base_ct markers_ct - markers_base, mm
    residual_test: ResidualTest
    conditioning: Conditioning
    """The three flags of a weak set, for the target given."""
    target_ct: Floats
    """The target of ``conditioning``, shape (3,), mm."""
    uncertainty: FitUncertainty | None = None
    """Covariance by the declared errors; None where none are declared."""
    aim: Aim | None = None
    """The insertion for which the pose was corrected by what the residuals show of the arm's errors; None where it was
    not. ``residuals`` are those before the correction."""

    def _facts(self) -> Facts:
        yield "method", self.method
        yield "FRE, FLE", f"{self.fre_mm:.2f} mm, {self.fle_mm:.2f} mm: {self.fle_source}"
        for name, residual in zip(self.markers.names, self.residual_mm, strict=True):
            yield f"residual of {name}", f"{residual:.2f} mm"
        yield "expected at the target", f"{self.expected_tre_mm(self.target_ct[None])[0]:.2f} mm rms"
        for flag in self.flags:
            yield "weak", flag.sentence

    @brief
    def __repr__(self) -> str:
        return f"{self.method}, {len(self.markers.names)} markers, FRE {self.fre_mm:.3f} mm, FLE {self.fle_mm:.3f} mm"

    @property
    def fle_mm(self) -> float:
        """The fiducial localisation error (rms) that the expectations use."""
        return self.residual_test.fle_mm if self.uncertainty is None else self.uncertainty.fle_mm

    @property
    def fle_source(self) -> str:
        """Where `fle_mm` comes from: declared, estimated from FRE, or scaled to the residuals."""
        if self.uncertainty is None:
            return self.residual_test.source
        test = self.uncertainty.test
        return "[errors]" + (f", scaled by {test.scale:.2f} to the residuals" if test.scaled else "")

    @property
    def fle_interval_mm(self) -> Interval:
        """The 95 % interval of `fle_mm`: one value where it is declared and agrees with the residuals."""
        if self.uncertainty is None:
            return self.residual_test.fle_interval_mm
        test, fle = self.uncertainty.test, self.uncertainty.fle_mm
        if not test.scaled:
            return Interval(fle, fle)
        return Interval(*(fle / test.scale * end for end in test.interval))

    @property
    def flags(self) -> tuple[Finding, ...]:
        """Warnings of what weakens it: conditioning, accepted residuals, an outlier marker, lists of two sizes."""
        flags = list(self.conditioning.flags)
        test = self.residual_test if self.uncertainty is None else self.uncertainty.test
        if not (self.residual_test.explained if self.uncertainty is None else self.uncertainty.test.agrees):
            scaled = self.uncertainty is not None and test.explained
            said = test.text() + ("; all errors are scaled to them" if scaled else "; accepted by the case")
            numbers = {"chi_squared": test.chi_squared}
            flags.append(Finding("residuals_unexplained", Severity.WARNING, said, numbers))
        if (outlier := outlier_marker(self.markers, self.residual_test.declared_fle_mm)) is not None:
            flags.append(outlier.finding())
        if self.distortion is not None and self.distortion.significant:
            flags.append(self.distortion.finding())
        return tuple(flags)

    @cached_property
    def distortion(self) -> Distortion | None:
        """By what one list seems deformed against the other, significant or not; None where markers cannot show it."""
        noise = None if self.uncertainty is None else self.uncertainty.noise
        return distortion(self.T_base_ct, self.markers, noise, self.target_ct)

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
        return np.sqrt([np.trace(self.tre_covariance(point)) for point in points_ct])

    def tre_covariance(self, point_ct: Floats) -> Floats:
        """Covariance of the registration error at a point (3,) of the CT frame, shape (3, 3), mm^2, base axes."""
        point_base = apply(self.T_base_ct, point_ct)
        if self.uncertainty is not None:
            return self.uncertainty.cov_at(point_base)[:3, :3]
        fitted = apply(self.T_base_ct, self.markers.points_ct)
        center = fitted.mean(axis=0)
        at = fits.carried(center, point_base)[:3] @ fits.least_squares_map(fits.design(fitted, center))
        return np.asarray(self.fle_mm**2 / 3.0 * at @ at.T)

    @property
    def freedom(self) -> int | None:
        """Degrees of freedom of the noise where the residuals gave its size; None where it is declared and agrees."""
        if self.uncertainty is not None:
            return self.uncertainty.test.freedom if self.uncertainty.test.scaled else None
        declared = self.residual_test.declared_fle_mm is not None and self.residual_test.explained
        return None if declared else self.residual_test.freedom

    def expected_tre_interval_mm(self, point_ct: Floats) -> Interval:
        """Expected target registration error (rms) at one point (3,), at both ends of the noise's 95 % interval, mm."""
        expected = float(self.expected_tre_mm(point_ct[None])[0])
        return Interval(*(expected * fle / self.fle_mm for fle in self.fle_interval_mm))


def register(
    markers: MarkerPairs,
    *,
    method: Method,
    target_ct: Floats,
    fle_mm: float | None = None,
    noise: fits.ReadingNoise | None = None,
    noise_found: bool = False,
    accept_residuals: bool = False,
    where: str | Path = "registration",
) -> Registration:
    """Fit T_base_ct, and test its residuals against the noise.

    Args:
        method: ``triad`` (Chen 2019, Eq. 1-9, three markers in the order given), ``rigid`` (least squares),
            ``weighted`` (by the declared noise) or ``joint`` (by that and what the arm does wrong at all markers).
        target_ct: Shape (3,), where the error matters.
        fle_mm: Known localisation error (rms, both sides together); None estimates it from FRE. Not beside ``noise``.
        noise: What is declared of each marker, in the order of ``markers``.
        noise_found: Whether ``noise`` is a shape alone, its size to be found from the residuals.
        accept_residuals: Whether residuals beyond the noise are accepted, and the noise is scaled to them.

    Raises:
        InputError: Markers that cannot be fitted, a method without the noise that it needs, noise that is none, or
            residuals that the noise does not explain.
    """
    # 1. The fit.
    check_pairs(markers, where)
    fre_mm = fits.rigid_fre_mm(markers.points_ct, markers.points_base)
    fit = checked_fit(
        markers.points_ct, markers.points_base, method, noise, fre_mm if noise_found else None, where=where
    )
    if method == "triad" and len(markers) != MIN_MARKERS:
        refuse(f"triad takes 3 markers, not {len(markers)}", where, "3 names in use", "wrong_count")
    T_base_ct = fit(markers.points_ct, markers.points_base)
    residuals = apply(T_base_ct, markers.points_ct) - markers.points_base
    check_residuals(markers, residuals, target_ct, where)
    # 2. Its uncertainty, by the declared noise.
    uncertainty = None
    if noise is not None:
        points = markers.points_ct, markers.points_base
        uncertainty = fit_uncertainty(method, fit, T_base_ct, *points, noise, found=noise_found)
        fle_mm = None if noise_found else noise.covariance(T_base_ct[:3, :3]).greatest_fle_mm
    # 3. Whether the noise explains the residuals; if not, what may be wrong.
    test = ResidualTest(len(markers), fre_mm, fle_mm)
    noise_test = test if uncertainty is None else uncertainty.test
    if not (noise_test.explained or accept_residuals):
        outlier = outlier_marker(markers, fle_mm)
        what = noise_test.text() if outlier is None else f"{noise_test.text()}; {outlier.text()}"
        what += better_names(markers, target_ct, fre_mm)
        deformed = distortion(T_base_ct, markers, noise, target_ct)
        what += f"; {deformed.brief()}" if deformed is not None and deformed.significant else ""
        refuse(what, where, ALLOWED_RESIDUALS, "residuals_too_large")
    # 4. Whether the markers suit the target: spread, leverage.
    weak = conditioning(markers.points_ct, target_ct)
    return Registration(method, T_base_ct, markers, residuals, test, weak, target_ct, uncertainty)


def weak_points(registration: Registration) -> Iterator[Finding]:
    """The flags of a registration, each naming it: they stand among findings of other things."""
    for flag in registration.flags:
        yield replace(flag, sentence=f"registration: {flag.sentence}")
