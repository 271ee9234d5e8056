"""Joint paths in time: within speed and acceleration limits, from rest to rest."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from planning.errors import InputError
from planning.robot.ur import UrModel

Array = NDArray[np.float64]

SAMPLE_S = 0.008
"""Spacing of the samples: the 125 Hz at which a UR3 takes joint targets."""

NO_HOLD = 1e-9
"""A steady phase shorter than this share of the ramp is rounding: the motion is a triangle."""

STANDSTILL_RAD = 1e-12
"""A segment on which no joint turns farther is no motion: rounding."""

SPLINE_SAMPLES = 8
"""Samples between two rows of a smooth motion, to find its fastest joint; the spline's slope is quadratic there."""


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Joint angles over time, straight between the samples.

    Attributes:
        times_s: Shape (m,), from 0, strictly rising, s.
        q: Shape (m, 6), rad.

    Raises:
        InputError: If shapes, times or numbers make no sense.
    """

    times_s: Array
    q: Array

    def __post_init__(self) -> None:
        times, q = np.array(self.times_s, dtype=np.float64), np.array(self.q, dtype=np.float64)
        if times.ndim != 1 or q.shape != (len(times), 6) or len(times) == 0:
            raise InputError(f"shapes {times.shape} and {q.shape}", where="trajectory", allowed="(m,) and (m, 6)")
        if not (np.isfinite(times).all() and np.isfinite(q).all()):
            raise InputError("a time or an angle is not finite", where="trajectory", allowed="finite numbers")
        if times[0] != 0.0 or (np.diff(times) <= 0.0).any():
            raise InputError("times do not rise from 0", where="trajectory", allowed="0, then strictly rising")
        for name, array in (("times_s", times), ("q", q)):
            array.setflags(write=False)
            object.__setattr__(self, name, array)

    @property
    def duration_s(self) -> float:
        """The time of the last sample, s."""
        return float(self.times_s[-1])

    def at(self, time_s: Array | float) -> Array:
        """Joint angles at a time, or at many, clamped to the ends.

        Args:
            time_s: A number or shape (...), s.

        Returns:
            Shape (..., 6), rad.
        """
        return np.stack([np.interp(time_s, self.times_s, self.q[:, joint]) for joint in range(6)], axis=-1)

    def max_speeds(self) -> Array:
        """The highest speed of each joint, shape (6,), rad/s."""
        return np.asarray(np.abs(self._speeds()).max(axis=0, initial=0.0))

    def max_accelerations(self) -> Array:
        """The highest acceleration of each joint from rest to rest, by differences of the samples, (6,), rad/s^2."""
        if len(self.q) == 1:
            return np.zeros(6)
        speeds = np.concatenate([np.zeros((1, 6)), self._speeds(), np.zeros((1, 6))])
        steps = np.concatenate([[0.0], np.diff(self.times_s), [0.0]])
        between = (steps[:-1] + steps[1:]) / 2.0
        return np.asarray(np.abs(np.diff(speeds, axis=0) / between[:, None]).max(axis=0))

    def _speeds(self) -> Array:
        return np.asarray(np.diff(self.q, axis=0) / np.diff(self.times_s)[:, None])


class _Profile(NamedTuple):
    """Distance run over time, both shape (m,)."""

    times_s: Array
    distance: Array


def stop_and_go(
    model: UrModel, waypoints: Array, *, speed_scale: float = 1.0, sample_s: float = SAMPLE_S
) -> Trajectory:
    """Run straight joint segments, each from rest to rest, as fast as the limits allow.

    Args:
        model: The arm: its speed and acceleration limits.
        waypoints: Shape (k, 6), rad.
        speed_scale: Share of the speed limits to use, above 0, at most 1.
        sample_s: Spacing of the samples, s.

    Returns:
        A trajectory that stays on the segments and touches every waypoint.

    Raises:
        InputError: If the waypoints or the scale make no sense.
    """
    waypoints = _checked_rows(waypoints)
    if not 0.0 < speed_scale <= 1.0:
        raise InputError(f"speed_scale = {speed_scale}", where="trajectory", allowed="above 0, at most 1")
    times, rows = [np.zeros(1)], [waypoints[:1]]
    for start, end in pairwise(waypoints):
        step = end - start
        if np.abs(step).max() <= STANDSTILL_RAD:
            continue
        with np.errstate(divide="ignore"):
            speed = float((speed_scale * model.max_speeds / np.abs(step)).min())
            acceleration = float((model.max_acceleration / np.abs(step)).min())
        profile = _trapezoid(1.0, speed, acceleration, sample_s)
        times.append(times[-1][-1] + profile.times_s[1:])
        rows.append(start + profile.distance[1:, None] * step)
    return Trajectory(np.concatenate(times), np.concatenate(rows))


def drive_smoothly(
    model: UrModel, q: Array, depths_mm: Array, *, max_tip_speed_mm_s: float, sample_s: float = SAMPLE_S
) -> Trajectory:
    """Run a dense, smooth motion in one go, such as the insertion: rest, steady tip speed, rest.

    A cubic spline over depth passes through every row. The tip's speed v and acceleration a are the highest for which
    |q'| v, and |q'| a + |q''| v^2, stay within the joints' limits over the whole motion (half of the acceleration for
    each of the two terms), and v within ``max_tip_speed_mm_s``.

    Args:
        model: The arm.
        q: Shape (m, 6), rad, m >= 2.
        depths_mm: Shape (m,), strictly rising, mm driven at each row.
        max_tip_speed_mm_s: mm/s.
        sample_s: Spacing of the samples, s.

    Raises:
        InputError: If rows, depths or speed make no sense.
    """
    q, depths = _checked_rows(q), np.asarray(depths_mm, dtype=np.float64)
    if len(q) < 2 or depths.shape != (len(q),) or not (np.diff(depths) > 0.0).all():
        raise InputError("depths do not rise row by row", where="trajectory", allowed="one rising depth a row")
    if not (math.isfinite(max_tip_speed_mm_s) and max_tip_speed_mm_s > 0.0):
        raise InputError(f"max_tip_speed_mm_s = {max_tip_speed_mm_s}", where="trajectory", allowed="above 0")
    spline = CubicSpline(depths, q)
    share = np.linspace(0.0, 1.0, SPLINE_SAMPLES, endpoint=False)
    dense = np.append((depths[:-1, None] + np.diff(depths)[:, None] * share).ravel(), depths[-1])
    slope = np.abs(spline(dense, 1)).max(axis=0)
    bend = float(np.abs(spline(depths, 2)).max())  # linear between rows, so largest at one
    with np.errstate(divide="ignore"):
        speed = min(max_tip_speed_mm_s, float((model.max_speeds / slope).min()))
        speed = min(speed, math.sqrt(model.max_acceleration / 2.0 / bend) if bend > 0.0 else math.inf)
        acceleration = float((model.max_acceleration / 2.0 / slope).min())
    if not math.isfinite(acceleration):
        raise InputError("no joint moves", where="trajectory", allowed="a motion")
    profile = _trapezoid(float(depths[-1] - depths[0]), speed, acceleration, sample_s)
    return Trajectory(profile.times_s, spline(depths[0] + profile.distance))


def in_sequence(parts: Sequence[Trajectory]) -> Trajectory:
    """Several trajectories one after the other, each starting where the one before it ended.

    Raises:
        InputError: If there is none, or one does not start where the one before it ended.
    """
    if not parts:
        raise InputError("nothing to join", where="trajectory", allowed="at least one part")
    times, rows = [parts[0].times_s], [parts[0].q]
    for part in parts[1:]:
        gap = float(np.abs(part.q[0] - rows[-1][-1]).max())
        if gap > 1e-9:
            raise InputError(f"a part starts {gap:.3g} rad off the end before it", where="trajectory", allowed="no gap")
        times.append(times[-1][-1] + part.times_s[1:])
        rows.append(part.q[1:])
    return Trajectory(np.concatenate(times), np.concatenate(rows))


def _trapezoid(length: float, speed: float, acceleration: float, sample_s: float) -> _Profile:
    """From rest to rest over a length: speed up, hold, slow down; without the middle where the length is too short."""
    speed = min(speed, math.sqrt(length * acceleration))
    ramp = speed / acceleration
    hold = length / speed - ramp
    up = _instants(ramp, sample_s)
    rising = acceleration * up**2 / 2.0
    if hold <= NO_HOLD * ramp:
        hold, level = 0.0, np.empty(0)
    else:
        level = _instants(hold, sample_s)[1:]
    times = np.concatenate([up, ramp + level, ramp + hold + up[1:]])
    distance = np.concatenate([rising, rising[-1] + speed * level, length - rising[-2::-1]])
    return _Profile(times, distance)


def _instants(duration: float, sample_s: float) -> Array:
    """From 0 to a duration in equal steps no longer than a sample, at least two: so that every ramp has a middle."""
    return np.linspace(0.0, duration, max(2, math.ceil(duration / sample_s)) + 1)


def _checked_rows(q: Array) -> Array:
    rows = np.asarray(q, dtype=np.float64)
    if rows.ndim != 2 or rows.shape[0] == 0 or rows.shape[1] != 6 or not np.isfinite(rows).all():
        raise InputError(f"joint rows of shape {rows.shape}", where="trajectory", allowed="(k, 6), finite")
    return rows
