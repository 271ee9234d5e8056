"""Planned touches executed in the simulator: marker after marker, and home; one that fails does not end the tour.

The declared errors of arm and markers are in where each marker is touched: the simulated arm is the nominal one, so a
pad stands on its line where the erring arm's tip would be on the true marker. At the standoff somebody sets the
needle's line onto the marker by eye; how deep it is, the arm feels. The tip is a point: the pad is square to the
needle.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.case.case import Case, bed_frame
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import case_boxes, case_tool, patient_surface
from puncture_twin.planning.geometry.rigid import frame_about, pose
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
from puncture_twin.twin.plant.true_needle import TouchTruth, nominal_tip
from puncture_twin.twin.world.client import to_m
from puncture_twin.twin.world.control import (
    Controller,
    Impedance,
    Measured,
    Motors,
    RigidModel,
    Run,
    Stiffness,
    Surroundings,
    allowed_step,
    reference_of,
    rigid_model,
    run,
    tips,
)
from puncture_twin.twin.world.execution import touches
from puncture_twin.twin.world.workcell import SimulatedWorkcell, load_box, open_workcell, remove, soften

TOUCH_SPEED_MM_S = 2.0
"""Tip speed over the last millimetres."""

NEAR_SPEED_MM_S = 25.0
"""Tip speed on the straight line before them, and back."""

CONTACT_N = 0.5
"""Force along the needle, N, that counts as contact."""

CONTACT_STEPS = 3
"""In a row: a sensor's noise alone does not reach it so often."""

FORCE_NOISE_N = 0.1
"""Standard deviation of the force sensor, per reading."""

SPRING = Stiffness(translation_n_m=1e3, rotation_nm_rad=100.0, integral_per_s=5.0)
"""Spring at the tip while it approaches a marker. The integral, which stands still in contact, takes away what the
arm's masses err by: with a tenth of them wrong the tip would come down .6 mm aside."""

PAD_N_M = 1e5
"""Stiffness of a marker on skin; a rigid one's first peak would be momentum over the time step."""

PAD_MM = (12.0, 12.0, 4.0)

MOST_ASIDE_MM = 10.0
"""A marker that lies farther from its believed place is not the one that was planned to be touched."""

LOOK_EVERY = 8
"""Steps of the motors between two looks at where the needle is: 30 a second."""

PAUSE_S = 0.25
"""Before motors and torques take over from one another."""


@dataclass(frozen=True, eq=False)
class Touched:
    """Readings of all touches, in their order.

    Attributes:
        readings: One a marker that was touched.
        failed: Marker to why it was not read, in words.
        seconds: Home to home; where the arm stopped, of the touches before that.
    """

    readings: tuple[TouchReading, ...]
    failed: Mapping[str, str]
    seconds: float


def execute_touches(
    tour: TouchTour, case: Case, anatomy: Anatomy, checkers: ApproachCheckers, truth: TouchTruth, progress: Count
) -> Touched:
    """Touch the markers at their true places. The same tour and truth give the same numbers.

    A marker that is not touched where it should be is given up with its reason, and the arm goes on from its standoff.
    Where the arm or needle touched something else it stops, and what was not read by then stays unread.

    Args:
        tour: Where, in which order, by which motions.
        case: For tool, boxes and gravity.
        anatomy: For the skin.
        checkers: Of the workcell as it is believed: a line moved at the standoff is checked again.
        truth: All randomness but the force sensor's is in it, and that comes from its seed.
        progress: Called with touches done and all of them.
    """
    tool, T = case_tool(case), truth.T_base_ct
    down_ct = -bed_frame(case)[:3, 2]
    with (
        open_workcell(tour.model, tool, anatomy.skin.mesh, T, case_boxes(case, T), down_ct=down_ct) as workcell,
        rigid_model(tour.model, tool, T[:3, :3] @ down_ct) as rigid,
    ):
        true = CellChecker(tour.model, tool, patient=patient_surface(anatomy).transformed(T))
        cell = TouchingCell(workcell, rigid, tour, truth, checkers, true, np.random.default_rng([truth.seed, 1]))
        workcell.arm.place(tour.touches[0].come.q[0])
        return _tour(cell, progress)


def _tour(cell: TouchingCell, progress: Count) -> Touched:
    """Touch every marker, and go home."""
    readings: list[TouchReading] = []
    failed: dict[str, str] = {}
    touches, seconds = cell.tour.touches, 0.0
    try:
        for number, touch in enumerate(touches):
            found = touch_marker(cell, touch)
            if isinstance(found, FailedTouch):
                failed[touch.name] = found.why
            else:
                readings.append(found)
            seconds += found.seconds
            progress(number + 1, len(touches))
        seconds += seconds_of(moved_outside(cell, cell.tour.leave, np.zeros(6)))
    except StoppedError as stop:
        done = {one.name for one in readings} | set(failed)
        failed |= {touch.name: f"the tour was stopped: {stop}" for touch in touches if touch.name not in done}
    return Touched(tuple(readings), failed, seconds)


@dataclass(frozen=True, eq=False)
class TouchingCell:
    """Workcell, tool and generators of every touch.

    Attributes:
        workcell: The simulated workcell.
        rigid: The arm's masses as its controller knows them.
        tour: The touches.
        truth: The ground truth.
        checkers: Of the workcell as it is believed.
        true: Of the needle against the patient at their true pose.
        rng: Of the force sensor's noise.
    """

    workcell: SimulatedWorkcell
    rigid: RigidModel
    tour: TouchTour
    truth: TouchTruth
    checkers: ApproachCheckers
    true: CellChecker
    rng: np.random.Generator


class TouchReading(NamedTuple):
    """Reading of one executed touch."""

    name: str
    point_base: Floats
    """Shape (3,), mm: what the controller computes from its joints."""
    q: Floats
    """Shape (6,), rad: its joints."""
    seconds: float
    """From the last standoff (or home) to this one after the touch."""
    force_n: float
    """The largest on the needle."""
    bias_mm: float
    """How deep in the marker the tip was when the joints were read."""
    speed_mm_s: float
    """Tip speed at contact."""
    aside_mm: float
    """By how much the line was moved at the standoff."""


class FailedTouch(NamedTuple):
    """A marker that was not read, with the reason and the time; the arm is back at its standoff."""

    why: str
    seconds: float


class StoppedError(Exception):
    """The arm stopped where it had no planned path: something is not where it is believed to be."""


def touch_marker(cell: TouchingCell, touch: Touch) -> TouchReading | FailedTouch:
    """Touch one marker: come, set the line, approach until contact, read, go back to the standoff.

    Args:
        cell: The workcell, the arm at the last standoff or at home.
        touch: As planned.

    Raises:
        StoppedError: The arm touched what it should not.
    """
    line = _line(cell, touch)
    if isinstance(line, str):
        return FailedTouch(line, seconds_of(moved_outside(cell, touch.come, cell.truth.arrival[touch.name])))
    pad = _pad(cell, line)
    try:
        return _touched_and_read(cell, touch, line)
    finally:
        remove(cell.workcell.client, pad)


class _Line(NamedTuple):
    """The straight line to a marker, set at the standoff."""

    far: Floats
    """Shape (m, 6), rad: from the standoff to where the slow part begins."""
    near: Floats
    """Shape (k, 6): from there past the believed marker."""
    face_base: Floats
    """Shape (3,), mm: where the simulated tip touches the marker."""
    axis_base: Floats
    """Shape (3,), unit, toward the tip."""
    aside_mm: float


def _line(cell: TouchingCell, touch: Touch) -> _Line | str:
    """The line through the true marker, from where it is believed along the needle, or in words why there is none."""
    model, tip_mm = cell.tour.model, cell.tour.tip_mm
    q = cell.truth.q_contact(model, tip_mm, touch)
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
    refused = why_not(cell.checkers, tip_mm, reached[0])
    if refused:
        return f"on the line set at the standoff, {refused}"
    face = nominal_tip(model, tip_mm, q + cell.truth.arrival[touch.name])
    return _Line(far, near, face, flange_pose(model, q + cell.truth.arrival[touch.name])[:3, 2], aside)


def _touched_and_read(cell: TouchingCell, touch: Touch, line: _Line) -> TouchReading | FailedTouch:
    arrival = cell.truth.arrival[touch.name]
    come = moved_outside(cell, touch.come, arrival)
    to_near = _slow(cell, np.vstack([touch.come.q[-1:], line.far]))
    there = _run(cell, Motors(), to_near, arrival, _Contact(cell, line), PAUSE_S)
    if there.stopped:
        back = _moved(cell, _back(cell, touch, line, there.q[-1]), arrival)
        why = f"contact more than {SLOW_MM:g} mm before its believed position: given up"
        return FailedTouch(why, sum(map(seconds_of, (come, there, back))))
    contact = _approached_contact(cell, line, arrival)
    q = contact.q[-1]
    back = _moved(cell, _back(cell, touch, line, q), arrival)
    seconds = sum(map(seconds_of, (come, there, contact, back)))
    if not contact.stopped:
        return FailedTouch(f"no contact up to {PAST_MM:g} mm beyond its believed position", seconds)
    depth = float((1e3 * contact.tip_m[-1] - line.face_base) @ line.axis_base)
    moved = 1e3 * np.linalg.norm(contact.tip_m[-1] - contact.tip_m[-2]) / contact.dt if len(contact.tip_m) > 1 else 0.0
    force = max(float(np.linalg.norm(one.force_n, axis=1).max()) for one in (there, contact, back))
    point = nominal_tip(cell.tour.model, cell.tour.tip_mm, q)
    return TouchReading(touch.name, point, q, seconds, force, depth, float(moved), line.aside_mm)


def _back(cell: TouchingCell, touch: Touch, line: _Line, q: Floats) -> Trajectory:
    """Move from a configuration (6,), rad, on the line, along it, to the standoff."""
    rows = np.vstack([line.far, line.near])
    passed = _tip_mm(cell, rows) @ line.axis_base < _tip_mm(cell, q[None])[0] @ line.axis_base - PASSED_MM
    return _slow(cell, np.vstack([q[None], rows[passed][::-1], touch.come.q[-1:]]))


PASSED_MM = 0.1
"""Rows of the line nearer to the tip than this are not returned to."""


def _pad(cell: TouchingCell, line: _Line) -> int:
    """The marker's body, its face square to the needle."""
    centre = line.face_base + PAD_MM[2] / 2 * line.axis_base
    pad = load_box(cell.workcell.client, np.array(PAD_MM), pose(frame_about(line.axis_base), centre))
    soften(cell.workcell.client, pad, PAD_N_M)
    return pad


def _approached_contact(cell: TouchingCell, line: _Line, arrival: Floats) -> Run:
    """Move the last millimetres under a spring at the tip, until contact is measured or the line ends."""
    J = tips(cell.tour.model, cell.rigid.tip_m, line.near[:1]).J[0]
    dt = allowed_step(SPRING, J, cell.rigid.mass_matrix(line.near[0]))
    controller = Impedance(cell.rigid, SPRING, dt)
    trajectory = _slow(cell, line.near, TOUCH_SPEED_MM_S)
    return _run(cell, controller, trajectory, arrival, _Contact(cell, line))


class _Contact:
    """Detects contact with the marker: a force along the needle, some readings in a row."""

    def __init__(self, cell: TouchingCell, line: _Line) -> None:
        self._rng, self._axis, self._in_a_row = cell.rng, line.axis_base, 0

    def __call__(self, measured: Measured) -> bool:
        pressed = -float(measured.force_n @ self._axis) + self._rng.normal(0.0, FORCE_NOISE_N)
        self._in_a_row = self._in_a_row + 1 if pressed > CONTACT_N else 0
        return self._in_a_row >= CONTACT_STEPS


def _slow(cell: TouchingCell, q: Floats, speed_mm_s: float = NEAR_SPEED_MM_S) -> Trajectory:
    """A smooth motion through configurations (m, 6), its tip at most so fast."""
    steps = np.linalg.norm(np.diff(_tip_mm(cell, q), axis=0), axis=1)
    kept = np.concatenate([[True], steps > SAME_PLACE_MM])
    depths = np.concatenate([[0.0], np.cumsum(steps[kept[1:]])])
    return follow_smoothly(cell.tour.model, q[kept], depths, max_tip_speed_mm_s=speed_mm_s)


SAME_PLACE_MM = 1e-4
"""Rows whose tips are nearer to each other are one."""


def _tip_mm(cell: TouchingCell, q: Floats) -> Floats:
    return 1e3 * tips(cell.tour.model, float(to_m(cell.tour.tip_mm)), q).position_m


def _moved(cell: TouchingCell, trajectory: Trajectory, arrival: Floats) -> Run:
    """Execute a motion by the position motors."""
    return _run(cell, Motors(), trajectory, arrival, None)


def moved_outside(cell: TouchingCell, trajectory: Trajectory, arrival: Floats) -> Run:
    """A motion by the motors on which the needle must stay out of the patient; the physics lets it pass their skin.

    Args:
        cell: The workcell.
        trajectory: From where the arm is.
        arrival: Shape (6,), rad: true joints minus what the encoders say.

    Raises:
        StoppedError: It did not.
    """
    done = _moved(cell, trajectory, arrival)
    found = cell.true.first_contact(done.q[::LOOK_EVERY] + arrival, needle_may_touch_patient=False)
    if found is not None:
        what = f"{found.contact.body} touched {found.contact.other}"
        raise StoppedError(f"on the way {what}: the patient is not at the believed position")
    return done


def _run(
    cell: TouchingCell,
    controller: Controller,
    trajectory: Trajectory,
    arrival: Floats,
    stop: Callable[[Measured], bool] | None,
    pause_s: float = 0.0,
) -> Run:
    reference = reference_of(cell.tour.model, cell.rigid.tip_m, trajectory, controller.dt, pause_s)
    around = Surroundings(arrival, stop=stop, watch=lambda row: _refuse_contacts(cell))
    return run(
        cell.workcell.arm, controller, reference, lambda q: tips(cell.tour.model, cell.rigid.tip_m, q[None]), around
    )


def _refuse_contacts(cell: TouchingCell) -> None:
    """Stop where the arm touches what it should not; the markers' pads have no name.

    Raises:
        StoppedError: It does.
    """
    for one in touches(cell.workcell.arm):
        if one.body in cell.workcell.bodies:
            raise StoppedError(f"{one.link} touches {cell.workcell.bodies[one.body]}")


def seconds_of(done: Run) -> float:
    """Duration of a motion, s."""
    return done.dt * len(done.q)
