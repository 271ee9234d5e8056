"""Stiffness and damping at the tip, and the rule by which a stiffness is refused before it diverges.

Along one mode of effective mass m the loop of stiffness K = m w^2 and damping 2 zeta w m, integrated with the step dt,
is stable while (w dt)^2 + 4 zeta w dt < 4; for zeta = .8 that is w dt < .96. What is allowed is `MOST_RATIO`.

Source: Hogan 1985, "Impedance control"; Albu-Schaeffer, Ott, Frese, Hirzinger 2003, "Cartesian impedance control of
redundant robots": damping by factors of mass and stiffness at once ("double diagonalisation"). Their other design, from
the roots of both, is not positive where position and rotation are coupled, and an arm with a long needle oscillates.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.world.execution import RECORD_S

MOST_RATIO = 0.8
"""Of sqrt(K / m) dt over every mode of the tip: five sixths of where the loop diverges."""

STEPS_S = (RECORD_S / 17, RECORD_S / 34, RECORD_S / 68)
"""Of a controller, the longest first: about 1, .5 and .25 ms, and records fall on steps."""


@dataclass(frozen=True)
class Stiffness:
    """A spring at the tip.

    Attributes:
        translation_n_m: K across and along the needle, N/m.
        rotation_nm_rad: Of the needle's direction and roll, N m/rad.
        damping_ratio: zeta of every mode.
        integral_per_s: K_i: what is left of an error is gone after so many times 1/K_i; 0 keeps the compliance.
    """

    translation_n_m: float = 2e4
    rotation_nm_rad: float = 300.0
    damping_ratio: float = 0.8
    integral_per_s: float = 5.0

    @property
    def diagonal(self) -> Floats:
        """Shape (6,): of tip position, then of rotation."""
        return np.repeat([self.translation_n_m, self.rotation_nm_rad], 3)


SLOWEST = 1e-6
"""Of the fastest mode: a slower one is damped as if it were so fast. At a singular pose the tip cannot move along it,
its mass is infinite, and J' takes whatever its damping is to nothing."""


def damping(stiffness: Stiffness, J: Floats, M: Floats) -> Floats:
    """D that gives every mode of the tip the same damping ratio, shape (6, 6).

    With Lambda the tip's mass and B its factor such that Lambda = B B', K = B diag(w^2) B': D = 2 zeta B diag(w) B'.
    From Lambda^-1 = J M^-1 J' alone: with U diag(w^2) U' = K^1/2 Lambda^-1 K^1/2, B = K^1/2 U diag(1/w).
    """
    root = np.sqrt(stiffness.diagonal)
    squares, U = np.linalg.eigh(root[:, None] * (J @ np.linalg.solve(M, J.T)) * root)
    modes = root[:, None] * U
    w = np.sqrt(np.maximum(squares, SLOWEST**2 * squares[-1]))
    return np.asarray(2.0 * stiffness.damping_ratio * (modes / w) @ modes.T)


def stability_ratio(stiffness: Stiffness, J: Floats, M: Floats, dt: float) -> float:
    """sqrt(K / m) dt of the fastest mode: the largest eigenvalue of Lambda^-1 K = J M^-1 J' K."""
    root = np.sqrt(stiffness.diagonal)[:, None] * J
    fastest = np.linalg.eigvalsh(root @ np.linalg.solve(M, root.T))[-1]
    return float(np.sqrt(fastest) * dt)


def allowed_step(stiffness: Stiffness, J: Floats, M: Floats) -> float:
    """The longest of `STEPS_S` that the stiffness is stable with at a pose; arguments as of `refuse_unstable`.

    Raises:
        InputError: None is.
    """
    stable = [dt for dt in STEPS_S if stability_ratio(stiffness, J, M, dt) < MOST_RATIO]
    if not stable:
        refuse_unstable(stiffness, J, M, STEPS_S[-1])
    return stable[0]


def refuse_unstable(stiffness: Stiffness, J: Floats, M: Floats, dt: float) -> None:
    """Refuse a stiffness that this time step cannot carry at this pose.

    Args:
        stiffness: At the tip.
        J: Jacobian of the tip, shape (6, 6).
        M: Mass matrix of the joints, shape (6, 6).
        dt: Time step, s.

    Raises:
        InputError: sqrt(K / m) dt is `MOST_RATIO` or more.
    """
    ratio = stability_ratio(stiffness, J, M, dt)
    if not ratio < MOST_RATIO:
        raise InputError(
            f"a stiffness of {stiffness.translation_n_m:g} N/m at steps of {1e3 * dt:g} ms would diverge: "
            f"sqrt(K/m) dt = {ratio:.2f}",
            where="impedance",
            allowed=f"below {MOST_RATIO}: less stiffness or a shorter step",
        )
