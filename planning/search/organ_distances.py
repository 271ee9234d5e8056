"""How far the needle is from every structure, in every direction."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.reach.standoff import axis_lengths


def organ_distances(case: Case, anatomy: Anatomy, engine: ClearanceEngine, directions: Directions) -> AxisDistances:
    """How far the needle's axis is from every structure in every direction."""
    return engine.measure(case.target_ct, directions.outward_ct, axis_lengths(case, anatomy.checked))
