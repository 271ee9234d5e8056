"""Joint paths in time: past rounded corners without a stop, and straight insertions; from rest to rest, low in jerk.

Corner. Between two straight segments with unit directions u and w the joints' velocity changes from v u to v w at one
speed v of the path: dq/dt = v ((1 - f) u + f w) with f = 3 x^2 - 2 x^3, x = t / T. The curve leaves the one segment
and joins the other at the distance d = v T / 2 from the corner, which fixes its shape whatever the speed. Each joint's
speed stays between those of the two segments; its acceleration is at most 3/4 v^2 |w - u| / d and zero at both ends;
its jerk is at most 3/2 v^3 |w - u| / d^2; the curve passes the corner at 3/16 d |w - u|, inside the triangle that it
cuts off. Between corners ruckig changes the speed (Berscheid and Kroeger 2021, "Jerk-limited real-time trajectory
generation with arbitrary target states").
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import scipy
from ruckig import InputParameter, Result, Ruckig, Trajectory as Profile

from puncture_twin.planning.arm.kinematics import TipLimit, tip_rates
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory

MAX_JERK = 14.0
"""rad/s^3, of every joint: a UR's acceleration of 1.4 rad/s^2 is reached in a tenth of a second. No manual states a
limit; this is for the needle, which swings after every jolt."""
STANDSTILL_RAD = 1e-12
"""A segment on which no joint turns farther is no motion: rounding."""
SAME_STEP = 1e-9
"""Fraction of a sample: a duration that is a whole number of samples but for this is one."""
TIP_STEP_RAD = 0.005
"""rad between the samples at which the tip's speed along a path is computed; between two of them it rises by at most
5e-5 of what the arm's whole reach would have: h^2 / 8 times the second derivative."""
TIP_FRACTION = 0.999
"""Fraction of the tip's speed limit that is used: what samples may miss."""
TINY = 1e-30
"""Below every rate that means anything: keeps divisions finite."""
SPLINE_SAMPLES = 8
"""Samples between two rows of a smooth motion, to find its fastest joint; the spline's slope is quadratic there."""


class _Straight(NamedTuple):
    start: Floats
    direction: Floats
    law: TimeLaw

    @property
    def duration_s(self) -> float:
        return self.law.duration_s

    def at(self, times_s: Floats) -> Floats:
        return np.asarray(self.start + self.law.travelled(times_s)[:, None] * self.direction)


class _Round(NamedTuple):
    corner: Floats
    before: Floats
    after: Floats
    cut: float
    speed: float

    @property
    def duration_s(self) -> float:
        return 2.0 * self.cut / self.speed

    def at(self, times_s: Floats) -> Floats:
        return rounded(self.corner, self.before, self.after, self.cut, times_s / self.duration_s)


_Stretch = _Straight | _Round


def _tip_speed(model: UrModel, q: Floats, directions: Floats, tip: TipLimit | None) -> float:
    """The highest speed along a path through q (m, 6) that keeps the tip's limit, per unit of ``directions``."""
    if tip is None:
        return math.inf
    return TIP_FRACTION * tip.speed_mm_s / max(float(tip_rates(model, q, directions, tip.tip_mm).max()), TINY)


def rounded(corner: Floats, before: Floats, after: Floats, cut: float, fraction: Floats) -> Floats:
    """The curve past a corner, as in the module's equations.

    Args:
        corner: Shape (6,), rad.
        before: Shape (6,), unit direction of the segment that leads to it.
        after: Shape (6,), unit direction of the one that leads on.
        cut: How far from the corner the curve begins and ends, rad.
        fraction: Shape (m,), 0..1: of the time on the curve.

    Returns:
        Shape (m, 6), rad.
    """
    covered = fraction**3 - fraction**4 / 2.0  # of f, from 0 to the fraction
    along, across = -1.0 + 2.0 * (fraction - covered), 2.0 * covered  # of the two directions, over the cut
    return np.asarray(corner + cut * (along[:, None] * before + across[:, None] * after))


def follow(model: UrModel, waypoints: Floats, cuts: Floats | None = None, *, tip: TipLimit | None = None) -> Trajectory:
    """Run straight joint segments as fast as the limits allow, past rounded corners, from rest to rest.

    Samples are ``SAMPLE_S`` apart, every stop among them.

    Args:
        cuts: Shape (k - 2,), rad: how far from each waypoint between the ends its rounding begins; 0 stops there. None
            stops at all of them.
        tip: How fast the needle's tip may move; None for as fast as the joints take it.
    """
    cuts = np.zeros(max(0, len(waypoints) - 2)) if cuts is None else np.asarray(cuts, dtype=np.float64)  # one a corner
    if not cuts.any():  # every waypoint is a stop: those without motion between go
        waypoints = waypoints[np.append(True, np.abs(np.diff(waypoints, axis=0)).max(axis=1) > STANDSTILL_RAD)]
        cuts = np.zeros(max(0, len(waypoints) - 2))
    if len(waypoints) == 1:
        return Trajectory(np.zeros(1), waypoints)
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    straight = (lengths - np.append(cuts, 0.0) - np.append(0.0, cuts)).clip(0.0)  # two cuts may use a segment up
    return _sampled(waypoints, _runs(model, waypoints, cuts, straight, tip))


def _runs(
    model: UrModel, waypoints: Floats, cuts: Floats, straight: Floats, tip: TipLimit | None
) -> Iterator[list[_Stretch]]:
    """Straight stretches (``straight`` long, one a segment) and rounded corners in turn, from stop to stop."""
    steps = np.diff(waypoints, axis=0)
    directions = steps / np.linalg.norm(steps, axis=1, keepdims=True)
    rates = [_segment_rates(model, *ends, tip) for ends in pairwise(waypoints)]
    round_speeds = [
        _round_speed(model, waypoints[at + 1], directions[at], directions[at + 1], cut, tip)
        for at, cut in enumerate(cuts.tolist())
    ]
    speeds = _corner_speeds(round_speeds, straight, rates)
    run: list[_Stretch] = []
    for at, (direction, length) in enumerate(zip(directions, straight, strict=True)):
        start = waypoints[at] + (cuts[at - 1] if at else 0.0) * direction  # behind the rounding before it
        if length > STANDSTILL_RAD:
            run.append(_Straight(start, direction, time_law(float(length), rates[at], speeds[at], speeds[at + 1])))
        if speeds[at + 1] == 0.0:
            yield run
            run = []
        else:
            run.append(_Round(waypoints[at + 1], direction, directions[at + 1], float(cuts[at]), speeds[at + 1]))


def _segment_rates(model: UrModel, start: Floats, end: Floats, tip: TipLimit | None) -> Rates:
    length = float(np.linalg.norm(end - start))
    direction = (end - start) / length
    fraction = np.maximum(np.abs(direction), TINY)
    limits = (model.max_speeds, model.max_acceleration, MAX_JERK)
    rates = Rates(*(float((limit / fraction).min()) for limit in limits))  # the slowest joint decides
    along = np.linspace(0.0, 1.0, math.ceil(length / TIP_STEP_RAD) + 1)[:, None]
    return rates._replace(speed=min(rates.speed, _tip_speed(model, start + along * (end - start), direction, tip)))


def _round_speed(
    model: UrModel, corner: Floats, before: Floats, after: Floats, cut: float, tip: TipLimit | None
) -> float:
    """Highest speed past a corner by acceleration, jerk and tip; 0 where the arm stops."""
    if cut == 0.0:
        return 0.0
    turn = max(TINY, float(np.abs(after - before).max()))  # |w - u| of the joint that changes most
    by_acceleration = math.sqrt(model.max_acceleration * cut / (0.75 * turn))
    by_jerk = (MAX_JERK * cut * cut / (1.5 * turn)) ** (1.0 / 3.0)
    x = np.linspace(0.0, 1.0, math.ceil(2.0 * cut / TIP_STEP_RAD) + 2)
    f = (3.0 * x**2 - 2.0 * x**3)[:, None]
    by_tip = _tip_speed(model, rounded(corner, before, after, cut, x), (1.0 - f) * before + f * after, tip)
    return min(by_acceleration, by_jerk, by_tip)


def _corner_speeds(round_speeds: list[float], straight: Floats, rates: list[Rates]) -> list[float]:
    """The speed at each waypoint, 0 at the ends: what the corner allows, and what the segments can change it to."""
    slower = [min(before.speed, after.speed) for before, after in pairwise(rates)]
    speeds = [0.0, *(min(pair) for pair in zip(round_speeds, slower, strict=True)), 0.0]
    for at in range(len(straight)):
        speeds[at + 1] = min(
            speeds[at + 1], reachable_speed(speeds[at], speeds[at + 1], float(straight[at]), rates[at])
        )
    for at in range(len(straight) - 1, -1, -1):  # backwards: what can be braked from
        speeds[at] = min(speeds[at], reachable_speed(speeds[at + 1], speeds[at], float(straight[at]), rates[at]))
    return speeds


def _sampled(waypoints: Floats, runs: Iterable[list[_Stretch]]) -> Trajectory:
    """All runs sampled one after the other, each slowed by less than one sample so that it ends on one."""
    rows, count = [waypoints[:1]], 0
    for run in runs:
        ends = np.cumsum([stretch.duration_s for stretch in run])
        steps = _steps(float(ends[-1]))
        times = ends[-1] * np.arange(1, steps + 1) / steps
        which = np.minimum(np.searchsorted(ends, times), len(run) - 1)  # the last time may round beyond its end
        for at, stretch in enumerate(run):
            begin = ends[at] - stretch.duration_s
            rows.append(stretch.at((times[which == at] - begin).clip(0.0, stretch.duration_s)))
        count += steps
    return _ending_at(waypoints[-1], np.concatenate(rows))


def _steps(duration_s: float) -> int:
    return max(1, math.ceil(duration_s / SAMPLE_S - SAME_STEP))


def _ending_at(end: Floats, rows: Floats) -> Trajectory:
    """Samples with their last state put in exactly: sums of steps round."""
    q = np.array(rows, dtype=np.float64)
    q[-1] = end
    return Trajectory(SAMPLE_S * np.arange(len(q), dtype=np.float64), q)


def follow_smoothly(model: UrModel, q: Floats, depths_mm: Floats, *, max_tip_speed_mm_s: float) -> Trajectory:
    """Run a dense, smooth motion in one go, such as the insertion: rest, steady tip speed, rest.

    A cubic spline over depth passes through every row. With the tip's speed v, acceleration a and jerk j, and the
    spline's derivatives q1, q2, q3 by depth, the joints have q1 v, q1 a + q2 v^2 and q1 j + 3 q2 v a + q3 v^3. v, a and
    j are such that the terms of each sum share its limit equally, at the worst place of the motion, and v stays within
    ``max_tip_speed_mm_s``.

    Args:
        q: Shape (m, 6), rad, m >= 2.
        depths_mm: Shape (m,), strictly rising, mm inserted at each row.

    Raises:
        InputError: No joint moves.
    """
    depths = np.asarray(depths_mm, dtype=np.float64)
    spline = scipy.interpolate.CubicSpline(depths, q)
    fraction = np.linspace(0.0, 1.0, SPLINE_SAMPLES, endpoint=False)
    dense = np.append((depths[:-1, None] + np.diff(depths)[:, None] * fraction).ravel(), depths[-1])
    slope = np.abs(spline(dense, 1)).max(axis=0)
    bend, twist = (float(np.abs(spline(depths, order)).max()) for order in (2, 3))  # linear and constant between rows
    if not slope.any():
        refuse("no joint moves", "trajectory", "a motion", "no_motion")
    speed = min(max_tip_speed_mm_s, float((model.max_speeds / np.maximum(slope, TINY)).min()))
    speed = min(speed, math.sqrt(model.max_acceleration / 2.0 / max(bend, TINY)))  # half the limit to q2 v^2
    speed = min(speed, (MAX_JERK / 3.0 / max(twist, TINY)) ** (1.0 / 3.0))  # a third to q3 v^3
    acceleration = model.max_acceleration / 2.0 / float(slope.max())  # the other half to q1 a
    acceleration = min(acceleration, MAX_JERK / 9.0 / max(bend * speed, TINY))  # a third of the jerk to 3 q2 v a
    rates = Rates(speed, acceleration, MAX_JERK / 3.0 / float(slope.max()))
    law = time_law(float(depths[-1] - depths[0]), rates)
    steps = _steps(law.duration_s)
    return _ending_at(q[-1], spline(depths[0] + law.travelled(law.duration_s * np.arange(steps + 1) / steps)))


LENGTH_SLACK = 1e-6
"""Fraction of a length to spare for a change of speed: without, ruckig may miss the fit and take a detour."""
BISECTIONS = 60
"""Bisections of an interval of speeds: to rounding."""


class Rates(NamedTuple):
    """The highest speed, acceleration and jerk along a path, per s, s^2 and s^3 of whatever measures its length."""

    speed: float
    acceleration: float
    jerk: float


class TimeLaw(NamedTuple):
    """A path run in time."""

    length: float
    duration_s: float
    profile: Profile | None  # ruckig's; None where the speed is constant

    def travelled(self, times_s: Floats) -> Floats:
        """The length run at some times (m,) from 0 to ``duration_s``."""
        if self.profile is None:
            return np.asarray(self.length * times_s / self.duration_s)
        steps = self.profile.profiles[0][0]
        if steps.brake.duration > 0.0:  # it would start above its limits; none here does, and ``at_time`` knows how
            at = np.array([self.profile.at_time(float(time))[0][0] for time in times_s])
            return at.clip(0.0, self.length)
        ends = np.cumsum(steps.t)  # of pieces of constant jerk
        piece = np.searchsorted(ends[:-1], times_s, side="right")
        since = times_s - np.append(0.0, ends)[piece]
        jerk, acceleration, speed, position = (np.array(rows)[piece] for rows in (steps.j, steps.a, steps.v, steps.p))
        at = position + since * (speed + since * (acceleration / 2.0 + since * jerk / 6.0))
        return np.asarray(at.clip(0.0, self.length))


def time_law(length: float, rates: Rates, start_speed: float = 0.0, end_speed: float = 0.0) -> TimeLaw:
    """The fastest motion over a length above 0, without acceleration at either end, to a `reachable_speed`."""
    task = InputParameter(1)
    task.current_position, task.current_velocity, task.current_acceleration = [0.0], [start_speed], [0.0]
    task.target_position, task.target_velocity, task.target_acceleration = [length], [end_speed], [0.0]
    task.max_velocity, task.max_acceleration, task.max_jerk = [rates.speed], [rates.acceleration], [rates.jerk]
    profile = Profile(1)
    if Ruckig(1).calculate(task, profile) not in (Result.Working, Result.Finished):
        what = f"no motion over {length:.6g} from speed {start_speed:.6g} to {end_speed:.6g}"
        refuse(what, "trajectory", f"within {rates}", "no_time_law")
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
