"""A regular grid of (θ, β): which directions are neighbours, what solid angle each stands for, what lies beyond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints

SAME_ANGLE = 1e-9
"""Radians within which θ is at a pole: rounding of degrees."""


@dataclass(frozen=True, eq=False)
class AngleGrid:
    """m puncture angles by k azimuths, row by row with θ outermost; rad.

    Attributes:
        theta: Shape (m,), ascending.
        beta: Shape (k,), ascending.
        step: Between neighbours, of both.
        full_circle: The last azimuth's next neighbour is the first.
    """

    theta: Floats
    beta: Floats
    step: float
    full_circle: bool

    def __len__(self) -> int:
        return len(self.theta) * len(self.beta)

    def solid_angle(self) -> Floats:
        """What each direction stands for, shape (m k,), sr: to the middle between neighbours, nothing beyond the grid.

        The integral of sin θ dθ dβ over each cell: together they are the grid's whole solid angle.
        """
        inner = (self.theta[1:] + self.theta[:-1]) / 2
        edges = np.concatenate([self.theta[:1], inner, self.theta[-1:]])
        width = np.full(len(self.beta), self.step)
        if not self.full_circle:
            width[[0, -1]] = 0.5 * self.step if len(self.beta) > 1 else 0.0
        return np.outer(-np.diff(np.cos(edges)), width).ravel()

    def neighbours(self) -> Ints:
        """Pairs of rows one step apart, shape (e, 2); all rows at a pole are one direction, and so neighbours."""
        rows = np.arange(len(self)).reshape(len(self.theta), len(self.beta))
        pairs = [(rows[:-1], rows[1:]), (rows[:, :-1], rows[:, 1:])]
        if self.full_circle:
            pairs.append((rows[:, -1:], rows[:, :1]))
        at_pole = rows[self._at_pole()]
        pairs.append((at_pole[:, :-1], at_pole[:, 1:]))
        return np.concatenate([np.stack([a.ravel(), b.ravel()], axis=1) for a, b in pairs])

    def beyond(self) -> tuple[Floats, Floats]:
        """Directions (θ, β) one step outside of the grid, which nobody has asked about, shape (b,) each."""
        outside = []
        if self.theta[0] > SAME_ANGLE:
            outside.append(_product(self.theta[:1] - self.step, self.beta))
        if self.theta[-1] < np.pi - SAME_ANGLE:
            outside.append(_product(self.theta[-1:] + self.step, self.beta))
        if not self.full_circle:
            ends = np.array([self.beta[0] - self.step, self.beta[-1] + self.step])
            outside.append(_product(self.theta, ends))
        theta, beta = np.concatenate([np.zeros((2, 0)), *outside], axis=1)
        return np.clip(theta, 0.0, np.pi), beta

    def _at_pole(self) -> Ints:
        return np.flatnonzero((self.theta < SAME_ANGLE) | (self.theta > np.pi - SAME_ANGLE))


def _product(theta: Floats, beta: Floats) -> Floats:
    return np.stack([np.repeat(theta, len(beta)), np.tile(beta, len(theta))])
