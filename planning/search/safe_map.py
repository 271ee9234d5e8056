"""The safe map of a target: a verdict a direction, and which structure blocks it; no distances.

It says what the margins of the structures allow. Where the needle enters the skin, at which angle, how it bends and
moves with the breath, what the arm reaches and what errors do is not tested here: `CaseContext.check` does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.text import Facts, Shown, brief, plural
from puncture_twin.planning.case.entry import Directions
from puncture_twin.planning.clearance.engine import measure
from puncture_twin.planning.reach.standoff import case_axis_lengths
from puncture_twin.planning.search.context import CaseContext

NOT_TESTED = "skin entry and angle, bending, breathing, arm, chances"


@dataclass(frozen=True, eq=False)
class SafeMap(Shown):
    """Which directions the margins of the structures block.

    Attributes:
        target_ct: Shape (3,), mm, LPS.
        directions: The n directions of the case's grid.
        structures: Names of all that is checked; ``structure`` are places in it.
        blocked: Shape (n,), whether the needle comes nearer to some structure than its margin.
        structure: Shape (n,), the first in the case's order that blocks the direction; -1 where none does.
    """

    target_ct: Floats
    directions: Directions
    structures: tuple[str, ...]
    blocked: Bools
    structure: Ints

    @property
    def theta_deg(self) -> Floats:
        """Puncture angle of each direction, shape (n,)."""
        return np.degrees(self.directions.theta)

    @property
    def beta_deg(self) -> Floats:
        """Azimuth of each direction, shape (n,)."""
        return np.degrees(self.directions.beta)

    def _title(self) -> str:
        return "Safe map"

    def _facts(self) -> Facts:
        x, y, z = self.target_ct
        yield "target", f"({x:.1f}, {y:.1f}, {z:.1f}) mm"
        yield "directions", f"{len(self.blocked):,}, of which {int((~self.blocked).sum()):,} are not blocked"
        for row in np.unique(self.structure[self.blocked]):
            yield f"first blocked by {self.structures[row]}", f"{int((self.structure == row).sum()):,}"
        yield "not tested", NOT_TESTED

    @brief
    def __repr__(self) -> str:
        return f"{int((~self.blocked).sum()):,} of {plural(len(self.blocked), 'direction')} not blocked"


def safe_map(context: CaseContext) -> SafeMap:
    """The safe map of a context's target, over the case's grid."""
    case, anatomy, directions = context.case, context.anatomy, context.case.directions()
    lengths = case_axis_lengths(case, anatomy, directions.outward_ct)
    violated = measure(
        context.engine,
        anatomy.checked,
        case.target_ct,
        directions.outward_ct,
        length=lengths,
        radius=case.needle.radius_mm,
    ).violated
    blocked = np.asarray(violated.any(axis=1))
    structure = np.where(blocked, violated.argmax(axis=1), -1)
    return SafeMap(case.target_ct, directions, tuple(one.name for one in anatomy.checked), blocked, structure)
