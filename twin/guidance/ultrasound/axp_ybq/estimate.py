"""One value of every unknown of A X P = Y B Q, and how a small step changes it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rotations import exp_rotation, skew
from puncture_twin.twin.guidance.ultrasound.axp_ybq.parameters import (
    DIRECTION,
    N_PARAMETERS,
    SCALE,
    T_Q,
    T_X,
    T_Y,
    W_X,
    W_Y,
    parameter_units,
)


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
