"""Joint trajectories: angles over time, and the highest rates that they need."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse

SAMPLE_S = 0.008
"""Spacing of the samples: the 125 Hz at which a UR3 takes joint targets."""


class Peaks(NamedTuple):
    """The highest rates of each joint, by differences of the samples, from rest to rest; each of shape (6,)."""

    speed: Floats  # rad/s
    acceleration: Floats  # rad/s^2
    jerk: Floats  # rad/s^3


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint angles over time, straight between the samples.

    Raises:
        InputError: If shapes, times or numbers make no sense.
    """

    times_s: Floats  # shape (m,), from 0, strictly rising
    q: Floats  # shape (m, 6), rad

    def __post_init__(self) -> None:
        times, q = np.array(self.times_s, dtype=np.float64), np.array(self.q, dtype=np.float64)
        if times.ndim != 1 or q.shape != (len(times), 6) or len(times) == 0:
            refuse(f"shapes {times.shape} and {q.shape}", "trajectory", "(m,) and (m, 6)", "wrong_shape")
        if not (np.isfinite(times).all() and np.isfinite(q).all()):
            refuse("a time or an angle is not finite", "trajectory", "finite numbers", "not_finite")
        if times[0] != 0.0 or (np.diff(times) <= 0.0).any():
            refuse("times do not increase from 0", "trajectory", "0, then strictly rising", "times_not_rising")
        for name, array in (("times_s", times), ("q", q)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def duration_s(self) -> float:
        """The time of the last sample, s."""
        return float(self.times_s[-1])

    def at(self, time_s: Floats | float) -> Floats:
        """Joint angles (..., 6) at a time, or at many (...), clamped to the ends."""
        return np.stack([np.interp(time_s, self.times_s, self.q[:, joint]) for joint in range(6)], axis=-1)

    def peaks(self) -> Peaks:
        """The highest speed, acceleration and jerk of each joint.

        Differences over the samples are means of the rates between them, so a motion within some limits never shows
        more (with even spacing; the jerk of uneven samples is an estimate). The arm rests before and after.
        """
        if len(self.q) == 1:
            return Peaks(np.zeros(6), np.zeros(6), np.zeros(6))
        steps = np.diff(self.times_s)
        before, after = steps[0] * np.arange(-3, 0), self.times_s[-1] + steps[-1] * np.arange(1, 4)
        times = np.concatenate([before, self.times_s, after])
        rates, peaks = np.concatenate([self.q[:1]] * 3 + [self.q] + [self.q[-1:]] * 3), []
        for _ in Peaks._fields:
            rates = np.diff(rates, axis=0) / np.diff(times)[:, None]
            times = (times[:-1] + times[1:]) / 2.0
            peaks.append(np.abs(rates).max(axis=0))
        return Peaks(*peaks)
