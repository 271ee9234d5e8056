"""How fast along a path: from one speed to another within speed, acceleration and jerk, by ruckig.

Source: Berscheid and Kroeger 2021, "Jerk-limited real-time trajectory generation with arbitrary target states".
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from ruckig import InputParameter, Result, Ruckig, Trajectory as Profile

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError

LENGTH_SLACK = 1e-6
"""Share of a length to spare for a change of speed: without, ruckig's rounding may miss the fit and take a detour."""

BISECTIONS = 60
"""Of an interval of speeds: to rounding."""


class Rates(NamedTuple):
    """The highest speed, acceleration and jerk along a path, per s, s^2 and s^3 of whatever measures its length."""

    speed: float
    acceleration: float
    jerk: float


class TimeLaw(NamedTuple):
    """A path run in time."""

    length: float
    duration_s: float
    profile: Profile | None
    """Ruckig's; None where the speed is constant."""

    def travelled(self, times_s: Floats) -> Floats:
        """The length run at some times (m,) from 0 to ``duration_s``."""
        if self.profile is None:
            return np.asarray(self.length * times_s / self.duration_s)
        return np.asarray(_positions(self.profile, np.asarray(times_s)).clip(0.0, self.length))


def _positions(profile: Profile, times_s: Floats) -> Floats:
    """Where a profile of one degree of freedom is at some times (m,); as ``at_time`` says, in one go.

    Within each of its pieces the jerk is constant. An arm that starts above its limits brakes before them; none here
    does, and ``at_time`` knows how.
    """
    steps = profile.profiles[0][0]
    if steps.brake.duration > 0.0:
        return np.array([profile.at_time(float(time))[0][0] for time in times_s])
    ends = np.cumsum(steps.t)
    piece = np.searchsorted(ends[:-1], times_s, side="right")
    since = times_s - np.append(0.0, ends)[piece]
    jerk, acceleration, speed, position = (np.array(rows)[piece] for rows in (steps.j, steps.a, steps.v, steps.p))
    return np.asarray(position + since * (speed + since * (acceleration / 2.0 + since * jerk / 6.0)))


def time_law(length: float, rates: Rates, start_speed: float = 0.0, end_speed: float = 0.0) -> TimeLaw:
    """The fastest motion over a length, without acceleration at either end.

    Args:
        length: Above 0.
        rates: The limits.
        start_speed: At most the speed limit.
        end_speed: The same, and reachable (:func:`reachable_speed`).

    Raises:
        InputError: If ruckig finds no such motion.
    """
    task = InputParameter(1)
    task.current_position, task.current_velocity, task.current_acceleration = [0.0], [start_speed], [0.0]
    task.target_position, task.target_velocity, task.target_acceleration = [length], [end_speed], [0.0]
    task.max_velocity, task.max_acceleration, task.max_jerk = [rates.speed], [rates.acceleration], [rates.jerk]
    profile = Profile(1)
    if Ruckig(1).calculate(task, profile) not in (Result.Working, Result.Finished):
        what = f"no motion over {length:.6g} from speed {start_speed:.6g} to {end_speed:.6g}"
        raise InputError(what, where="trajectory", allowed=f"within {rates}")
    return TimeLaw(length, profile.duration, profile)


def speed_change_length(start_speed: float, end_speed: float, rates: Rates) -> float:
    """The shortest path from one speed to another, both without acceleration: the mean speed times the time it takes.

    The speed changes by jerk, steady acceleration and jerk again, in |dv| / a + a / j, or 2 sqrt(|dv| / j) where the
    acceleration limit is not reached.
    """
    change = abs(end_speed - start_speed)
    a, j = rates.acceleration, rates.jerk
    time = change / a + a / j if change * j >= a * a else 2.0 * math.sqrt(change / j)
    return (start_speed + end_speed) / 2.0 * time


def reachable_speed(start_speed: float, wanted_speed: float, length: float, rates: Rates) -> float:
    """The highest speed up to a wanted one that can be reached over a length (or, seen backwards, braked from)."""

    def fits(speed: float) -> bool:
        return speed_change_length(start_speed, speed, rates) * (1.0 + LENGTH_SLACK) <= length

    if wanted_speed <= start_speed or fits(wanted_speed):
        return wanted_speed
    low, high = start_speed, wanted_speed
    for _ in range(BISECTIONS):
        middle = (low + high) / 2.0
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low
