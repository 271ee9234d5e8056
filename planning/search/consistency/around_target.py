"""An open mesh about the target: whether the target lies inside is not known."""

from __future__ import annotations

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.geometry.winding import odd_fraction, winding_number

MOST_AROUND = 0.5
"""An open mesh may go so far around the target: of the rays that cross it oddly, and of its winding number."""


def refuse_open_around_target(case: Case, anatomy: Anatomy) -> None:
    """Of an open surface the inside is not known; but one that goes more than half around the target is refused.

    Two numbers tell: rays from the target say it however the triangles are wound, and the winding number says it of
    shells in shells, which a ray leaves an even number of times. Neither is the inside, so none is claimed.
    """
    for structure in anatomy.structures:
        if not structure.demands_margin or structure.mesh.closed:
            continue
        odd, turns = odd_fraction(structure.mesh, case.target_ct), winding_number(structure.mesh, case.target_ct)
        if max(odd, abs(turns)) > MOST_AROUND:
            raise InputError(
                f"'{structure.name}' is an open mesh about the target: whether the target lies inside is not known "
                f"({100 * odd:.0f} % of all rays from it cross the mesh an odd number of times; winding number "
                f"{turns:.2f})",
                where=case.path,
                allowed="a closed mesh, or one that goes less than half around the target",
            )
