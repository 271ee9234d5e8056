"""Do the markers' residuals fit the noise, and which marker does not? The chi-squared test of a rigid fit, its noise.

With normal errors of standard deviation fle/sqrt(3) in each axis, both sides together, N markers of a rigid fit leave
nu s^2 = 3 sum |r_i|^2 / fle^2, distributed as chi-squared with nu = 3 N - 6 degrees of freedom.

How well a set of markers determines a registration at a point: expected error, and the three flags of a weak set.
"""

from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.special import chdtrc, chdtri, fdtrc, fdtri

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import Finding, Severity
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid, least_squares_map
from puncture_twin.planning.registration.marker_pairs import MarkerPairs

REJECT_LEVEL = 0.001
"""Significance level of rejection: honest noise exceeds such residuals once in 1,000 registrations."""
MAX_FRE_MM = 5.0
"""Without a declared noise: markers that miss by more (rms) are not the same markers, or have moved."""
MIN_FLE_MM = 0.3
"""An estimate below is luck, not accuracy: a voxel of 0.4 mm leaves 0.2 mm, a touch of 0.1 mm in each axis 0.17 mm."""
ALIKE_MM = 1.0
"""Without a declared noise: a permuted fit with a smaller FRE is always as good as the given one."""
INTERVAL = 0.95
"""Of every interval and region that is printed."""


FALSE_ALARM = 0.01
"""One honest set of markers in a hundred is said to have an odd one: it is a warning, and a look at it is cheap."""
LEAST_MARKERS = 4
"""The others must fit each other with something left over: three points leave three degrees of freedom."""
LEAST_SPREAD = 0.01
"""Second over first singular value of the others below which they are one line, and place nothing."""


class Interval(NamedTuple):
    """Lower and upper bound, mm."""

    low: float
    high: float


@dataclass(frozen=True)
class ResidualTest:
    """The residuals of a rigid fit against the noise."""

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
        """Of residuals as large as these by the declared noise; NaN where none is declared."""
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
        """What the test found, in words."""
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
        """The same, as a warning."""
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


WARNED = 0.01
"""Residuals that the declared errors exceed once in 100 registrations: it is warned, and the errors are scaled."""


@dataclass(frozen=True)
class NoiseTest:
    """The residuals of a weighted fit against the declared errors."""

    count: int  # markers, N >= 3
    chi_squared: float
    """r' C^-1 r of the weighted residuals: chi-squared with 3 N - 6 degrees where the declaration holds."""
    found: bool = False
    """Whether the declaration gives the errors' shape alone, and the residuals their size."""

    @property
    def freedom(self) -> int:
        """Degrees of freedom, nu = 3 N - 6."""
        return 3 * self.count - 6

    @property
    def probability(self) -> float:
        """Chance of residuals as large as these, if the declaration holds."""
        return float(chdtrc(self.freedom, self.chi_squared))

    @property
    def agrees(self) -> bool:
        """Whether the residuals agree with the declaration, or nothing was declared about their size."""
        return self.found or self.probability >= WARNED

    @property
    def explained(self) -> bool:
        """Whether a registration with such residuals is taken at all without the case's consent."""
        return self.found or self.probability >= REJECT_LEVEL

    @property
    def estimate(self) -> float:
        """s, the size of the errors by the residuals over the declared one."""
        return float(np.sqrt(self.chi_squared / self.freedom))

    @property
    def interval(self) -> Interval:
        """The 95 % interval of the true size over the declared one: nu s^2 over chi-squared."""
        tail = (1 - INTERVAL) / 2
        low, high = (float(np.sqrt(self.chi_squared / chdtri(self.freedom, p))) for p in (tail, 1 - tail))
        return Interval(low, high)

    @property
    def scale(self) -> float:
        """Factor of the declared deviations: 1 where the declaration holds."""
        return self.estimate if self.found or not self.agrees else 1.0

    @property
    def scaled(self) -> bool:
        """Whether the size is that of the residuals, so that chances follow Student's t and regions Fisher's F."""
        return self.found or not self.agrees

    @property
    def region_factor(self) -> float:
        """The k of the 95 % region d' Sigma^-1 d <= k^2 in three dimensions, Sigma scaled: sqrt(chi2) or sqrt(3 F)."""
        if self.scaled:
            return float(np.sqrt(3 * fdtri(3, self.freedom, INTERVAL)))
        return float(np.sqrt(chdtri(3, 1 - INTERVAL)))

    def text(self) -> str:
        """What the test found, in one sentence."""
        low, high = self.interval
        size = f"the residuals show {self.estimate:.2f} times the declared errors (95 %: {low:.2f} to {high:.2f})"
        if self.found:
            return f"noise found: {size}"
        verdict = "agree with" if self.agrees else "do not agree with"
        return (
            f"residuals {verdict} the declared errors (chi-squared {self.chi_squared:.1f}, {self.freedom} degrees of "
            f"freedom, p {self.probability:.2g}); {size}"
        )


def noise_test(residuals: Floats, cov: Floats, A: Floats, *, found: bool = False) -> NoiseTest:
    """Test the stacked residuals (3 N,) of any fit, whose design is A (3 N, 6), against their covariance (3 N, 3 N).

    They are first freed of what the best weights would have fitted: r = M z, M = I - A (A' C^-1 A)^-1 A' C^-1.
    """
    weights = np.asarray(np.linalg.inv(cov), dtype=np.float64)
    free = residuals - A @ (least_squares_map(A, weights) @ residuals)
    return NoiseTest(len(residuals) // 3, float(free @ weights @ free), found)


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
