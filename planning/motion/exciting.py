"""A motion that shows an arm's dynamics: a finite Fourier series, from rest to rest at home.

    q_i(t) = home_i + sum_l a_il sin(l w t) / (l w) + b_il (1 - cos(l w t)) / (l w),    sum_l a_il = sum_l l b_il = 0

Source: Swevers, Ganseman, Tuekel, de Schutter, van Brussel, "Optimal robot excitation and identification", IEEE Trans.
Robot. Autom. 13, 1997. Of many that are drawn, each scaled to the limits, the best conditioned one is taken.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from puncture_twin.planning.arm.dynamics import MOST_CONDITION, JointMotion, base_parameters, condition_of, regressor
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import NoAnswerError

PERIOD_S = 20.0
RATES = 2.0 * np.pi / PERIOD_S * np.arange(1, 6)
"""l w, rad/s: five terms, the fastest of 4 s."""
DRAWS = 20
TRIED = 5
"""Of the best conditioned, whether they are free of contact."""
TINY = 1e-9

SIZES = (0.95, 0.6, 0.35)
"""Of the limits, where none of the larger motions is free."""


@dataclass(frozen=True, eq=False)
class Series:
    """The coefficients a, b, shape (6, 5) each, rad/s, of a motion about home (6,), rad."""

    home: Floats
    a: Floats
    b: Floats

    def at(self, times_s: Floats) -> JointMotion:
        """The joints at times (n,)."""
        s, c = np.sin(np.outer(times_s, RATES)), np.cos(np.outer(times_s, RATES))
        q = self.home + s / RATES @ self.a.T + (1.0 - c) / RATES @ self.b.T
        return JointMotion(q, c @ self.a.T + s @ self.b.T, c @ (self.b * RATES).T - s @ (self.a * RATES).T)


def exciting_motion(
    model: UrModel, down_base: Floats, home: Floats, free: Callable[[Floats], bool], seed: int
) -> Series:
    """The motion of one arm at one mount.

    Args:
        model: Its limits of angle, speed and acceleration are kept.
        down_base: Shape (3,), unit vector of gravity, base frame.
        home: Shape (6,), rad.
        free: Whether the arm is free of contact along a path (m, 6).

    Raises:
        NoAnswerError: None of the best is free, however small.
    """
    rng, times = np.random.default_rng(seed), np.linspace(0.0, PERIOD_S, 60, endpoint=False)
    columns = base_parameters(model, down_base).columns
    for size in SIZES:
        drawn = [_drawn(model, home, size, rng) for _ in range(DRAWS)]
        scores = [condition_of(regressor(model, one.at(times), down_base)[:, :, columns]) for one in drawn]
        for at in np.argsort(scores)[:TRIED]:
            if scores[at] < MOST_CONDITION and free(drawn[at].at(np.linspace(0.0, PERIOD_S, 2000)).q):
                return drawn[at]
    what = "the arm touches something in every exciting motion about its home"
    raise NoAnswerError(f"{what}: another robot.home_deg may have more space", code="no_exciting_motion")


def _drawn(model: UrModel, home: Floats, size: float, rng: np.random.Generator) -> Series:
    a, b = rng.normal(size=(2, 6, len(RATES)))
    a -= a.mean(axis=1, keepdims=True)
    b -= (b @ RATES / (RATES @ RATES))[:, None] * RATES
    plain = Series(home, a, b)
    motion = plain.at(np.linspace(0.0, PERIOD_S, 500))
    away = motion.q - home
    ahead = np.where(away > 0.0, model.joint_limits[:, 1] - home, home - model.joint_limits[:, 0])
    limits = (
        (ahead / np.abs(away).clip(TINY)).min(axis=0),
        model.max_speeds / np.abs(motion.speed).max(axis=0),
        model.max_acceleration / np.abs(motion.acceleration).max(axis=0),
    )
    scale = size * np.min(limits, axis=0)[:, None]
    return replace(plain, a=scale * a, b=scale * b)
