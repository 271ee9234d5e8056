"""Uncertainty breakdown of one candidate: its chances, the sources of its error, and which one would have to shrink.

An error's variance enters every covariance linearly: a source of f times its deviation leaves Sigma - (1 - f^2) part.
The registration's weights stay as they are: with better ones the errors could be a little larger.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.search.chances import ChanceModel, refined_chances, touch_limit
from puncture_twin.planning.uncertainty.guided import WayChance
from puncture_twin.planning.uncertainty.hit import Proximity, hit_in_ball, hit_in_mesh, touch_chance
from puncture_twin.planning.uncertainty.lines import Needles
from puncture_twin.planning.uncertainty.pose_error import ErrorBudget, error_budget
from puncture_twin.planning.uncertainty.sources import SOURCES, deviation, not_modelled, reading_parts

WISHED_HIT = 0.99
"""Chance to hit that is wanted where the case demands none."""
HALVINGS = 40
"""Halvings of a factor's interval: its error is far below any digit that is printed."""
LEAST_FRACTION = 0.005
"""Fraction of the variance below which a source is not named to people."""


class Remedy(NamedTuple):
    """One source that alone could satisfy a limit: its declared and its needed deviation, in its key's unit."""

    source: str
    declared: float
    needed: float


@dataclass(frozen=True)
class Goal:
    """A limit that is not satisfied, and the errors that would have to shrink for it."""

    structure: str  # what is touched too likely; "" where the target is hit too unlikely
    limit: float
    stated: bool
    remedies: tuple[Remedy, ...]
    """The single sources that could mend it, the one that has to shrink least first."""
    all_sources: float | None
    """By which factor all of them together would have to shrink; None where not even 0 is enough."""

    def text(self) -> str:
        """One sentence on the errors that would have to shrink."""
        claim = f"{self.limit:g} to {f'touch {self.structure}' if self.structure else 'hit'}"
        if not self.remedies:
            if self.all_sources is None:
                return f"{claim} is not possible, however small the errors"
            shrunk = f"all errors together would have to shrink to {100 * self.all_sources:.0f} %"
            return f"for {claim} no single error suffices: {shrunk}"
        source, declared, needed = self.remedies[0]
        source_text, key, unit = SOURCES[source]
        return f"for {claim} the {source_text} ({key}) would have to be {needed:.2g} {unit} instead of {declared:.2g}"

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON, in the units of the keys of ``[errors]``."""
        return {
            "structure": self.structure,
            "limit": self.limit,
            "stated": self.stated,
            "all_sources_times": self.all_sources,
            "single_sources": [
                {"source": one.source, "key": SOURCES[one.source].key, "declared": one.declared, "needed": one.needed}
                for one in self.remedies
            ],
        }


@dataclass(frozen=True, eq=False)
class UncertaintyBreakdown:
    """Chances, error budget and unmet limits of one candidate."""

    p_hit: float
    p_touch: Mapping[str, float]  # structure to chance to touch it
    p_touch_any: float  # of any, min(1, sum)
    budget: ErrorBudget
    declaration: str  # whether the markers' residuals agree with the declared errors, in one sentence
    goals: tuple[Goal, ...]
    """Limits that are not satisfied: the case's, or `WISHED_HIT` where it demands no chance to hit."""
    not_modelled: str

    @property
    def likeliest(self) -> tuple[str, float]:
        """The structure that is touched most likely, and its chance; ("", 0) without structures."""
        return max(self.p_touch.items(), key=lambda item: item[1], default=("", 0.0))

    def sources(self) -> list[tuple[str, float]]:
        """Sources worth naming with their fraction of the error's variance, the largest first."""
        fractions = sorted(self.budget.fraction.items(), key=lambda item: -item[1])
        return [(source, fraction) for source, fraction in fractions if fraction >= LEAST_FRACTION]

    def sentence(self) -> str:
        """Chances and the largest sources in one line."""
        name, chance = self.likeliest
        parts = [f"{chance_text(self.p_hit)} to hit"]
        parts += [f"{chance_text(chance)} to touch {name}"] if name else []
        parts += [
            f"{100 * fraction:.0f} % of the uncertainty is {SOURCES[source].text}"
            for source, fraction in self.sources()[:1]
        ]
        return "; ".join([*parts, *(goal.text() for goal in self.goals)])

    def lines(self) -> list[str]:
        """Further lines of text for a person, below the sentence."""
        budget, axes = self.budget, ", ".join(f"{mm:.2f}" for mm in self.budget.half_axes_mm)
        fractions = ", ".join(f"{SOURCES[source].text} {100 * fraction:.0f} %" for source, fraction in self.sources())
        return [
            self.sentence(),
            f"  expected tip error {budget.rms_mm:.2f} mm (rms), in this configuration of the arm: "
            f"{budget.lateral_mm:.2f} across the needle, {budget.depth_mm:.2f} along it; "
            f"half axes of the 95 % ellipsoid {axes} mm",
            f"  sources of its variance: {fractions}",
            f"  {self.declaration}",
            f"  touches a structure to avoid: {chance_text(self.p_touch_any)} at most, the sum over all structures",
            f"  not modelled: {self.not_modelled}",
        ]

    def summary(self) -> dict[str, Any]:
        """Plain values for JSON."""
        return {
            "p_hit": self.p_hit,
            "p_touch": dict(self.p_touch),
            "p_touch_any": self.p_touch_any,
            "expected_rms_mm": self.budget.rms_mm,
            "expected_lateral_mm": self.budget.lateral_mm,
            "expected_depth_mm": self.budget.depth_mm,
            "half_axes_95_mm": self.budget.half_axes_mm.tolist(),
            "share": dict(self.budget.fraction),
            "declaration": self.declaration,
            "for_the_limits": [goal.summary() for goal in self.goals],
            "not_modelled": self.not_modelled,
        }


def chance_text(chance: float) -> str:
    """A chance for people: never 0 nor 1, not even where a float can no longer tell the difference."""
    if chance < 5e-5:
        return "<0.0001"
    if chance > 1 - 5e-5:
        return ">0.9999"
    digits = 2 if 0.0095 <= chance <= 0.99 else 4
    return f"{chance:.{digits}f}"


def way_cells(one: WayChance) -> tuple[str, str, str, str, str]:
    """Expected result of one kind of guidance, as a row of a table under `WAY_HEAD`."""
    if np.isnan(one.p_hit):
        return one.way, "-", "-", "-", one.lost_sight
    return one.way, f"{one.expected_error_mm:.2f}", chance_text(one.p_hit), chance_text(one.p_stop), one.lost_sight


WAY_HEAD = ("guidance", "expected tip error (rms), mm", "chance to hit", "to be stopped", "out of sight")


def uncertainty_breakdown(model: ChanceModel, outward_ct: Floats, q: Floats) -> UncertaintyBreakdown:
    """The uncertainty breakdown of one candidate, its chances line-sampled as those of the table's best are.

    Of a unit vector (3,) from the target along the needle, and joints (6,), rad, the tip on the target.
    """
    needle = (outward_ct[None], q[None])
    chances = refined_chances(model, *needle, model.chances(*needle))
    touch = dict(zip(chances.structures, map(float, chances.touch[0]), strict=True))
    sources = ShrinkableNeedle(model, model.needles(*needle), error_parts(model, q))
    return UncertaintyBreakdown(
        float(chances.hit[0]),
        MappingProxyType(touch),
        float(chances.touch_any[0]),
        error_budget(model.error, q, model.error.fit.R_base_ct @ outward_ct),
        model.error.fit.test.text(),
        tuple(goals_of(sources, float(chances.hit[0]), touch)),
        not_modelled(model.case),
    )


class _Part(NamedTuple):
    """One source's part of Sigma6, shape (6, 6), CT axes, and of the target's reading, (3, 3)."""

    cov6: Floats
    target: Floats


def error_parts(model: ChanceModel, q: Floats) -> dict[str, _Part]:
    """Parts of all sources at one configuration (6,); a target read in the markers' CT shrinks with them."""
    error, R = model.error, model.error.fit.R_base_ct
    turn, scale = np.kron(np.eye(2), R), error.fit.test.scale**2
    none = np.zeros((3, 3))
    whole = {source: turn.T @ cov[0] @ turn for source, cov in error.parts(q[None]).items()}
    whole["repeatability"] = whole["repeatability"] + whole.pop("arrival")
    parts = {source: _Part(cov, none) for source, cov in whole.items()}
    if np.array_equal(error.errors.target_cov_ct, error.errors.marker_cov_ct):
        for source, cov in reading_parts(error.errors.target_cov_ct).items():
            parts[source] = parts[source]._replace(target=scale * cov)
    else:
        parts["target"] = _Part(np.zeros((6, 6)), scale * error.errors.target_cov_ct)
    parts["surface"] = _Part(np.zeros((6, 6)), none)  # moves no needle
    return parts


class ShrinkableNeedle(NamedTuple):
    """One candidate whose error is split into sources that can be shrunk."""

    model: ChanceModel
    needles: Needles
    parts: Mapping[str, _Part]

    def chance(self, structure: str, factors: Mapping[str, float]) -> float:
        """Chance to touch a structure, or to hit where it is "", with some deviations times factors."""
        squares = {source: factors.get(source, 1.0) ** 2 for source in self.parts}
        cov6 = np.asarray(sum(squares[source] * part.cov6 for source, part in self.parts.items()))
        surface_mm = factors.get("surface", 1.0) * self.surface_mm(structure)
        hit, freedom, near = self.model.hit, self.model.error.freedom, self.needles.near
        if structure:
            at = [self.model.structures.index(structure)]
            gradient = near.gradient[:, at]
            variance = np.einsum("nka,ab,nkb->nk", gradient, cov6, gradient) + surface_mm**2
            shrunk = Proximity(near.distance[:, at], gradient, np.sqrt(np.maximum(variance, 0.0)))
            return float(touch_chance(shrunk, self.model.case.needle.radius_mm, freedom)[0, 0])
        if hit.radius_mm is not None:
            target = np.asarray(sum(squares[source] * part.target for source, part in self.parts.items()))
            return float(hit_in_ball((cov6[:3, :3] + target)[None], hit.radius_mm, freedom)[0])
        assert hit.rays is not None
        return float(hit_in_mesh(hit.rays, cov6[None, :3, :3], freedom, surface_mm)[0])

    def surface_mm(self, structure: str) -> float:
        """Standard deviation of a structure's surface as a whole, or of the target's where it is "", mm."""
        if not structure:
            return self.model.target_surface_mm
        return float(self.needles.surface_mm[0, self.model.structures.index(structure)])


def goals_of(needle: ShrinkableNeedle, p_hit: float, p_touch: Mapping[str, float]) -> list[Goal]:
    """The limits that are not satisfied, each with its remedies."""
    case, goals = needle.model.case, []
    least = WISHED_HIT if case.search.min_hit is None else case.search.min_hit
    if p_hit < least:
        goals.append(_goal(needle, "", least, stated=case.search.min_hit is not None))
    for name, chance in p_touch.items():
        if chance > touch_limit(case, name):
            goals.append(_goal(needle, name, touch_limit(case, name), stated=True))
    return goals


def _goal(needle: ShrinkableNeedle, structure: str, limit: float, *, stated: bool) -> Goal:
    def passes(factors: Mapping[str, float]) -> bool:
        chance = needle.chance(structure, factors)
        return chance <= limit if structure else chance >= limit

    errors, remedies = needle.model.error.errors.scaled(needle.model.error.fit.test.scale), []
    for source in needle.parts:
        factor = _greatest(lambda f, source=source: passes({source: f}))  # type: ignore[misc]
        if factor is not None:
            declared = needle.surface_mm(structure) if source == "surface" else deviation(errors, source)
            remedies.append((factor, Remedy(source, declared, factor * declared)))
    together = _greatest(lambda f: passes(dict.fromkeys(needle.parts, f)))
    ordered = tuple(remedy for _, remedy in sorted(remedies, key=lambda one: -one[0]))
    return Goal(structure, limit, stated, ordered, together)


def _greatest(passes: Callable[[float], bool]) -> float | None:
    """The greatest factor below 1 that passes, by halving; None where not even 0 does."""
    if not passes(0.0):
        return None
    low, high = 0.0, 1.0
    for _ in range(HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if passes(middle) else (low, middle)
    return low
