"""The bed frame: the workcell as a person at the table sees it, with its origin at the target."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.case.entry import ANATOMICAL_LPS, view_frame
from puncture_twin.planning.case.mount import Axis, axes_frame
from puncture_twin.planning.geometry.spaces import Space, to_lps

UPRIGHT = 0.5
"""An entry frame whose z lies within 60 degrees of the body's long axis is not the direction up."""


def bed_frame(case: Case) -> Floats:
    """T_ct_bed: x along the bed (to the head), y across it (to the right of a patient on the back), z up; mm.

    ``place.up`` and ``place.along`` say both. Left out, up is the entry frame's z, or the front where that z runs along
    the body; along is the head, or the entry frame's x where there is no head.

    Returns:
        Shape (4, 4), read-only.

    Raises:
        InputError: The two are parallel.
    """
    local, head = case.space is Space.LOCAL, np.array(ANATOMICAL_LPS["head"])
    up, along = case.T_ct_entry[:3, 2], case.T_ct_entry[:3, 0] if local else head
    if not local and abs(up @ head) > UPRIGHT:
        up = np.array(ANATOMICAL_LPS["anterior"])
    z, x = _stated(case.place.up, case.space, up), _stated(case.place.along, case.space, along)
    R_ct_bed = axes_frame(z, x, Space.LPS, case.path, "place: up and along")
    return view_frame(R_ct_bed, case.target_ct)


def _stated(axis: Axis | None, space: Space, otherwise: Floats) -> tuple[float, float, float]:
    """An axis that the case states, or another, in LPS (or the local frame)."""
    if isinstance(axis, str):
        return ANATOMICAL_LPS[axis]
    vector = otherwise if axis is None else to_lps(np.array([axis]), space)[0]
    return float(vector[0]), float(vector[1]), float(vector[2])
