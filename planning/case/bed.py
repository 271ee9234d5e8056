"""The bed frame: which way is up and which way lies the bed, as a case states it or as a patient usually lies."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.case.case import Case, view_frame
from puncture_twin.planning.case.entry import ANATOMICAL_LPS
from puncture_twin.planning.case.mount import Axis, axes_frame
from puncture_twin.planning.geometry.spaces import Space, to_lps

Vector = tuple[float, float, float]

UPRIGHT = 0.5
"""An entry frame whose z lies within 60 degrees of the body's long axis is not the direction up."""


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


def up_axis(case: Case) -> Vector:
    """Up in LPS (or the local frame), of any length: ``place.up``.

    Left out, it is the entry frame's z, or the front where that z runs along the body.
    """
    up, head = case.T_ct_entry[:3, 2], np.array(ANATOMICAL_LPS["head"])
    if case.space is not Space.LOCAL and abs(up @ head) > UPRIGHT:
        up = np.array(ANATOMICAL_LPS["anterior"])
    return _stated(case.place.up, case.space, up)


def along_axis(case: Case) -> Vector:
    """Along the bed, likewise: ``place.along``, else the head, or the entry frame's x where there is no head."""
    along = case.T_ct_entry[:3, 0] if case.space is Space.LOCAL else np.array(ANATOMICAL_LPS["head"])
    return _stated(case.place.along, case.space, along)


def _stated(axis: Axis | None, space: Space, otherwise: Floats) -> Vector:
    """An axis that the case states, or another, in LPS (or the local frame)."""
    if isinstance(axis, str):
        return ANATOMICAL_LPS[axis]
    vector = otherwise if axis is None else to_lps(np.array([axis]), space)[0]
    return float(vector[0]), float(vector[1]), float(vector[2])
