"""The parameters of A X P = Y B Q: their names, which are free, and how large a step of each counts as one."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats

PARAMETERS = (
    *(f"w_X_{axis}_rad" for axis in "xyz"),
    *(f"t_X_{axis}_mm" for axis in "xyz"),
    *(f"w_Y_{axis}_rad" for axis in "xyz"),
    *(f"t_Y_{axis}_mm" for axis in "xyz"),
    *(f"t_Q_{axis}_mm" for axis in "xyz"),
    "scale_u",
    "scale_v",
    "V_1_rad",
    "V_2_rad",
)
"""Every parameter that may be estimated, in the order of the Jacobians' columns."""

N_PARAMETERS = len(PARAMETERS)
W_X, T_X, W_Y, T_Y, T_Q, SCALE, DIRECTION = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15), slice(15, 17), slice(17, 19),
)  # fmt: skip


LENGTH_MM = 100.0
"""Lengths are counted in this unit, so that the columns of a system are of one size."""


def active_columns(*, tip: bool, scale: bool, direction: bool) -> NDArray[np.int_]:
    """Which of the 19 parameters are estimated."""
    wanted = np.ones(N_PARAMETERS, dtype=bool)
    wanted[T_Q], wanted[SCALE], wanted[DIRECTION] = tip, scale, direction
    return np.flatnonzero(wanted)


def parameter_units(active: NDArray[np.int_], scale: Floats) -> Floats:
    """How large a step of each free parameter is "one": 1 rad, 100 mm, the scale itself."""
    units = np.ones(N_PARAMETERS)
    for part in (T_X, T_Y, T_Q):
        units[part] = LENGTH_MM
    units[SCALE] = scale
    return units[active]
