"""The bending of a shaft in an elastic foundation, by finite elements.

    EI w'''' + k(x) (w - c) = p

w is the deflection, c where the foundation would rest (the path that was cut), k its stiffness by length (N/mm^2), p a
load. Cubic Hermite elements, one banded solve (Hetenyi, Beams on Elastic Foundation, 1946, has the closed forms that
`tests/needle` holds it against). The shaft is clamped at its first node.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Floats

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
