"""A case with all that it names, prepared once for every question about it.

`prepare` reads the case: structures, clearance engine, the arm in its workcell. `CaseContext` then searches its grid,
checks and explains single directions, and gives errors and provenance. A search also reports what else would be safe
(`alternatives`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import cached_property, partial
from importlib.metadata import version
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from puncture_twin.planning.anatomy.anatomy import Anatomy, load_anatomy
from puncture_twin.planning.anatomy.unseen import BEYOND_IMAGE, beyond_images
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import NO_MEMORY, Cache, Memory, user_cache
from puncture_twin.planning.base.errors import Finding, Severity, refuse
from puncture_twin.planning.base.progress import LOG, Silent, Stages, Watcher
from puncture_twin.planning.base.provenance import differing_input, inputs_document, read_inputs
from puncture_twin.planning.base.text import Facts, Shown, brief, first_few, plural
from puncture_twin.planning.case.case import Case, load_case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import ClearanceEngine
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import CrossChecked, FclEngine, VerifiedEngine, cross_check
from puncture_twin.planning.collision.workcell import own_checker, with_surroundings
from puncture_twin.planning.evidence.checks import findings
from puncture_twin.planning.reach.standoff import axis_lengths, case_axis_lengths
from puncture_twin.planning.registration.placement import Placement, load_placement
from puncture_twin.planning.search.bedside import EntryFacts, Landmark, entry_facts
from puncture_twin.planning.search.bending import check_tissues
from puncture_twin.planning.search.candidates import ARM_CHECKED, Candidates
from puncture_twin.planning.search.chances import ChanceModel, chance_model
from puncture_twin.planning.search.constraints import ArmReach
from puncture_twin.planning.search.explain import Explanation
from puncture_twin.planning.search.phases import breath_warnings
from puncture_twin.planning.search.search import organ_safe, search
from puncture_twin.planning.search.sides import Side, sides_of, sides_text
from puncture_twin.planning.search.uncertainty_breakdown import UncertaintyBreakdown, uncertainty_breakdown
from puncture_twin.planning.uncertainty.pose_error import PoseError, pose_error

ENGINES: Mapping[str, Callable[..., ClearanceEngine]] = MappingProxyType({"fast": FastEngine, "fcl": FclEngine})
"""Clearance engines by name: the fast exact engine, and FCL alone as the plain reference."""
EngineChoice = str | Callable[..., ClearanceEngine]
"""A name of `ENGINES`, or a custom class, made of (meshes, progress), that implements `ClearanceEngine`.

Its distances are verified against the fast engine's (`VerifiedEngine`): they may be smaller, and never larger."""
TARGET_CACHE_BYTES = 2_000_000_000
"""Upper limit of the cache that a context shares with those that `at` makes of it for other targets."""
NO_BASE = "the case does not state where the robot's base is"
ALLOWED_BASE = "[registration] with markers or a transform, or [robot.mount]"


@dataclass(frozen=True, eq=False)
class CaseContext(Shown):
    """A prepared case: everything that questions about it need, read once."""

    case: Case
    anatomy: Anatomy
    placement: Placement | None
    """Where the patient is for the robot, T_base_ct; None where the case does not say."""
    engine: ClearanceEngine
    reach: ArmReach | None
    """The checker of the arm; None without a placement."""
    chance: ChanceModel | None
    """Model of the declared errors; None where the case declares none, or the arm is not checked."""
    watcher: Watcher
    stages: Stages
    """How long reading took; later stages are added as they happen."""
    memory: Memory
    """What other targets of the same anatomy share."""

    def _title(self) -> str:
        return f"Case {self.case.name}, prepared"

    def _facts(self) -> Facts:
        yield "structures", first_few([one.name for one in self.anatomy.structures])
        yield "arm", self.arm_note
        yield "sides", sides_text(self.sides) or "of no body"
        for warning in self.anatomy.warnings:
            yield "warning", warning

    def __reduce__(self) -> tuple[Any, ...]:
        """For another process, which builds engine and checkers anew: compiled objects cannot be pickled."""
        return _build_context, (self.case, self.anatomy, self.placement, self._engine_choice, self.reach is not None)

    @property
    def _engine_choice(self) -> EngineChoice:
        kind = type(self.engine.custom if isinstance(self.engine, VerifiedEngine) else self.engine)
        return next((name for name, known in ENGINES.items() if kind is known), kind)

    def at(self, target_ct: ArrayLike) -> CaseContext:
        """The context of another target in the same anatomy.

        It is what `prepare` makes of the case with that target: nothing is taken over that the target decides. What it
        does not decide comes from memory, which the first other target fills.

        Args:
            target_ct: Shape (3,), mm, LPS (or the case's local frame).

        Raises:
            InputError: As `prepare`: a target outside the skin or its structure, in an organ to be avoided, no point.
        """
        case, arm = self.case.replace(target_ct=target_ct), self.reach is not None
        return prepare(case, arm=arm, engine=self._engine_choice, memory=self.memory, known=self.anatomy.warnings)

    @brief
    def __repr__(self) -> str:
        return f"case {self.case.name}, {plural(len(self.anatomy.structures), 'structure')}; arm {self.arm_note}"

    @property
    def arm_note(self) -> str:
        """Whether the arm is checked, and if not, why: see `Candidates.arm_note`."""
        if self.reach is not None:
            return ARM_CHECKED
        return f"not checked: {NO_BASE if self.placement is None else 'switched off (--no-arm)'}"

    def require_arm(self) -> ArmReach:
        """The checker of the arm. Raises InputError: Says what the case lacks, or that the arm was switched off."""
        if self.placement is None:
            refuse(NO_BASE, self.case.path, ALLOWED_BASE, "no_base")
        if self.reach is None:
            refuse("the arm is switched off", self.case.path, "a case that is prepared with its arm", "no_base")
        return self.reach

    def own(self, candidates: Candidates | None) -> Candidates:
        """The candidates, if they are this case's; None searches.

        Raises:
            InputError: They are of another case, or of its files before a change: what is safe there says nothing here.
        """
        if candidates is None:
            return self.search()
        stated = candidates.provenance.get("inputs")
        name = None if stated is None else differing_input(read_inputs(stated), self.case.inputs)
        if name is not None:
            what = f"input '{name}' is not the one that the candidates were searched with"
            refuse(what, self.case.path, "a search of this case", "input_changed")
        return candidates

    @property
    def pose_error(self) -> PoseError | None:
        """The needle's pose error, if the case declares errors and has markers, also where the arm is not checked."""
        return pose_error(self.case, None if self.placement is None else self.placement.registration)

    @cached_property
    def sides(self) -> tuple[Side, ...]:
        """Sides of the body from which the target can be approached, and which of them the case's grid covers."""
        return sides_of(self.case, self.anatomy)

    def search(self) -> Candidates:
        """Check the case's whole grid."""
        with self.stages.time("search"):
            candidates = search(
                self.case,
                self.anatomy,
                self.engine,
                self.case.directions(),
                reach=self.reach,
                chance=self.chance,
                progress=partial(self.watcher.count, "directions of the arm"),
            )
            others = tuple(alternatives(self.case, self.anatomy, self.engine, candidates, self.memory))
        return replace(candidates, arm_note=self.arm_note, findings=others, provenance=self.provenance())

    def check(self, theta: Floats | float, beta: Floats | float) -> Candidates:
        """Check a single direction, or several, shape (n,), rad, without the grid's windows and safe cones."""
        directions = self.case.direction(theta, beta)
        candidates = search(self.case, self.anatomy, self.engine, directions, reach=self.reach, chance=self.chance)
        return replace(candidates, arm_note=self.arm_note, provenance=self.provenance())

    def explain(self, theta: float, beta: float) -> Explanation:
        """Check a single direction (rad), with everything it was checked against and its uncertainty."""
        candidates = self.check(theta, beta)
        known = candidates.chances is not None and np.isfinite(candidates.chances.hit[0])
        breakdown = self.breakdown_at(candidates.outward_ct[0], candidates.arm.q_insertion[0]) if known else None
        facts = self.entry_facts(candidates.path.entry_ct[0], candidates.outward_ct[0])
        return Explanation(self.case, self.anatomy, candidates, facts, breakdown)

    def entry_facts(self, entry_ct: Floats, outward_ct: Floats) -> EntryFacts:
        """Skin entry (3,), mm, and outward direction (3,), unit, described to a person at the patient."""
        registration = None if self.placement is None else self.placement.registration
        known = ((), ()) if registration is None else (registration.markers.names, registration.markers.points_ct)
        markers = tuple(Landmark(f"marker {name}", point) for name, point in zip(*known, strict=True))
        grid = None if self.anatomy.scan is None else self.anatomy.scan.grid
        return entry_facts(self.case, markers, entry_ct, outward_ct, grid)

    def breakdown_at(self, outward_ct: Floats, q: Floats) -> UncertaintyBreakdown | None:
        """Uncertainty breakdown of a direction (3,) at joints (6,), rad, as of a plan; None without declared errors."""
        return None if self.chance is None else uncertainty_breakdown(self.chance, outward_ct, q)

    def regions_ct(self, q: Floats) -> Floats | None:
        """The tip's 95 % region about the target: x' inv(region) x <= 1, shape (n, 3, 3), mm^2, CT axes.

        Of joints ``q`` (n, 6), rad, the tip on the target; where they are NaN (the arm does not reach it) the region is
        too. None without declared errors.
        """
        if self.chance is None:
            return None
        error, known = self.chance.error, np.isfinite(q).all(axis=1)
        regions = np.full((len(q), 3, 3), np.nan)
        if known.any():
            regions[known] = error.fit.test.region_factor**2 * error.tip_covariance_ct(q[known])
        return regions

    def cross_check(self, count: int) -> CrossChecked:
        """Measure random directions of the grid again with FCL.

        Raises CrossCheckError: A distance differs by more than rounding.
        """
        with self.stages.time("cross-check"):
            case, outward = self.case, self.case.directions().outward_ct
            meshes = tuple(structure.mesh for structure in self.anatomy.checked)
            length, rng = case_axis_lengths(case, self.anatomy, outward), np.random.default_rng(case.rehearsal.seed)
            distances = self.engine.measure(case.target_ct, outward, length)
            return cross_check(distances, meshes, case.target_ct, outward, length, count=count, rng=rng)

    def provenance(self) -> dict[str, Any]:
        """Provenance of a result: case, inputs, version, grid."""
        return {
            "case": self.case.name,
            "inputs": inputs_document(self.case.inputs),
            "version": version("puncture-twin"),
            "seed": self.case.rehearsal.seed,
            "step_deg": float(np.degrees(self.case.search.step)),
            "arm": self.arm_note,
            "warnings": list(self.anatomy.warnings),
            "findings": [one.document() for one in self.anatomy.findings],
        }


def prepare(
    case: Case | Path | str,
    *,
    arm: bool | None = None,
    engine: EngineChoice = "fast",
    watcher: Watcher | None = None,
    memory: Memory = NO_MEMORY,
    known: tuple[str, ...] = (),
) -> CaseContext:
    """Prepare a case: read it and everything that it names.

    Args:
        case: A case, its file, or the folder that holds ``case.toml``.
        arm: Whether the arm is checked too; None checks it where the case says where its base is.
        memory: What this process keeps from one case to the next; the answer is the same.
        known: Warnings that are not logged again.

    Raises:
        InputError: Anything in the case that cannot be used, an unknown engine, or an arm that is to be checked in a
            case that does not say where its base is.
    """
    if isinstance(engine, str) and engine not in ENGINES:
        refuse(f"engine '{engine}' is not known", "--engine", ", ".join(ENGINES), "unknown_engine")
    watcher = watcher or Silent()
    stages = Stages(announce=partial(watcher.step, "stage"))
    with stages.time("case"):  # case.toml, validated, and T_base_ct from markers, a transform or a mount
        case = case if isinstance(case, Case) else load_case(case)
        placement = load_placement(case)
    if arm and placement is None:
        refuse(NO_BASE, case.path, f"{ALLOWED_BASE}; or a check without the arm", "no_base")
    with stages.time("anatomy"):  # surfaces of skin, organs and surroundings, and whether all fits together
        cache = replace(user_cache(), memory=memory)
        anatomy = load_anatomy(case, partial(watcher.step, "anatomy"), cache)
        anatomy = with_surroundings(anatomy, case, None if placement is None else placement.T_base_ct)
        watcher.step("anatomy", "consistency of the inputs")
        collected = (
            *(Finding("reading", Severity.WARNING, one) for one in (*case.warnings, *anatomy.warnings)),
            *anatomy.findings,
            *findings(case, anatomy, placement, cache),
            *(Finding("breathing", Severity.WARNING, one) for one in breath_warnings(case, anatomy)),
        )
        warnings = tuple(one.sentence for one in collected if one.severity is not Severity.NOTE)
        anatomy = replace(anatomy, warnings=warnings, findings=collected)
        for warning in anatomy.warnings:
            if warning not in known:
                LOG.warning(warning)
        check_tissues(case, anatomy)
        case.files.release()  # image and labels are read: their memory is given back
    return _build_context(case, anatomy, placement, engine, arm is not False, watcher, stages, cache)


def _build_context(
    case: Case,
    anatomy: Anatomy,
    placement: Placement | None,
    engine: EngineChoice,
    arm: bool,
    watcher: Watcher | None = None,
    stages: Stages | None = None,
    cache: Cache | None = None,
) -> CaseContext:
    watcher, cache = watcher or Silent(), cache or user_cache()
    stages = stages or Stages(announce=partial(watcher.step, "stage"))
    memory = Memory(TARGET_CACHE_BYTES) if cache.memory is NO_MEMORY else cache.memory
    with stages.time("trees"):
        meshes = [structure.mesh for structure in anatomy.checked]
        tick = partial(watcher.count, "directions" if engine == "fcl" else "structures")  # the unit of its progress
        exact: ClearanceEngine = FclEngine(meshes, tick) if engine == "fcl" else FastEngine(meshes, tick, cache.memory)
        if not isinstance(engine, str) and engine is not FastEngine:
            exact = VerifiedEngine(engine(meshes, tick), exact)
        reach = None
        if arm and placement is not None:
            T_base_ct = placement.T_base_ct
            reach = ArmReach(own_checker(case, anatomy, T_base_ct, memory), T_base_ct)
            _ = reach.checker  # what cannot be is refused now
        error = None if reach is None or placement is None else pose_error(case, placement.registration)
        chance = chance_model(case, anatomy, exact, error)
    return CaseContext(case, anatomy, placement, exact, reach, chance, watcher, stages, memory)


def alternatives(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, candidates: Candidates, memory: Memory
) -> Iterator[Finding]:
    """Findings on what else would be safe for the organs: were nothing assumed beyond the image, and by needle."""
    more = safe_without_beyond(case, anatomy, candidates, memory)
    if more:
        text = f"{plural(more, 'more direction')} would be safe for the organs with [ct] beyond_mm = 0"
        yield Finding("hangs_on_beyond_image", Severity.NOTE, text, {"directions": more})
    if not case.needle.lengths_mm:
        return
    directions = Directions(candidates.theta, candidates.beta, candidates.outward_ct, candidates.grid)
    safe = {
        length: organ_safe(replace(case, needle=case.needle.of_length(length)), anatomy, engine, directions)
        for length in sorted(case.needle.lengths_mm)
    }
    text = ", ".join(f"{int(rows.sum())} with {length:g} mm" for length, rows in safe.items())
    best = [window.best for window in candidates.windows]
    shortest = [next((length for length, rows in safe.items() if rows[row]), np.nan) for row in best]
    fits = ", ".join(f"{length:g} mm" for length in shortest)
    numbers = {"lengths_mm": list(safe), "safe": [float(rows.sum()) for rows in safe.values()], "shortest_mm": shortest}
    text += f"; shortest for the best path of each window: {fits or 'none'}"
    yield Finding("needle_catalogue", Severity.NOTE, f"organ-safe directions per needle: {text}", numbers)


def safe_without_beyond(case: Case, anatomy: Anatomy, candidates: Candidates, memory: Memory) -> int:
    """How many directions are unsafe only for the body that is assumed beyond the image: safe if it ends there."""
    clearance, named = candidates.clearance, candidates.verdict.structure == BEYOND_IMAGE
    others = ~np.isnan(clearance.margins) & (np.array(clearance.structures) != BEYOND_IMAGE)
    rows = np.flatnonzero(named & (clearance.by_structure[:, others] >= clearance.margins[others]).all(axis=1))
    if not len(rows) or case.ct.beyond_mm == 0.0:
        return 0
    narrow = replace(case, ct=replace(case.ct, beyond_mm=0.0))
    (solid,), path = beyond_images(narrow, anatomy.skin, anatomy.scan, memory).structures, candidates.path
    lengths = axis_lengths(case, [solid], path.length[rows], path.skin_angle[rows])
    axes = FastEngine([solid.mesh], memory=memory).measure(
        case.target_ct, candidates.outward_ct[rows], lengths, shown=False
    )
    return int((axes.distance >= case.needle.radius_mm + solid.margin_mm).sum())
