"""The bed frame: the workcell as a person at the table sees it, with its origin at the target."""

from __future__ import annotations

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import view_frame
from puncture_twin.planning.case.mount import axes_frame
from puncture_twin.planning.case.sections.bed_axes import along_axis, up_axis
from puncture_twin.planning.geometry.spaces import Space


def bed_frame(case: Case) -> Floats:
    """T_ct_bed: x along the bed (to the head), y across it (to the right of a patient on the back), z up; mm.

    ``place.up`` and ``place.along`` say both, see `up_axis` and `along_axis`.

    Returns:
        Shape (4, 4), read-only.

    Raises:
        InputError: The two are parallel.
    """
    R_ct_bed = axes_frame(up_axis(case), along_axis(case), Space.LPS, case.path, "place: up and along")
    return view_frame(R_ct_bed, case.target_ct)
