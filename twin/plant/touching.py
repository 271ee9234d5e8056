"""An arm that touches markers in the simulator, and an executed tour of them.

The simulated arm is the nominal one: a pad, square to the needle, stands where an erring arm's tip would be on the true
marker.
"""

from collections.abc import Iterator
from contextlib import contextmanager
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
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.touch.tour_motions import ApproachCheckers, Touch, TouchTour
from puncture_twin.twin.devices import Moved, StoppedError
from puncture_twin.twin.guidance.ct.touching import Touched, nominal_tip, touch_tour
from puncture_twin.twin.plant.true_needle import TouchTruth
from puncture_twin.twin.world.control import (
    Controller,
    Impedance,
    Measured,
    Motors,
    RigidModel,
    Run,
    Stiffness,
    Stop,
    allowed_step,
    reference_of,
    rigid_model,
    run,
    tips,
)
from puncture_twin.twin.world.execution import touches
from puncture_twin.twin.world.workcell import SimulatedWorkcell, load_box, open_workcell, remove, soften

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
LOOK_EVERY = 8
"""Steps of the motors between two looks at where the needle is: 30 a second."""
PAUSE_S = 0.25
"""Before motors and torques take over from one another."""


class TrueContact(NamedTuple):
    """Ground truth when a touch was read: depth of the tip in the marker, and its speed."""

    bias_mm: float
    speed_mm_s: float


@dataclass(frozen=True, eq=False)
class ExecutedTouches(Touched):
    """Readings, and what was true at each, by its marker."""

    contacts: dict[str, TrueContact]


def execute_touches(
    tour: TouchTour, case: Case, anatomy: Anatomy, checkers: ApproachCheckers, truth: TouchTruth, progress: Count
) -> ExecutedTouches:
    """Touch the markers at their true places. The same tour and truth give the same numbers."""
    tool, T = case_tool(case), truth.T_base_ct
    down_ct = -bed_frame(case)[:3, 2]
    with (
        open_workcell(tour.model, tool, anatomy.skin.mesh, T, case_boxes(case, T), down_ct=down_ct) as workcell,
        rigid_model(tour.model, tool, T[:3, :3] @ down_ct) as rigid,
    ):
        patient = CellChecker(tour.model, tool, patient=patient_surface(anatomy).transformed(T))
        plant = TouchingPlant(workcell, rigid, tour, truth, patient)
        workcell.arm.place(tour.touches[0].come.q[0])
        done = touch_tour(tour, plant, checkers, progress)
    return ExecutedTouches(done.readings, done.failed, done.seconds, plant.contacts)


class TouchingPlant:
    """The simulated arm at the true markers, as a `TouchingArm`."""

    def __init__(
        self, workcell: SimulatedWorkcell, rigid: RigidModel, tour: TouchTour, truth: TouchTruth, patient: CellChecker
    ) -> None:
        self._workcell, self._rigid, self._truth, self._patient = workcell, rigid, truth, patient
        self._model, self._tip_mm, self._marker = tour.model, tour.tip_mm, ""
        self._arrival, self._face, self._axis = np.zeros(6), np.zeros(3), np.zeros(3)
        self._rng = np.random.default_rng([truth.seed, 1])
        self.contacts: dict[str, TrueContact] = {}
        """What was true where each marker was felt."""

    @contextmanager
    def at_marker(self, touch: Touch) -> Iterator[Floats]:
        """One marker, its face square to the needle, where the erring arm's tip would be on it."""
        q = self._truth.q_contact(self._model, self._tip_mm, touch)
        self._marker, self._arrival = touch.name, self._truth.arrival[touch.name]
        self._axis = flange_pose(self._model, q + self._arrival)[:3, 2]
        self._face = nominal_tip(self._model, self._tip_mm, q + self._arrival)
        client, centre = self._workcell.client, self._face + PAD_MM[2] / 2 * self._axis
        pad = load_box(client, np.array(PAD_MM), pose(frame_about(self._axis), centre))
        soften(client, pad, PAD_N_M)
        try:
            yield q
        finally:
            remove(client, pad)
            self._arrival = np.zeros(6)

    def move(self, motion: Trajectory, *, in_air: bool = False) -> Moved:
        """By the position motors; the physics lets the needle pass the skin, so another checker looks after it."""
        done = self._run(Motors(), motion)
        seen = done.q[::LOOK_EVERY] + self._arrival
        if in_air and (contact := self._patient.first_contact(seen, needle_may_touch_patient=False)):
            what = f"{contact.contact.body} touched {contact.contact.other}"
            raise StoppedError(f"on the way {what}: the patient is not at the believed position")
        return _moved(done)

    def move_until_contact(self, motion: Trajectory, *, yielding: bool) -> Moved:
        """By the motors, or under a spring at the tip, until a force along the needle is read some times in a row."""
        in_a_row = 0

        def pressed(measured: Measured) -> bool:
            nonlocal in_a_row
            force = -float(measured.force_n @ self._axis) + self._rng.normal(0.0, FORCE_NOISE_N)
            in_a_row = in_a_row + 1 if force > CONTACT_N else 0
            return in_a_row >= CONTACT_STEPS

        if not yielding:
            return _moved(self._run(Motors(), motion, pressed, PAUSE_S))
        J = tips(self._model, self._rigid.tip_m, motion.q[:1]).J[0]
        dt = allowed_step(SPRING, J, self._rigid.mass_matrix(motion.q[0]))
        done = self._run(Impedance(self._rigid, SPRING, dt), motion, pressed)
        if done.stopped:
            depth = float((1e3 * done.tip_m[-1] - self._face) @ self._axis)
            speed = 1e3 * np.linalg.norm(np.diff(done.tip_m[-2:], axis=0)) / done.dt
            self.contacts[self._marker] = TrueContact(depth, float(speed))
        return _moved(done)

    def _run(self, controller: Controller, motion: Trajectory, stop: Stop | None = None, pause_s: float = 0.0) -> Run:
        reference = reference_of(self._model, self._rigid.tip_m, motion, controller.dt, pause_s)
        return run(self._workcell.arm, controller, reference, self._arrival, stop=stop, watch=self._refuse_contacts)

    def _refuse_contacts(self, _: int) -> None:
        for one in touches(self._workcell):
            raise StoppedError(f"{one.link} touches {one.body}")


def _moved(done: Run) -> Moved:
    force = float(np.linalg.norm(done.force_n, axis=1).max())
    return Moved(done.q[-1], done.dt * len(done.q), force, done.stopped)
