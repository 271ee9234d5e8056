"""The unknowns of A X P = Y B Q: their names, which are free, one value of each, and how a small step changes it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import exp_rotation, skew

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


class Estimate(NamedTuple):
    """One value of every unknown."""

    R_X: Floats
    """Shape (3, 3), rotation of T_end1_image."""
    t_X: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm."""
    R_Y: Floats
    """Shape (3, 3), rotation of T_base1_base2."""
    t_Y: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm."""
    t_Q: Floats  # noqa: N815 - the equation's letter
    """Shape (3,), mm: the tip in end2."""
    scale: Floats
    """Shape (2,): mm per unit of P."""
    V: Floats
    """Shape (3,), unit: the needle's direction in end2."""

    def moved(self, step: Floats) -> Estimate:
        """After a step (19,) in the order of ``PARAMETERS``: R Exp(w), sums of the rest, V on the sphere."""
        V = self.V + tangent_basis(self.V) @ step[DIRECTION]
        return Estimate(
            self.R_X @ exp_rotation(step[W_X]),
            self.t_X + step[T_X],
            self.R_Y @ exp_rotation(step[W_Y]),
            self.t_Y + step[T_Y],
            self.t_Q + step[T_Q],
            self.scale + step[SCALE],
            V / np.linalg.norm(V),
        )

    def moved_by(self, active: NDArray[np.int_], step: Floats) -> Estimate:
        """After a step (p,) of the free parameters, in `parameter_units`."""
        full = np.zeros(N_PARAMETERS)
        full[active] = parameter_units(active, self.scale) * step
        return self.moved(full)


def tangent_basis(direction: Floats) -> Floats:
    """Two unit vectors across a direction (3,) and each other, as columns, shape (3, 2)."""
    helper = np.eye(3)[int(np.argmin(np.abs(direction)))]
    first = skew(direction) @ helper
    first /= np.linalg.norm(first)
    return np.column_stack([first, skew(direction) @ first])
