"""The batch search: a case in, one checked row per direction out.

`search` is the list of its stages. `organ_candidates`, the first, needs no arm: path, clearance and verdict of every
direction for skin and organs. `first_blocking` and `organ_safe` give verdicts alone, without distances.
"""

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints32
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine, measure_clearances
from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.verdict_map import VerdictMap
from puncture_twin.planning.geometry.containment import contains, crossings
from puncture_twin.planning.reach.standoff import axis_lengths, case_axis_lengths, case_paths
from puncture_twin.planning.search.bending import with_bending
from puncture_twin.planning.search.candidates import ArmColumns, Candidates, ClearanceColumns, Path, Ranking
from puncture_twin.planning.search.chances import ChanceModel, with_best_chances, with_chances
from puncture_twin.planning.search.constraints import ArmReach, first_broken, skin_allows, with_grid_cone, with_reach
from puncture_twin.planning.search.phases import with_breathing, with_breathing_reach
from puncture_twin.planning.search.ranking import ranked


def search(
    case: Case,
    anatomy: Anatomy,
    engine: ClearanceEngine,
    directions: Directions,
    *,
    reach: ArmReach | None = None,
    chance: ChanceModel | None = None,
    progress: Count | None = None,
) -> Candidates:
    """Check every direction against the organs, those that pass against the arm, and rank what is left.

    One table grows, a row per direction: each stage fills its own columns, and rejects, with a reason, rows that every
    stage before it accepted.

    Args:
        engine: Prepared for the meshes of ``anatomy.checked``, in that order.
        reach: Checks the arm; None leaves ``reachable`` unknown.
        chance: Model of the case's declared errors; None leaves the chances to hit and to touch blank.
        progress: Called with (candidates checked, candidates to check) while the arm is checked.
    """
    axes = None if chance is None else organ_distances(case, anatomy, engine, directions)  # two stages read them
    candidates = organ_candidates(case, anatomy, engine, directions, axes)  # skin entry, clearance, bending, breathing
    if directions.grid is not None:  # by how much a direction may be off and still be safe for the organs
        candidates = with_grid_cone(candidates, directions.grid)
    if reach is not None:  # inverse kinematics and collisions, to the target
        candidates = with_reach(case, candidates, reach, progress)
    if reach is not None and case.breathing is not None:  # the same, the patient breathing
        candidates = with_breathing_reach(case, case.breathing, anatomy, candidates, reach)
    if case.errors is not None:  # chances of hitting the target, of touching structures
        candidates = with_chances(case, anatomy, candidates, chance, axes)
    candidates = ranked(case, candidates)  # cost, rank, Pareto front
    if chance is not None:  # chances of the best by sampling; ranks again if it rejects; of touching any structure
        candidates = with_best_chances(candidates, chance)
    return candidates


def organ_distances(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> AxisDistances:
    """Distances of the needle's axis from every structure, in every direction."""
    outward = directions.outward_ct
    return engine.measure(case.target_ct, outward, case_axis_lengths(case, anatomy, outward))


def organ_candidates(
    case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions, axes: AxisDistances | None = None
) -> Candidates:
    """Check every direction against skin and organs, needle bending and breathing included; without arm and ranks.

    Args:
        axes: `organ_distances` of the directions; None measures them here.
    """
    needle, outward, checked = case.needle, directions.outward_ct, anatomy.checked
    paths = case_paths(case, anatomy.skin, outward)  # where each path crosses the skin, and at which angle
    tissue = tissue_crossed(checked, case.target_structure, case.target_ct, outward, paths.path_length)
    lengths = axis_lengths(case, checked, paths.path_length, paths.skin_angle)  # how far out each axis is checked
    clearances = measure_clearances(
        engine, checked, case.target_ct, outward, length=lengths, radius=needle.radius_mm, axes=axes
    )
    demanding, count = np.array([s.demands_margin for s in checked], bool), len(directions)
    candidates = Candidates(  # a straight needle, the patient as the CT shows them
        theta=directions.theta,
        beta=directions.beta,
        outward_ct=outward,
        path=Path(entry_ct=paths.entry_ct, length=paths.path_length, skin_angle=paths.skin_angle, tissue=tissue),
        clearance=ClearanceColumns(
            structures=tuple(s.name for s in checked),
            margins=np.array([s.margin_mm if s.demands_margin else np.nan for s in checked]),
            by_structure=clearances.clearance,
            least=clearances.clearance[:, demanding].min(axis=1, initial=np.inf),
        ),
        arm=ArmColumns.unknown(count),
        ranking=Ranking.none(count),
        safe_cone=np.full(count, np.nan),
        verdict=first_broken(paths, clearances, checked, needle=needle, max_skin_angle=case.search.max_skin_angle),
        grid=directions.grid,
    )
    bound = None if case.bending is None else case.bending.bound(needle.longest_path_mm)
    if bound is not None:
        candidates = with_bending(anatomy, candidates, bound)
    if case.breathing is not None:
        candidates = with_breathing(case, case.breathing, anatomy, engine, candidates, bound)
    return candidates


class Blocking(NamedTuple):
    """The structures and the skin that block n directions of a grid."""

    structure: Ints32  # the first of ``anatomy.checked`` whose margin a direction breaks; -1 where none
    enters: Bools
    """Whether the constraints of the skin are satisfied; False where a structure of the body blocks already."""

    @property
    def open(self) -> Bools:
        """Which directions enter and are not blocked, shape (n,)."""
        return np.asarray(self.enters & (self.structure < 0))


def first_blocking(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> Blocking:
    """First structure that blocks each direction of a grid at a case's target, in the order of ``anatomy.checked``.

    It accepts what `organ_candidates` accepts of a straight needle in a patient at rest, by maps of verdicts where the
    engine has them and by distances elsewhere (`tests/search/test_safe_map.py` compares both).
    """
    needle, checked, body = case.needle, anatomy.checked, anatomy.structures
    outward, max_skin_angle = directions.outward_ct, case.search.max_skin_angle
    if directions.grid is None or not isinstance(engine, FastEngine):
        paths = case_paths(case, anatomy.skin, outward)
        lengths = axis_lengths(case, checked, paths.path_length, paths.skin_angle)
        clearances = measure_clearances(
            engine, checked, case.target_ct, outward, length=lengths, radius=needle.radius_mm
        )
        broken = clearances.violated
        first = np.where(broken.any(axis=1), broken.argmax(axis=1), -1).astype(np.int32)
        return Blocking(first, skin_allows(paths, needle, max_skin_angle))
    verdict_map = VerdictMap(case.target_ct, directions.grid, outward, case.T_ct_entry[:3, :3])
    lengths = np.full((len(outward), len(checked)), needle.length_mm)
    for number, structure in enumerate(body):
        verdict_map.add(engine, number, structure, lengths[:, number], needle.radius_mm)
    free = np.flatnonzero(verdict_map.free)  # of the body; the others need no path
    paths = case_paths(case, anatomy.skin, outward[free])
    enters = np.zeros(len(outward), bool)
    enters[free] = skin_allows(paths, needle, max_skin_angle)
    lengths[free] = axis_lengths(case, checked, paths.path_length, paths.skin_angle)
    for number, structure in enumerate(anatomy.surroundings, start=len(body)):
        verdict_map.add(engine, number, structure, lengths[:, number], needle.radius_mm)
    return Blocking(verdict_map.structure, enters)


def organ_safe(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> Bools:
    """Which directions of a grid `organ_candidates` finds safe, shape (n,); what is blocked is not measured."""
    safe = first_blocking(case, anatomy, engine, directions).open
    if case.bending is not None or case.breathing is not None:
        rows = np.flatnonzero(safe)
        left = Directions(directions.theta[rows], directions.beta[rows], directions.outward_ct[rows])
        safe[rows] = organ_candidates(case, anatomy, engine, left).safe
    return safe


def tissue_crossed(
    structures: tuple[Structure, ...], target_structure: str, target_ct: Floats, outward_ct: Floats, path_length: Floats
) -> Floats:
    """Length of each path, target to skin, inside structures that may be crossed; shape (n,), mm.

    These are closed ones of role ``traverse`` or ``target`` other than the target's own; nested, each one counts.
    """
    total = np.zeros(len(outward_ct))
    for structure in structures:
        crossable = structure.role in {Role.TRAVERSE, Role.TARGET} and structure.name != target_structure
        if crossable and structure.mesh.closed:
            total += inside_length(structure, target_ct, outward_ct, path_length)
    return np.where(np.isnan(path_length), np.nan, total)


def inside_length(structure: Structure, target_ct: Floats, outward_ct: Floats, path_length: Floats) -> Floats:
    """Length of each path inside one closed structure, shape (n,), mm.

        length = d_1 - d_2 + d_3 - ... (+ path length, where the path ends inside)        for a target inside

    d_i: depths of the ray's crossings, which leave and enter by turns; all signs are reversed for a target outside.
    """
    crossing = crossings(structure.mesh, target_ct, outward_ct)
    starts_inside = contains(structure.mesh, target_ct)
    limit = np.nan_to_num(path_length, nan=0.0)
    number = np.arange(len(crossing.ray)) - crossing.first[crossing.ray]  # 0 for a ray's first crossing
    sign = np.where((number % 2 == 0) == starts_inside, 1.0, -1.0)
    signed = sign * np.minimum(crossing.depth, limit[crossing.ray])  # crossings beyond the skin cancel in pairs
    inside = np.bincount(crossing.ray, weights=signed, minlength=len(outward_ct))
    ends_inside = (crossing.count % 2 == 0) == starts_inside
    return np.asarray(np.maximum(inside + np.where(ends_inside, limit, 0.0), 0.0))
