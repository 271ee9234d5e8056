"""How far a needle may be off and still be safe for the organs, as far as the grid tells."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.case.angle_grid import AngleGrid
from puncture_twin.planning.case.entry import outward
from puncture_twin.planning.search.candidates import CONE_OF_GRID, Candidates

DIAGONAL = np.sqrt(2.0)
"""Of a cell, in steps, at the equator; nearer to the poles cells are narrower."""


def with_grid_cone(found: Candidates) -> Candidates:
    """The candidates with the safe cone of each safe one; those of no regular grid as they are.

    Args:
        found: Candidates with their verdicts by the organs alone: what an arm reaches makes no path safer.
    """
    if found.grid is None:
        return found
    cone = np.full(len(found), np.nan)
    cone[found.safe] = grid_cone(found.grid, found.safe)
    return replace(found, safe_cone=cone, cone_source=CONE_OF_GRID)


def grid_cone(grid: AngleGrid, safe: Bools) -> Floats:
    """By how much each safe direction may be off, in any direction, shape (number of safe ones,), rad.

    The angle to the nearest direction of the grid that is not safe, or to the nearest beyond the grid, less a cell's
    diagonal. A disc as wide as that diagonal holds a direction of the grid; so where such a disc fits into what is not
    safe, beside its border, the cone ends before it. What is thinner may pass between the directions: only a
    certificate excludes that.

    Args:
        grid: The directions.
        safe: Shape (n,), row by row.
    """
    theta, beta = np.repeat(grid.theta, len(grid.beta)), np.tile(grid.beta, len(grid.theta))
    border = _border(grid, safe)
    barred = np.concatenate([outward(theta[border], beta[border]), outward(*grid.beyond())])
    if not len(barred):
        return np.full(int(safe.sum()), np.pi)
    chord = np.empty(int(safe.sum()))
    _least_chords(outward(theta[safe], beta[safe]), barred, chord)
    return np.maximum(2 * np.arcsin(np.clip(chord / 2, 0.0, 1.0)) - DIAGONAL * grid.step, 0.0)


def _border(grid: AngleGrid, safe: Bools) -> Bools:
    """Directions among which, or beyond the grid, is one that is not safe and nearest to a safe one, whichever it is.

    They are not safe themselves, and lie beside a safe one or at an end of the azimuths. From any other, the step
    towards the safe one, first in azimuth the shorter way and then in θ, stays in the grid and ends nearer (at a pole
    in the same direction) in one that is not safe either.
    """
    pairs = grid.neighbours()
    ends = pairs[safe[pairs[:, 0]] != safe[pairs[:, 1]]].ravel()
    border = np.zeros((len(grid.theta), len(grid.beta)), bool)
    border.ravel()[ends] = True
    if not grid.full_circle:
        border[:, [0, -1]] = True
    return np.asarray(border.ravel() & ~safe)


@allocation_free()
def _least_chords(points, others, chords):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``chords`` (n,) with the distance of each point (n, 3) from the nearest of the others (m, 3)."""
    for i in range(len(points)):
        least = np.inf
        for k in range(len(others)):
            x, y, z = points[i, 0] - others[k, 0], points[i, 1] - others[k, 1], points[i, 2] - others[k, 2]
            least = min(least, x * x + y * y + z * z)
        chords[i] = np.sqrt(least)
