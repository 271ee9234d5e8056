"""The path that a bevel cuts, and the needle in it.

A bevel cuts at an angle alpha to the shaft behind it. A lateral force at the tip of a bent beam alone gives a path that
depends on the step; the path is kinematic (Webster et al., Int. J. Robotics Research 25, 2006):

    dy/ds = w'(tip) + alpha,   w(tip) = y(s)

with w the shaft in the foundation of the path that was cut (mechanics: Misra et al., Int. J. Robotics Research 29,
2010). Explicit in s, by the two-step formula of Adams and Bashforth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.needle.shaft import Shaft

BANDS = 4
"""Diagonals of the matrix, the main one among them: a node is coupled with its neighbours, each with w and w'."""


class Shape(NamedTuple):
    """Of n nodes: deflection (mm) and slope (rad), shape (n,), and forces, N and N mm.

    The tip's is what held it; the clamp's are what it bears of all that presses on the shaft, a moment about itself.
    """

    deflection: Floats
    slope: Floats
    tip_force: float
    clamp_force: float
    clamp_moment: float


@dataclass(frozen=True, eq=False)
class Beam:
    """A shaft cut into equal elements.

    Attributes:
        stiffness: EI, N mm^2.
        step: Length of an element, mm.
        elements: Their number.
    """

    stiffness: float
    step: float
    elements: int

    def bent(self, foundation: Floats, rest: Floats, *, tip_mm: float | None = None, tip_load: float = 0.0) -> Shape:
        """The shape in a foundation, with the tip's deflection given, or loaded.

        Args:
            foundation: k of each element, shape (elements,), N/mm^2; 0 in the air.
            rest: c at the nodes, shape (elements + 1,), mm, linear between them.
            tip_mm: The deflection at which something holds the tip; None leaves it free.
            tip_load: Lateral force on a free tip, N.
        """
        bands, load = self._bands(foundation), self._load(foundation, rest)
        load[-2] += tip_load
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
        found = scipy.linalg.solveh_banded(clamped, right, lower=True, check_finite=False)
        row = sum(free[below, at - below] * found[at - below] for below in range(1, BANDS))
        force = row + free[0, at] * found[at] + free[1, at] * found[at + 1] - load[-2]
        return _shape(found, float(force), (bands, load))

    def _bands(self, foundation: Floats) -> Floats:
        """The stiffness matrix in lower banded form, shape (BANDS, 2 (elements + 1))."""
        h, size = self.step, 2 * (self.elements + 1)
        bending = (
            self.stiffness
            / h**3
            * np.array(
                [[12, 6 * h, -12, 6 * h], [0, 4 * h * h, -6 * h, 2 * h * h], [0, 0, 12, -6 * h], [0, 0, 0, 4 * h * h]]
            )
        )
        bedding = (
            h
            / 420
            * np.array(
                [
                    [156, 22 * h, 54, -13 * h],
                    [0, 4 * h * h, 13 * h, -3 * h * h],
                    [0, 0, 156, -22 * h],
                    [0, 0, 0, 4 * h * h],
                ]
            )
        )
        bands = np.zeros((BANDS, size))
        for row in range(4):
            for column in range(row, 4):
                each = bending[row, column] + foundation * bedding[row, column]
                bands[column - row, row : row + 2 * self.elements : 2] += each
        return bands

    def _load(self, foundation: Floats, rest: Floats) -> Floats:
        """What the foundation pulls with, shape (2 (elements + 1),): the integral of k c N over each element."""
        h, first, second = self.step, rest[:-1], rest[1:]
        load = np.zeros(2 * (self.elements + 1))
        load[0:-2:2] += foundation * h / 20 * (7 * first + 3 * second)
        load[1:-2:2] += foundation * h * h / 60 * (3 * first + 2 * second)
        load[2::2] += foundation * h / 20 * (3 * first + 7 * second)
        load[3::2] -= foundation * h * h / 60 * (2 * first + 3 * second)
        return load


def _shape(found: Floats, force: float, system: tuple[Floats, Floats]) -> Shape:
    """With the clamped node in front, whose two rows of the system say what the clamp must hold against."""
    bands, load = system
    bears = load[0] - bands[2, 0] * found[0] - bands[3, 0] * found[1]
    moment = load[1] - bands[1, 1] * found[0] - bands[2, 1] * found[1]
    shape = np.concatenate([[0.0], found[0::2]]), np.concatenate([[0.0], found[1::2]])
    return Shape(*shape, force, float(bears), float(moment))


STEP_MM = 1.0
"""Of an insertion, at most. Where `step_for` asks for less it is shorter."""

OF_BENDING, OF_LENGTH = 1 / 16, 1 / 64
"""Of a step over the length 1/rate within which a shaft bends in the stiffest tissue, and over the shaft's own. Halving
it then changes a path by less than 1.5 % from the sixteenth step on, and by less than 3 % before: `tests/needle`
samples what a case may declare. With steps of 1 mm alone it was 11 % in thin needles."""


def step_for(shaft: Shaft, stiffest: float) -> float:
    """The step in which an insertion is followed, mm.

    Args:
        shaft: The needle's.
        stiffest: The largest k that it meets, N/mm^2; rate = (k / 4 EI)^(1/4).
    """
    rate = (stiffest / (4 * shaft.bending_stiffness)) ** 0.25
    return float(min(STEP_MM, OF_LENGTH * shaft.length_mm, OF_BENDING / max(rate, OF_BENDING / STEP_MM)))


@dataclass(frozen=True, eq=False)
class BevelPath:
    """A path of m steps, in the plane of the bevel.

    Attributes:
        depth_mm: Shape (m + 1,), how far the tip is in.
        cut_mm: Shape (m + 1,), how far the path is off the straight line there.
        needle_mm: Shape (m + 1,), how far the shaft is off at those depths, once it is all in.
        tip_force_n: Shape (m + 1,), the lateral force between tip and tissue as each depth was reached.
        largest_mm: Shape (m + 1,), the greatest deflection anywhere along the shaft, up to each depth.
        holder_n: Shape (m + 1,), the lateral force of the tissue that the holder bears at each depth.
        holder_n_mm: Shape (m + 1,), its moment about where the shaft is held.
    """

    depth_mm: Floats
    cut_mm: Floats
    needle_mm: Floats
    tip_force_n: Floats
    largest_mm: Floats
    holder_n: Floats
    holder_n_mm: Floats


def bevel_path(shaft: Shaft, stiffness: Floats, alpha: Floats, step_mm: float) -> BevelPath:
    """Insert a needle step by step.

    Args:
        shaft: Its length is rounded to whole steps.
        stiffness: k of the tissue in each step of depth, shape (m,), N/mm^2.
        alpha: The bevel's angle in each, shape (m,), rad; its sign is the side to which the bevel points.
        step_mm: Length of a step: see `step_for`.
    """
    count = len(stiffness)
    elements = max(round(shaft.length_mm / step_mm), count)
    beam = Beam(shaft.bending_stiffness, step_mm, elements)
    cut, force, largest, holder, moment = np.zeros((5, count + 1))
    before, slope, shape = 0.0, 0.0, None
    for done in range(count):
        ahead = 1.5 * slope - 0.5 * before
        cut[done + 1] = cut[done] + step_mm * (ahead + alpha[done])
        shape = _inserted(beam, stiffness[: done + 1], cut[: done + 2])
        before, slope, force[done + 1] = slope, float(shape.slope[-1]), shape.tip_force
        holder[done + 1], moment[done + 1] = shape.clamp_force, shape.clamp_moment
        largest[done + 1] = max(largest[done], float(np.abs(shape.deflection).max()), abs(cut[done + 1]))
    needle: Floats = cut if shape is None else np.asarray(shape.deflection[elements - count :])
    depth = step_mm * np.arange(count + 1, dtype=np.float64)
    return BevelPath(depth, cut, needle, force, largest, holder, moment)


def _inserted(beam: Beam, stiffness: Floats, cut: Floats) -> Shape:
    """The shaft with its last part in the tissue, and its tip on the end of the path."""
    foundation, rest = np.zeros(beam.elements), np.zeros(beam.elements + 1)
    foundation[beam.elements - len(stiffness) :] = stiffness
    rest[beam.elements - len(stiffness) :] = cut
    return beam.bent(foundation, rest, tip_mm=float(cut[-1]))
