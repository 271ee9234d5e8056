"""A tour of the markers: come, set the needle's line by eye, approach until contact, read the joints; then home.

How deep a marker lies, the arm feels; a marker that is not where it should be is given up with its reason, and the arm
goes on from its standoff. What the arm says is all that is known here.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.motion.follow import follow_smoothly
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.touch.tour_motions import (
    PAST_MM,
    SLOW_MM,
    STANDOFF_MM,
    ApproachCheckers,
    Touch,
    TouchTour,
    line_to,
    why_not,
)
from puncture_twin.twin.devices import StoppedError, TouchingArm

TOUCH_SPEED_MM_S = 2.0
"""Tip speed over the last millimetres."""
NEAR_SPEED_MM_S = 25.0
"""Tip speed on the straight line before them, and back."""
MOST_ASIDE_MM = 10.0
"""A marker that lies farther from its believed place is not the one that was planned to be touched."""
PASSED_MM = 0.1
"""Rows of the line nearer to the tip than this are not returned to."""
SAME_PLACE_MM = 1e-4
"""Rows whose tips are nearer to each other are one."""


class TouchReading(NamedTuple):
    """Reading of one touch."""

    name: str
    point_base: Floats  # shape (3,), mm: what the controller computes from its joints
    q: Floats  # shape (6,), rad: its joints
    seconds: float  # from the last standoff, or home, to this one
    force_n: float  # the largest on the needle
    aside_mm: float  # by which the line was moved at the standoff


class FailedTouch(NamedTuple):
    """A marker that was not read, with the reason and the time; the arm is back at its standoff."""

    why: str
    seconds: float


@dataclass(frozen=True, eq=False)
class Touched:
    """Readings of all touches, in their order; seconds from home to home, or up to the last touch before a stop."""

    readings: tuple[TouchReading, ...]
    failed: Mapping[str, str]
    seconds: float


def touch_tour(tour: TouchTour, arm: TouchingArm, checkers: ApproachCheckers, progress: Count) -> Touched:
    """Touch every marker, and go home. Where the arm stops, what was not read by then stays unread."""
    readings: list[TouchReading] = []
    failed: dict[str, str] = {}
    seconds = 0.0
    try:
        for number, touch in enumerate(tour.touches):
            with arm.at_marker(touch) as q:
                touch_line = _touch(tour, touch, _line(tour, touch, q, checkers), arm)
            if isinstance(touch_line, FailedTouch):
                failed[touch.name] = touch_line.why
            else:
                readings.append(touch_line)
            seconds += touch_line.seconds
            progress(number + 1, len(tour.touches))
        seconds += arm.move(tour.leave, in_air=True).seconds
    except StoppedError as stop:
        done = {one.name for one in readings} | set(failed)
        failed |= {touch.name: f"the tour was stopped: {stop}" for touch in tour.touches if touch.name not in done}
    return Touched(tuple(readings), failed, seconds)


class _Line(NamedTuple):
    """The line along which a marker is approached, and by how much it was moved aside."""

    far: Floats  # shape (m, 6), rad: from the standoff to where the slow part begins
    near: Floats  # shape (k, 6): from there past the believed marker
    aside_mm: float


def _line(tour: TouchTour, touch: Touch, q: Floats, checkers: ApproachCheckers) -> _Line | str:
    """The line through joints (6,) that were set by eye, or in words why there is none."""
    model, tip_mm = tour.model, tour.tip_mm
    axis = flange_pose(model, q)[:3, 2]
    away = nominal_tip(model, tip_mm, q) - touch.point_base
    deeper = float(away @ axis)
    aside = float(np.linalg.norm(away - deeper * axis))
    if aside > MOST_ASIDE_MM:
        return f"it is {aside:.1f} mm to the side of its believed position; at most {MOST_ASIDE_MM:g} mm are allowed"
    far = line_to(model, tip_mm, q, STANDOFF_MM + deeper, SLOW_MM + deeper)
    near = line_to(model, tip_mm, q, SLOW_MM + deeper, deeper - PAST_MM)
    reached = line_to(model, tip_mm, q, deeper, deeper + 1.0)
    if far is None or near is None or reached is None:
        return "the arm cannot follow the line set at the standoff"
    refused = why_not(checkers, tip_mm, reached[0])
    return f"on the line set at the standoff, {refused}" if refused else _Line(far, near, aside)


def _touch(tour: TouchTour, touch: Touch, line: _Line | str, arm: TouchingArm) -> TouchReading | FailedTouch:
    come = arm.move(touch.come, in_air=True)
    if isinstance(line, str):
        return FailedTouch(line, come.seconds)
    there = arm.move_until_contact(_slow(tour, np.vstack([touch.come.q[-1:], line.far])), yielding=False)
    if there.contact:
        back = arm.move(_back(tour, touch, line, there.q))
        why = f"contact more than {SLOW_MM:g} mm before its believed position: given up"
        return FailedTouch(why, come.seconds + there.seconds + back.seconds)
    contact = arm.move_until_contact(_slow(tour, line.near, TOUCH_SPEED_MM_S), yielding=True)
    back = arm.move(_back(tour, touch, line, contact.q))
    seconds = come.seconds + there.seconds + contact.seconds + back.seconds
    if not contact.contact:
        return FailedTouch(f"no contact up to {PAST_MM:g} mm beyond its believed position", seconds)
    force, point = max(there.force_n, contact.force_n, back.force_n), nominal_tip(tour.model, tour.tip_mm, contact.q)
    return TouchReading(touch.name, point, contact.q, seconds, force, line.aside_mm)


def _back(tour: TouchTour, touch: Touch, line: _Line, q: Floats) -> Trajectory:
    """Move from a configuration (6,), rad, on the line, along it, to the standoff."""
    rows, axis = np.vstack([line.far, line.near]), flange_pose(tour.model, q)[:3, 2]
    tips = nominal_tip(tour.model, tour.tip_mm, np.vstack([q, rows])) @ axis
    return _slow(tour, np.vstack([q[None], rows[tips[1:] < tips[0] - PASSED_MM][::-1], touch.come.q[-1:]]))


def _slow(tour: TouchTour, q: Floats, speed_mm_s: float = NEAR_SPEED_MM_S) -> Trajectory:
    steps = np.linalg.norm(np.diff(nominal_tip(tour.model, tour.tip_mm, q), axis=0), axis=1)
    kept = np.concatenate([[True], steps > SAME_PLACE_MM])
    depths = np.concatenate([[0.0], np.cumsum(steps[kept[1:]])])
    return follow_smoothly(tour.model, q[kept], depths, max_tip_speed_mm_s=speed_mm_s)


def nominal_tip(model: UrModel, tip_mm: float, q: Floats) -> Floats:
    """The tip by the controller, shape (..., 3), mm, at encoders (..., 6), rad."""
    T = flange_pose(model, q)
    return np.asarray(T[..., :3, 3] + tip_mm * T[..., :3, 2])
