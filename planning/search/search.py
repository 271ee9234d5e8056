"""The batch search: a case in, one checked row per direction out."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.reach.standoff import own_lengths
from puncture_twin.planning.search.arm_reach import ArmReach, with_reach
from puncture_twin.planning.search.candidate_chances import with_best_refined, with_chances, with_joint_chances
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.organs import organ_candidates
from puncture_twin.planning.search.phases.arm_phases import with_breathing_reach
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.search.selection.safe_cone import with_grid_cone
from puncture_twin.planning.uncertainty.chance_model import ChanceModel


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

    Args:
        case: The validated case.
        anatomy: Its structures.
        engine: Prepared for the meshes of ``anatomy.checked``, in that order.
        directions: What to check.
        reach: Checks the arm; None leaves ``reachable`` unknown.
        chance: Of the case's declared errors; None leaves the chances blank.
        progress: Called with (candidates checked, candidates to check) while the arm is checked.
    """
    axes = None if chance is None else organ_distances(case, anatomy, engine, directions)
    found = with_grid_cone(organ_candidates(case, anatomy, engine, directions, axes))
    if reach is not None:
        found = with_breathing_reach(case, anatomy, with_reach(case, found, reach, progress), reach)
    found = ranked(case, with_chances(case, anatomy, found, chance, axes))
    return with_joint_chances(with_best_refined(found, chance), chance)


def organ_distances(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> AxisDistances:
    """How far the needle's axis is from every structure in every direction."""
    outward = directions.outward_ct
    return engine.measure(case.target_ct, outward, own_lengths(case, anatomy, outward))
