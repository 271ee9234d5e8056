"""Many experiments drawn from a declaration, and where the paper's own one stands among them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from scipy.special import chdtrc

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.experiment.declarations import Declaration
from puncture_twin.twin.experiment.printed import READ, SETUPS, measured, printed_errors
from puncture_twin.twin.experiment.residuals import (
    FREEDOM,
    axis_squares,
    chi_squared,
    rigid_residuals,
    strain_gains,
)

REJECTED = 1e-6
"""A declaration under which the paper's residuals are less likely is not its."""

MARGINAL = (5.0, 95.0)
JOINT = (2.5, 97.5)
"""Percentiles between which a printed error, and a joint statistic, lies where a declaration is right."""


@dataclass(frozen=True)
class Standing:
    """A number of the paper among as many draws of it.

    Attributes:
        name: Of the number.
        paper: The paper's, by its own points.
        percentile: Of the draws below it, 0 to 100.
        low: 5th percentile of the draws.
        median: Of the draws.
        high: 95th percentile of the draws.
    """

    name: str
    paper: float
    percentile: float
    low: float
    median: float
    high: float

    def within(self, bounds: tuple[float, float]) -> bool:
        """Whether it is as usual as that."""
        return bool(bounds[0] <= self.percentile <= bounds[1])


@dataclass(frozen=True)
class Experiment:
    """The paper's experiment under one declaration.

    Attributes:
        declaration: What was drawn from.
        draws: So many.
        printed: Each printed error, mm.
        joint: Sums of squares per axis of the CT (mm^2), and chi-squared, over all points of both setups.
        probability: Of a chi-squared as large as the paper's, by the law with 24 degrees.
        best_strain: Fraction of draws in which some strain takes away as much as the paper's best one does.
    """

    declaration: Declaration
    draws: int
    printed: tuple[Standing, ...]
    joint: tuple[Standing, ...]
    probability: float
    best_strain: float

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
    return Experiment(
        declaration,
        draws,
        _standings(printed_errors(measured()), printed_errors(touched)),
        _standings(_joint(paper, declaration), _joint(drawn, declaration)),
        float(chdtrc(FREEDOM, chi)),
        float(np.mean(_best(drawn) >= _best(paper)[0])),
    )


def paper_strains() -> Mapping[str, float]:
    """Fraction of the paper's sum of squares that each strain of the CT's frame alone takes away."""
    return MappingProxyType({name: float(gain[0]) for name, gain in strain_gains(rigid_residuals(measured())).items()})


def _joint(residuals: tuple[Floats, ...], declaration: Declaration) -> dict[str, Floats]:
    squares = axis_squares(residuals)
    named = {f"squares along {axis}": squares[:, column] for column, axis in enumerate("xyz")}
    return {**named, "chi-squared": chi_squared(residuals, declaration)}


def _best(residuals: tuple[Floats, ...]) -> Floats:
    return np.asarray(np.max(list(strain_gains(residuals).values()), axis=0))


def _standings(paper: Mapping[str, Floats], drawn: Mapping[str, Floats]) -> tuple[Standing, ...]:
    rows = []
    for name, values in drawn.items():
        low, median, high = np.percentile(values, (5, 50, 95))
        at = float(paper[name][0])
        rows.append(Standing(name, at, 100.0 * float(np.mean(values < at)), float(low), float(median), float(high)))
    return tuple(rows)
