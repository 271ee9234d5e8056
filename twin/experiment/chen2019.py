"""Chen et al. 2019 in numbers: the paper's measurements, its printed errors, and whether a declaration explains them.

Chen G. et al., "Robot-Assisted Puncture Positioning Methods under CT Navigation", J. Xi'an Jiaotong Univ. 53(4),
2019, DOI 10.7652/xjtuxb201904013. Touches err alike in all directions: they are drawn in the CT's axes.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import minimize_scalar
from scipy.special import chdtrc

from puncture_twin.planning.base.arrays import Floats, rms
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import design, fit_affine, fit_rigid, fit_triad

Point = tuple[float, float, float]

TABLE_1: Mapping[str, Point] = {
    "A": (10, 20, 147), "B": (110, 120, 147), "C": (60, -10, 80), "D": (90, -10, 20), "E": (20, 150, 147),
    "L": (50, 150, 39), "M": (50, 130, 63), "H": (50, 120, 76),
}  # fmt: skip
"""Markers A-E and lesions L, M, H in the CT frame."""
TABLE_2: Mapping[str, Point] = {
    "A": (417.67, -291.23, 534.59), "B": (557.74, -272.83, 534.57), "C": (423.48, -231.41, 604.06),
    "L": (543.02, -336.48, 641.60), "M": (527.05, -324.48, 617.63), "H": (519.10, -318.38, 604.58),
}  # fmt: skip
"""The same, touched by the robot, first placement of the box (setup 1), base frame."""
TABLE_4: Mapping[str, Point] = {
    "A": (465.15, -298.26, 533.71), "B": (602.02, -332.68, 533.97), "C": (492.55, -244.10, 602.28),
    "D": (518.62, -227.75, 661.64), "E": (540.74, -404.60, 533.96), "M": (554.23, -370.12, 617.50),
}  # fmt: skip
"""Second placement (setup 2), base frame."""
NAMES = tuple(TABLE_1)
"""Names of all points, in the order of the rows below."""
READ: Floats = np.array(list(TABLE_1.values()), dtype=np.float64)
"""Table 1, shape (8, 3): what was read in the CT."""
READ.setflags(write=False)

SETUPS: tuple[Mapping[str, Point], ...] = (TABLE_2, TABLE_4)
"""Points that were touched in either setup."""
TRIADS = ((0, "ABC", "L"), (0, "ABC", "M"), (0, "ABC", "H"), (1, "ABC", "M"), (1, "ABE", "M"), (1, "ACD", "M"))
"""Setup, markers and lesion of Tables 3 and 5."""
AFFINE = ((1, "ABCE", "M"), (1, "ABCDE", "M"))
"""Numbers of Table 6, where least squares of twelve parameters are meant."""


def rows_of(names: str) -> list[int]:
    """Rows of points in `READ` by their names."""
    return [NAMES.index(name) for name in names]


def measured() -> tuple[Floats, ...]:
    """Touches of the paper in each setup, shape (1, 8, 3), mm, base frame; NaN where a point was not touched."""
    return tuple(np.array([[touched.get(name, (np.nan,) * 3) for name in NAMES]]) for touched in SETUPS)


def printed_errors(touched: tuple[Floats, ...]) -> dict[str, Floats]:
    """Every printed error of n experiments, by name, (n,), mm, of touches (n, 8, 3) in each setup, rows as `NAMES`."""
    by_triad = list(triad_errors(touched, READ).items())
    residuals = _misses(_fitted(fit_triad, touched[0], READ, "ABC"), touched[0], READ, "ABC")
    errors = dict([*by_triad[:2], ("mean residual of A-B-C, setup 1", residuals.mean(axis=1)), *by_triad[2:]])
    for setup, markers, lesion in AFFINE:
        T = np.array([fit_affine(READ[rows_of(markers)], one[rows_of(markers)]) for one in touched[setup]])
        misses = _misses(T, touched[setup], READ, lesion)[:, 0]
        errors[f"{lesion} by {'-'.join(markers)} (affine), setup {setup + 1}"] = misses
    return errors


def triad_errors(touched: tuple[Floats, ...], read: Floats) -> dict[str, Floats]:
    """The errors of Tables 3 and 5 of n experiments, (n,) each, mm, of points ``read`` (8, 3) in the CT."""
    errors = {}
    for setup, markers, lesion in TRIADS:
        T = _fitted(fit_triad, touched[setup], read, markers)
        errors[f"{lesion} by {'-'.join(markers)}, setup {setup + 1}"] = _misses(T, touched[setup], read, lesion)[:, 0]
    return errors


def _fitted(fit: Callable[[Floats, Floats], Floats], touched: Floats, read: Floats, names: str) -> Floats:
    rows = rows_of(names)
    return fit(np.broadcast_to(read[rows], (len(touched), len(rows), 3)), touched[:, rows])


def _misses(T: Floats, touched: Floats, read: Floats, names: str) -> Floats:
    return np.asarray(np.linalg.norm(_residuals(T, touched, read, names), axis=2))


def _residuals(T: Floats, touched: Floats, read: Floats, names: str) -> Floats:
    """Touched minus fitted, shape (n, k, 3), base frame."""
    rows = rows_of(names)
    return np.asarray(touched[:, rows] - (read[rows] @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]))


POINTS = tuple("".join(touched) for touched in SETUPS)
"""Names of the points of each setup."""
FREEDOM = sum(3 * len(names) - 6 for names in POINTS)
"""24: of both setups together."""

STRAINS: Mapping[str, tuple[int, int]] = {
    "scale of x": (0, 0), "scale of y": (1, 1), "scale of z": (2, 2),
    "x against y": (0, 1), "x against z": (0, 2), "y against z": (1, 2),
}  # fmt: skip
"""What one number may be wrong with a CT's frame: an axis that moves along another, or along itself."""


def rigid_residuals(touched: tuple[Floats, ...]) -> tuple[Floats, ...]:
    """Residuals of each setup: touched minus fitted by its points, CT axes, (n, p, 3), from touches (n, 8, 3), mm."""
    residuals = []
    for names, points in zip(POINTS, touched, strict=True):
        T = _fitted(fit_rigid, points, READ, names)
        residuals.append(_residuals(T, points, READ, names) @ T[:, :3, :3])  # R^T r: into CT axes
    return tuple(residuals)


def axis_squares(residuals: tuple[Floats, ...]) -> Floats:
    """Sums of squares per axis of the CT, both setups, shape (n, 3), mm^2."""
    return np.asarray(sum(np.sum(one**2, axis=1) for one in residuals))


def chi_squared(residuals: tuple[Floats, ...], declaration: Declaration) -> Floats:
    """Chi-squared of both setups against a declaration, (n,); `FREEDOM` degrees. One carton: C is not diagonal.

    With z the stacked residuals in CT axes, A the motion's design and C the declaration's covariance:

        chi^2 = z' P z,   P = C^-1 - C^-1 A (A' C^-1 A)^-1 A' C^-1,   3 p - 6 degrees of freedom for p points.
    """
    rows = np.array(rows_of("".join(POINTS)))
    axes = (3 * rows[:, None] + np.arange(3)).ravel()
    cov = declaration.carton_covariance(READ)[np.ix_(axes, axes)] + declaration.touch_mm**2 * np.eye(len(axes))
    A, weights = block_diag(*(_design(names) for names in POINTS)), np.linalg.inv(cov)
    P = weights - weights @ A @ np.linalg.solve(A.T @ weights @ A, A.T @ weights)
    z = np.concatenate([one.reshape(len(one), -1) for one in residuals], axis=1)
    return np.asarray(np.einsum("na,ab,nb->n", z, P, z))


def _design(names: str) -> Floats:
    points = READ[rows_of(names)]
    return design(points, points.mean(axis=0))


def strain_gains(residuals: tuple[Floats, ...]) -> dict[str, Floats]:
    """Fraction of both setups' sum of squares that each strain alone takes away, shape (n,) each.

    A strain that moves the points by k b takes (b' M z)^2 / (b' M b) off the sum of squares, M = I - A (A' A)^-1 A'.
    """
    whole = axis_squares(residuals).sum(axis=1)
    gains = {}
    for name, (moved, along) in STRAINS.items():
        # one number for both setups: numerator and denominator add up before the square
        dot, norm = np.zeros(len(whole)), 0.0
        for names, one in zip(POINTS, residuals, strict=True):
            points, A = READ[rows_of(names)], _design(names)
            b = np.zeros(points.shape)
            b[:, moved] = (points - points.mean(axis=0))[:, along]
            left = b.ravel() - A @ np.linalg.lstsq(A, b.ravel(), rcond=None)[0]  # M b
            dot, norm = dot + one.reshape(len(one), -1) @ left, norm + float(left @ left)
        gains[name] = dot**2 / norm / whole
    return gains


REJECTED = 1e-6
"""A declaration under which the paper's residuals are less likely is not its."""
MARGINAL = (5.0, 95.0)
JOINT = (2.5, 97.5)
"""Percentiles between which a printed error, and a joint statistic, lies where a declaration is right."""


@dataclass(frozen=True)
class DrawnRank:
    """Percentile of a number of the paper among draws of it, 0 to 100, and percentiles of the draws."""

    name: str
    paper: float
    percentile: float
    low: float
    median: float
    high: float

    def within(self, bounds: tuple[float, float]) -> bool:
        """Whether the percentile lies within bounds."""
        return bool(bounds[0] <= self.percentile <= bounds[1])


@dataclass(frozen=True)
class Experiment:
    """The paper's experiment under one declaration."""

    declaration: Declaration
    draws: int
    printed: tuple[DrawnRank, ...]
    joint: tuple[DrawnRank, ...]
    probability: float  # of a chi-squared as large as the paper's, by the law with 24 degrees
    best_strain: float  # fraction of draws in which some strain takes away as much as the paper's best one does
    several: Mapping[str, tuple[float, float]]
    """See `several_triads`: mm by the paper's own points, and rms of the draws."""

    @property
    def rejected(self) -> bool:
        """Whether all points together contradict the declaration."""
        return self.probability < REJECTED

    @property
    def agrees(self) -> bool:
        """Whether every printed error and every joint statistic is as usual as it should be."""
        return all(one.within(MARGINAL) for one in self.printed) and all(one.within(JOINT) for one in self.joint)


def run_draws(declaration: Declaration, draws: int, rng: np.random.Generator) -> Experiment:
    """Draw carton, readings and touches of both setups, and compute every number of the paper from them."""
    carton = declaration.draw_carton(READ, draws, rng)  # one box: both setups touch the same points
    touched = tuple(declaration.draw_touches(carton, rng) for _ in SETUPS)
    paper, drawn = rigid_residuals(measured()), rigid_residuals(touched)
    chi = float(chi_squared(paper, declaration)[0])
    several, drawn_several = several_triads(measured()[SETUP]), several_triads(touched[SETUP])
    return Experiment(
        declaration,
        draws,
        _ranks(printed_errors(measured()), printed_errors(touched)),
        _ranks(_joint(paper, declaration), _joint(drawn, declaration)),
        float(chdtrc(FREEDOM, chi)),
        float(np.mean(_best(drawn) >= _best(paper)[0])),
        {name: (float(off[0]), rms(drawn_several[name])) for name, off in several.items()},
    )


def paper_strains() -> Mapping[str, float]:
    """Fraction of the paper's sum of squares that each strain of the CT's frame alone takes away."""
    return {name: float(gain[0]) for name, gain in strain_gains(rigid_residuals(measured())).items()}


def _joint(residuals: tuple[Floats, ...], declaration: Declaration) -> dict[str, Floats]:
    squares = axis_squares(residuals)
    named = {f"squares along {axis}": squares[:, column] for column, axis in enumerate("xyz")}
    return {**named, "chi-squared": chi_squared(residuals, declaration)}


def _best(residuals: tuple[Floats, ...]) -> Floats:
    return np.asarray(np.max(list(strain_gains(residuals).values()), axis=0))


def _ranks(paper: Mapping[str, Floats], drawn: Mapping[str, Floats]) -> tuple[DrawnRank, ...]:
    rows = []
    for name, values in drawn.items():
        low, median, high = np.percentile(values, (5, 50, 95))
        at = float(paper[name][0])
        rows.append(DrawnRank(name, at, 100.0 * float(np.mean(values < at)), float(low), float(median), float(high)))
    return tuple(rows)


MARKERS, SETUP = "ABCDE", 1
"""From which the skew is found: the markers of the second setup, no lesion among them."""
WIDEST = 0.3
"""tan of 17 degrees: no scanner is farther out of square."""


class Skew(NamedTuple):
    """The skew of y against z, rad; and each triad's error at a lesion as printed, and with it taken off, mm."""

    angle: float
    lesions: Mapping[str, tuple[float, float]]


def find_skew() -> Skew:
    """Find the skew from the markers of setup 2 alone, and take it off before every triad of both setups."""
    rows, touched = rows_of(MARKERS), measured()
    markers = touched[SETUP][0][rows]

    def squares(k: float) -> float:
        square = unskewed(READ, k)[rows]
        return float(np.sum((apply(fit_rigid(square, markers), square) - markers) ** 2))

    k = float(minimize_scalar(squares, bounds=(-WIDEST, WIDEST), method="bounded", options={"xatol": 1e-9}).x)
    read, square = triad_errors(touched, READ), triad_errors(touched, unskewed(READ, k))
    return Skew(float(np.arctan(k)), {name: (float(read[name][0]), float(square[name][0])) for name in read})


def unskewed(points: Floats, k: float) -> Floats:
    """Points (n, 3) with y moved by k along z, mm."""
    unskewed_points = points.copy()
    unskewed_points[:, 1] += k * points[:, 2]
    return unskewed_points


TRIPLES = tuple("".join(one) for one in combinations(MARKERS, 3))


def several_triads(touched: Floats) -> dict[str, Floats]:
    """Errors of lesion M by several triads of the markers of setup 2, (n,), mm, of touches (n, 8, 3) as `NAMES`."""
    at = READ[rows_of("M")]
    poses = np.array([_fitted(fit_triad, touched, READ, names) for names in TRIPLES])
    points, there = poses[..., :3, :3] @ at[0] + poses[..., :3, 3], touched[:, rows_of("M")[0]]
    off = np.linalg.norm(points - there, axis=2)
    best, *_, worst = sorted(TRIPLES, key=lambda names: spread_of(READ[rows_of(names)], at))
    every = _fitted(fit_rigid, touched, READ, MARKERS)
    return {
        f"the best-placed triad, {'-'.join(best)}": off[TRIPLES.index(best)],
        f"the worst-placed triad, {'-'.join(worst)}": off[TRIPLES.index(worst)],
        f"one of all {len(TRIPLES)} triads, rms": np.sqrt(np.mean(off**2, axis=0)),
        "mean of the points of all triads": np.linalg.norm(points.mean(axis=0) - there, axis=1),
        "rigid fit of all five markers": _misses(every, touched, READ, "M")[:, 0],
    }


def spread_of(markers: Floats, at: Floats) -> float:
    """Rms error at a point (1, 3), mm, per mm of independent error of markers (k, 3) along each axis, before any touch.

    With D the design of the markers and d that of the point, the trace of d (D'D)^-1 d'.
    """
    D, d = design(markers, markers.mean(axis=0)), design(at, markers.mean(axis=0))
    return float(np.sqrt(np.trace(d @ np.linalg.solve(D.T @ D, d.T))))


BED = 0
"""The CT's axis along the bed: the slices lie across it."""
PLANES = ((0, 1), (0, 2), (1, 2))
"""Pairs of CT axes that may be askew: the first along the second."""


@dataclass(frozen=True)
class Declaration:
    """Declared errors of one experiment: uniform in slices and pixels, normal readings and touches per axis, mm."""

    name: str
    slice_mm: float = 0.0
    pixel_mm: float = 0.0
    reading_mm: float = 0.0
    skew: float = 0.0  # standard deviation of each plane's angle, rad: one draw for the whole CT
    touch_mm: float = 0.0

    def draw_carton(self, read: Floats, count: int, rng: np.random.Generator) -> Floats:
        """Draw true points (count, p, 3) of points (p, 3) that were read."""
        cells = rng.uniform(-0.5, 0.5, (count, *read.shape)) * self._cell()
        found = read + cells + rng.normal(0.0, 1.0, (count, *read.shape)) * self.reading_mm
        for first, second in PLANES:
            tangents = np.tan(rng.normal(0.0, 1.0, count) * self.skew)
            found[..., first] += tangents[:, None] * (read - read.mean(axis=0))[:, second]
        return np.asarray(found)

    def draw_touches(self, true: Floats, rng: np.random.Generator) -> Floats:
        """Touches of true points (..., 3), same shape."""
        return np.asarray(true + rng.normal(0.0, 1.0, true.shape) * self.touch_mm)

    def carton_covariance(self, read: Floats) -> Floats:
        """Covariance of true points about their readings (p, 3), shape (3 p, 3 p), mm^2; skews to first order."""
        cov = np.diag(np.tile(self._cell() ** 2 / 12 + self.reading_mm**2, len(read)))
        for first, second in PLANES:
            moved = np.zeros(read.shape)
            moved[:, first] = (read - read.mean(axis=0))[:, second]
            cov += self.skew**2 * np.outer(moved.ravel(), moved.ravel())
        return np.asarray(cov)

    def _cell(self) -> Floats:
        cell = np.full(3, self.pixel_mm)
        cell[BED] = self.slice_mm
        return cell


AS_STATED = Declaration("as the paper states", slice_mm=5.0, pixel_mm=1.0, touch_mm=0.1)
"""Slices of 5 mm, pixels read to 1 mm, a control error of 0.1 mm."""
AS_FOUND = Declaration("as its touches show", reading_mm=0.5, skew=float(np.radians(2.0)), touch_mm=0.35)
"""A CT out of square, readings and touches as the distances between its points show (docs/reference/validation.md)."""
