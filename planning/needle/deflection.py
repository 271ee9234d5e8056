"""Deflection of a needle with a bevel: its bound in any direction, its path through given tissues, and its shaft.

**Bound** (`DeflectionBound`): the path of a bevel that never rotates, all the way in the stiffest tissue of the case:
the stiffer the tissue, the more a bevel steers. A stiff layer before soft ones can take it further: the allowance for
that was found by search, not proven (what is proven of every order is several times as wide:
docs/concepts/needle-and-tissue.md). With lengths over 1/lambda, only the shaft's own and the layers' are left, so that
search holds for any needle. In given layers the path is linear in alpha, and a bevel that never rotates goes furthest.

**Path**: a bevel cuts at an angle alpha to the shaft behind it. A lateral force at the tip of a bent beam alone gives a
path that depends on the step; the path is kinematic (Webster et al., Int. J. Robotics Research 25, 2006):

    dy/ds = w'(tip) + alpha,   w(tip) = y(s)

with w the shaft in the foundation of the path that was cut (mechanics: Misra et al., Int. J. Robotics Research 29,
2010). Explicit in s, by the two-step formula of Adams and Bashforth.

**Shaft**: gauges, stiffness, sag and the load at which it buckles, N and mm, by the closed forms of Euler and
Bernoulli (Young and Budynas, Roark's Formulas for Stress and Strain).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.labels.naming import ByName

ALLOWANCE = 0.25
"""Added to the bevel's part. Tested, not proven: the worst order of layers is a thin stiff one before a gap, the worse
the more slender the shaft is. With lambda L the shaft's length over 1/lambda it goes 8 % beyond the stiffest tissue
alone at 40, 14 % at 80, 19 % at 150 and 27 % at 400; the step adds 1.5 % (3 % at first)."""
SHORTEST_BEND_MM = 2.5
"""1/lambda, over which a foundation bends a shaft: no tissue bends a needle within less, that a case was made for."""
MOST_SLENDER = 150.0
"""Length of a shaft over 1/lambda: beyond, the allowance does not hold."""


@dataclass(frozen=True, eq=False)
class DeflectionBound:
    """Greatest deflection over path length, to any side."""

    depth_mm: Floats  # shape (m,), of the tip in the tissue, from 0, ascending
    bevel_mm: Floats  # shape (m,), that the bevel causes, ascending
    sag_mm: float  # that the shaft's own weight causes, held horizontally

    def at(self, path_length: Floats | float) -> Floats:
        """Bound for paths of these lengths (any shape), mm: that of the table's next depth; infinite beyond its end.

        NaN, where there is no path, stays NaN.
        """
        length = np.asarray(path_length, dtype=np.float64)
        row = np.searchsorted(self.depth_mm, np.nan_to_num(length))
        bounds = np.append(self.bevel_mm, np.inf)[np.minimum(row, len(self.bevel_mm))] + self.sag_mm  # inf past the end
        return np.asarray(np.where(np.isnan(length), np.nan, bounds))


def deflection_bound(shaft: Shaft, alpha: float, tissues: Iterable[Tissue], longest_mm: float) -> DeflectionBound:
    """The bound of a needle with a bevel of alpha, rad, in a case's tissues."""
    stiffest = max((tissue.stiffness_n_mm2 for tissue in tissues), default=0.0)
    step = step_for(shaft, stiffest)
    count = int(np.ceil(longest_mm / step))
    path = bevel_path(shaft, np.full(count, stiffest), np.full(count, alpha), step)
    return DeflectionBound(path.depth_mm, (1 + ALLOWANCE) * path.largest_mm, shaft.sag_mm)


def shortest_bend(shaft: Shaft) -> float:
    """The least 1/lambda, mm, for which the bound of a shaft holds."""
    return max(SHORTEST_BEND_MM, shaft.length_mm / MOST_SLENDER)


def stiffest_resolved(shaft: Shaft) -> float:
    """The stiffest tissue whose foundation bends a shaft over `shortest_bend` or more, N/mm^2."""
    return 4 * shaft.bending_stiffness / shortest_bend(shaft) ** 4


@dataclass(frozen=True)
class Bending:
    """A needle with a bevel, and the tissues by the names of their structures."""

    shaft: Shaft
    alpha: float  # by which the bevel's cut leaves the shaft's direction, rad
    tissues: ByName[Tissue]  # the pattern ``*`` is all that no structure names

    def bound(self, longest_mm: float) -> DeflectionBound:
        """Bound of the deflection on paths up to a length, mm."""
        return deflection_bound(self.shaft, self.alpha, self.tissues.of_pattern.values(), longest_mm)


BANDS = 4
"""Diagonals of the matrix, the main one among them: a node is coupled with its neighbours, each with w and w'."""


class Shape(NamedTuple):
    """Bent shape of n nodes."""

    deflection: Floats  # shape (n,), mm
    slope: Floats  # shape (n,), rad
    tip_force: float  # of its support, N
    clamp_force: float  # that it bears of all that presses on the shaft, N
    clamp_moment: float  # about itself, N mm


@dataclass(frozen=True, eq=False)
class Beam:
    """A shaft cut into equal elements."""

    stiffness: float  # EI, N mm^2
    step: float  # length of an element, mm
    elements: int

    def bent(self, foundation: Floats, rest: Floats, *, tip_mm: float | None = None, tip_load: float = 0.0) -> Shape:
        """The shape in a foundation k (elements,), N/mm^2, 0 in the air, at rest c at the nodes (elements + 1,), mm.

        Rest is linear between nodes. Something holds the tip at a deflection, mm, or it is free (None), under a lateral
        load, N.
        """
        bands, h, first, second = self._bands(foundation), self.step, rest[:-1], rest[1:]
        load = np.zeros(2 * (self.elements + 1))  # the integral of k c N over each element
        load[0:-2:2] += foundation * h / 20 * (7 * first + 3 * second)
        load[1:-2:2] += foundation * h * h / 60 * (3 * first + 2 * second)
        load[2::2] += foundation * h / 20 * (3 * first + 7 * second)
        load[3::2] -= foundation * h * h / 60 * (2 * first + 3 * second)
        load[-2] += tip_load  # the last two unknowns are the tip's w and w'
        free = bands[:, 2:]  # the first node is clamped
        right = load[2:].copy()
        if tip_mm is None:
            return _shape(scipy.linalg.solveh_banded(free, right, lower=True, check_finite=False), 0.0, (bands, load))
        at = free.shape[1] - 2  # the unknown that is known
        clamped = free.copy()
        for below in range(1, BANDS):  # move its column to the right side
            right[at - below] -= free[below, at - below] * tip_mm
            clamped[below, at - below] = 0.0
        right[at + 1] -= free[1, at] * tip_mm
        clamped[1:, at] = 0.0
        clamped[0, at], right[at] = 1.0, tip_mm
        solution = scipy.linalg.solveh_banded(clamped, right, lower=True, check_finite=False)
        row = sum(free[below, at - below] * solution[at - below] for below in range(1, BANDS))
        # the row that was replaced
        force = row + free[0, at] * solution[at] + free[1, at] * solution[at + 1] - load[-2]
        return _shape(solution, float(force), (bands, load))

    def _bands(self, foundation: Floats) -> Floats:
        """The stiffness matrix in lower banded form, shape (BANDS, 2 (elements + 1))."""
        h, size = self.step, 2 * (self.elements + 1)
        bends = [[12, 6 * h, -12, 6 * h], [0, 4 * h * h, -6 * h, 2 * h * h], [0, 0, 12, -6 * h], [0, 0, 0, 4 * h * h]]
        beds = [[156, 22 * h, 54, -13 * h], [0, 4 * h * h, 13 * h, -3 * h * h], [0, 0, 156, -22 * h]]
        beds.append([0, 0, 0, 4 * h * h])
        bending, bedding = self.stiffness / h**3 * np.array(bends), h / 420 * np.array(beds)
        bands = np.zeros((BANDS, size))
        for row in range(4):
            for column in range(row, 4):
                each = bending[row, column] + foundation * bedding[row, column]
                bands[column - row, row : row + 2 * self.elements : 2] += each  # two unknowns a node
        return bands


def _shape(solution: Floats, force: float, system: tuple[Floats, Floats]) -> Shape:
    """The shape with the clamped node in front, whose two rows give the clamp's reaction."""
    bands, load = system
    bears = load[0] - bands[2, 0] * solution[0] - bands[3, 0] * solution[1]
    moment = load[1] - bands[1, 1] * solution[0] - bands[2, 1] * solution[1]
    shape = np.concatenate([[0.0], solution[0::2]]), np.concatenate([[0.0], solution[1::2]])
    return Shape(*shape, force, float(bears), float(moment))


STEP_MM = 1.0
"""Step of an insertion, at most. Where `step_for` asks for less it is shorter."""
OF_BENDING, OF_LENGTH = 1 / 16, 1 / 64
"""Ratio of a step to the length 1/rate within which a shaft bends in the stiffest tissue, and over the shaft's own.
Halving it then changes a path by less than 1.5 % from the sixteenth step on, and by less than 3 % before:
`tests/needle` samples what a case may declare. With steps of 1 mm alone it was 11 % in thin needles."""


def step_for(shaft: Shaft, stiffest: float) -> float:
    """Step of an insertion's simulation, mm, by the largest k on its path, N/mm^2; rate = (k / 4 EI)^(1/4)."""
    rate = (stiffest / (4 * shaft.bending_stiffness)) ** 0.25
    return float(min(STEP_MM, OF_LENGTH * shaft.length_mm, OF_BENDING / max(rate, OF_BENDING / STEP_MM)))


@dataclass(frozen=True, eq=False)
class BevelPath:
    """A path of m steps, in the plane of the bevel."""

    depth_mm: Floats  # shape (m + 1,), how far the tip is in
    cut_mm: Floats  # shape (m + 1,), how far the path is off the straight line there
    needle_mm: Floats  # shape (m + 1,), how far the shaft is off at those depths, once it is all in
    largest_mm: Floats  # shape (m + 1,), the greatest deflection anywhere along the shaft, up to each depth
    holder_n: Floats  # shape (m + 1,), the lateral force of the tissue that the holder bears at each depth
    holder_n_mm: Floats  # shape (m + 1,), its moment about its clamp


def bevel_path(shaft: Shaft, stiffness: Floats, alpha: Floats, step_mm: float) -> BevelPath:
    """Insert a needle step by step (`step_for`); its length is rounded to whole steps.

    In each of m steps of depth: k of the tissue (m,), N/mm^2, and the bevel's angle alpha (m,), rad, whose sign is the
    side to which it points.
    """
    count = len(stiffness)
    elements = max(round(shaft.length_mm / step_mm), count)  # the path may be as long as the shaft
    beam = Beam(shaft.bending_stiffness, step_mm, elements)
    cut, largest, holder, moment = np.zeros((4, count + 1))
    before, slope, shape = 0.0, 0.0, None
    for done in range(count):
        ahead = 1.5 * slope - 0.5 * before  # Adams and Bashforth, two steps
        cut[done + 1] = cut[done] + step_mm * (ahead + alpha[done])
        foundation, rest = np.zeros(elements), np.zeros(elements + 1)  # the shaft's last part is in the tissue
        foundation[elements - done - 1 :], rest[elements - done - 1 :] = stiffness[: done + 1], cut[: done + 2]
        shape = beam.bent(foundation, rest, tip_mm=float(cut[done + 1]))
        before, slope = slope, float(shape.slope[-1])
        holder[done + 1], moment[done + 1] = shape.clamp_force, shape.clamp_moment
        largest[done + 1] = max(largest[done], float(np.abs(shape.deflection).max()), abs(cut[done + 1]))
    needle: Floats = cut if shape is None else np.asarray(shape.deflection[elements - count :])
    depth = step_mm * np.arange(count + 1, dtype=np.float64)
    return BevelPath(depth, cut, needle, largest, holder, moment)


STEEL_GPA = 200.0
"""Young's modulus of the austenitic steels of which needles are drawn: 193 to 200."""
STEEL_N_MM3 = 7.93e-6 * 9.81
"""Weight of such steel by volume: 7.93 g/cm^3."""
FREE_TIP, PINNED_TIP = np.pi**2 / 4, 20.1907
"""Euler's load times L^2 / EI of a clamped column with a free, and with a pinned end: the least root of tan x = x."""


class Gauge(NamedTuple):
    """Nominal diameters of a regular-wall needle, mm."""

    outer_mm: float
    inner_mm: float


GAUGES: Mapping[int, Gauge] = MappingProxyType({
    10: Gauge(3.404, 2.692), 11: Gauge(3.048, 2.388), 12: Gauge(2.769, 2.159), 13: Gauge(2.413, 1.803),
    14: Gauge(2.108, 1.600), 15: Gauge(1.829, 1.372), 16: Gauge(1.651, 1.194), 17: Gauge(1.473, 1.067),
    18: Gauge(1.270, 0.838), 19: Gauge(1.067, 0.686), 20: Gauge(0.908, 0.603), 21: Gauge(0.819, 0.514),
    22: Gauge(0.718, 0.413), 23: Gauge(0.641, 0.337), 24: Gauge(0.565, 0.311), 25: Gauge(0.514, 0.260),
})  # fmt: skip
"""The usual chart of nominal diameters of regular-wall needles."""


@dataclass(frozen=True)
class Shaft:
    """A straight round shaft, clamped at its holder."""

    length_mm: float  # from the holder to the tip
    outer_mm: float
    inner_mm: float = 0.0  # of the bore; 0 for a solid shaft
    modulus_gpa: float = STEEL_GPA  # Young's

    @property
    def bending_stiffness(self) -> float:
        """EI, N mm^2, with I = pi (D^4 - d^4) / 64."""
        return self.modulus_gpa * 1e3 * np.pi * (self.outer_mm**4 - self.inner_mm**4) / 64

    @property
    def sag_mm(self) -> float:
        """Sag of the free tip of a horizontal steel shaft, mm: q L^4 / 8 EI, q its weight by length."""
        weight = STEEL_N_MM3 * np.pi * (self.outer_mm**2 - self.inner_mm**2) / 4
        return weight * self.length_mm**4 / (8 * self.bending_stiffness)

    def buckling_n(self, *, pinned: bool) -> float:
        """Axial load at which the shaft buckles, N: Euler's, its tip free, or pinned in the skin."""
        return (PINNED_TIP if pinned else FREE_TIP) * self.bending_stiffness / self.length_mm**2


@dataclass(frozen=True)
class Tissue:
    """Mechanical properties of one tissue."""

    stiffness_n_mm2: float  # k, by which it holds the shaft: force by length of shaft and by deflection
    cutting_n: float = 0.0  # force at the tip while it cuts
    friction_n_mm: float = 0.0  # along the shaft, by length of it inside
    capsule_n: float = 0.0  # force at which its surface ruptures; 0 has none
    capsule_mm: float = 0.0  # how far the surface is pushed in by then
    held_n_mm: float | None = None
    """Force along the needle that moves it as a whole by 1 mm against the body; None moves nothing."""


class Layer(NamedTuple):
    """A tissue from one depth to the next, mm from the skin along the path."""

    start_mm: float
    end_mm: float
    tissue: Tissue
