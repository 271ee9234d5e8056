"""Control of the tip along a motion: impedance, admittance or position motors, taken over while the arm is at rest.

**Impedance** (`Impedance`): a spring and a damper at the needle's tip, by joint torques (Hogan 1985).

    tau = ID(q, qd, qdd_ref) + J' (K e + D de/dt + K_i K int e dt)

e is the reference's tip minus the measured one: position, then the rotation between them, in base axes. Without
contact the model's torque alone follows the reference and the spring corrects what the masses err by; in contact the
tip yields by F / K. The integral takes the rest away, and with it, in 1/K_i seconds, the compliance: it stops
while contact is measured, where the compliance is to be kept.

**Stability** (`damping`, `refuse_unstable`): along one mode of effective mass m the loop of stiffness K = m w^2 and
damping 2 zeta w m, integrated with the step dt, is stable while (w dt)^2 + 4 zeta w dt < 4; for zeta = .8 that is
w dt < .96. What is allowed is `MOST_RATIO`.

Source: Hogan 1985, "Impedance control"; Albu-Schaeffer, Ott, Frese, Hirzinger 2003, "Cartesian impedance control of
redundant robots": damping by factors of mass and stiffness at once ("double diagonalisation"). Their other design, from
the roots of both, is not positive where position and rotation are coupled, and an arm with a long needle oscillates.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
from scipy.interpolate import CubicSpline

from puncture_twin.planning.arm.kinematics import jacobians, link_frames
from puncture_twin.planning.arm.links import model_urdf
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.geometry.rigid import skew
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.twin.world.arm import Arm, load_arm
from puncture_twin.twin.world.client import MM_PER_M, TIME_STEP_S, physics_client, pybullet, step, to_mm
from puncture_twin.twin.world.execution import RECORD_S, Execution, Recorder, contact_force
from puncture_twin.twin.world.workcell import SimulatedWorkcell

TipControl = Literal["impedance", "admittance", "position"]
"""A spring at the tip by joint torques, or by moved goals of the position motors; or those motors alone."""


def insert(
    workcell: SimulatedWorkcell, rigid: RigidModel, trajectory: Trajectory, control: TipControl, joint_offsets: Floats,
    hold_s: float, start_s: float, resistance: Resistance | None,
) -> tuple[Execution, float]:  # fmt: skip
    """Run a straight motion of the tip from its start, where the arm is at rest, and hold its end.

    The true joints are the encoders' plus the offsets (6,), rad. Returns its records, and the tip's largest deviation
    from the reference by the encoders, mm.

    Raises:
        InputError: No time step carries the stiffness at some pose of the path.
    """
    model, tip_m = rigid.kinematics, rigid.tip_m
    controller = _controller(rigid, control, trajectory.q)
    reference = reference_of(model, tip_m, trajectory, controller.dt, hold_s)
    recorder = Recorder(workcell, reference.q, joint_offsets, controller.dt, start_s)
    done = run(workcell.arm, controller, reference, joint_offsets, resistance=resistance, watch=recorder.see)
    off_m = np.linalg.norm(tips(model, tip_m, done.q).position_m - reference.position_m, axis=1)
    return recorder.execution(), float(to_mm(off_m.max()))


def _controller(rigid: RigidModel, control: TipControl, q_path: Floats) -> Controller:
    if control == "position":
        return Motors()
    if control == "admittance":
        return Admittance(rigid.kinematics, rigid.tip_m, VirtualMass(), TIME_STEP_S)
    stiffness = Stiffness()
    J = tips(rigid.kinematics, rigid.tip_m, q_path).J
    dt = min(allowed_step(stiffness, row, rigid.mass_matrix(q)) for q, row in zip(q_path, J, strict=True))
    return Impedance(rigid, stiffness, dt, keep_compliance=False)


MOST_DECAY = 2.0
"""Limit of D dt / M: from there on the explicit step of the virtual mass overshoots more than it takes away."""


@dataclass(frozen=True)
class VirtualMass:
    """Virtual mass of the tip: M x'' + D x' + K x = F."""

    mass_kg: float = 1.0
    damping_ns_m: float = 63.0
    stiffness_n_m: float = 1e3


class Admittance:
    """The controller: it keeps the virtual mass's place and speed, shape (3,) each, m and m/s, base frame."""

    def __init__(self, model: UrModel, tip_m: float, virtual: VirtualMass, dt: float) -> None:
        decay = virtual.damping_ns_m * dt / virtual.mass_kg
        if not decay < MOST_DECAY:
            refuse(f"D dt / M = {decay:.2f} would diverge", "admittance", f"below {MOST_DECAY:g}", "control_unstable")
        self.dt = dt
        self._model, self._tip_m, self._virtual = model, tip_m, virtual
        self._place, self._velocity = np.zeros(3), np.zeros(3)

    def act(self, measured: Measured, reference: Reference, row: int) -> Goals:
        """Goals of the position motors for the next step."""
        of = self._virtual
        pull = measured.force_n - of.damping_ns_m * self._velocity - of.stiffness_n_m * self._place
        self._velocity = self._velocity + self.dt / of.mass_kg * pull
        self._place = self._place + self.dt * self._velocity  # semi-implicit: the new speed
        J = tips(self._model, self._tip_m, measured.q[None]).J[0]
        moved = np.linalg.solve(J, np.concatenate([self._place, np.zeros(3)]))  # the tip yields without a rotation
        speed = np.linalg.solve(J, np.concatenate([self._velocity, np.zeros(3)]))
        return Goals(reference.q[row] + moved, reference.speed[row] + speed)


REFRESH_STEPS = 5
"""Between two evaluations of the tip's mass and the damping that follows from it: the pose changes slowly."""
CONTACT_N = 0.5
"""A force at the tip above which there is contact."""


class Impedance:
    """The controller: it keeps the integral of its error (in contact, unless compliance is kept) and its damping."""

    def __init__(self, model: RigidModel, stiffness: Stiffness, dt: float, *, keep_compliance: bool = True) -> None:
        self.dt, self._model, self._stiffness, self._keep_compliance = dt, model, stiffness, keep_compliance
        self._integral, self._D, self._steps = np.zeros(6), np.zeros((6, 6)), 0

    def act(self, measured: Measured, reference: Reference, row: int) -> Floats:
        """Torques (6,), N m, for the next step; a stiffness that would diverge at this pose is refused."""
        tip = tips(self._model.kinematics, self._model.tip_m, measured.q[None])
        J = tip.J[0]
        if self._steps % REFRESH_STEPS == 0:
            M = self._model.mass_matrix(measured.q)
            refuse_unstable(self._stiffness, J, M, self.dt)
            self._D = damping(self._stiffness, J, M)
        self._steps += 1
        turn = rotation_error(reference.R_base_tip[row], tip.R_base_tip[0])
        error = np.concatenate([reference.position_m[row] - tip.position_m[0], turn])
        if not (self._keep_compliance and np.linalg.norm(measured.force_n) > CONTACT_N):
            self._integral = self._integral + self.dt * error  # of position (m s) and rotation (rad s)
        spring = self._stiffness.diagonal * (error + self._stiffness.integral_per_s * self._integral)
        wrench = spring + self._D @ (reference.twist[row] - J @ measured.speed)  # damps what differs from the motion
        feedforward = self._model.inverse_dynamics(measured.q, measured.speed, reference.acceleration[row])
        return np.asarray(feedforward + J.T @ wrench)


def rotation_error(R_reference: Floats, R: Floats) -> Floats:
    """From R to the reference, shape (3,), rad: sin(angle) along the axis, half the sum of r_i x r_reference_i.

    Source: Luh, Walker, Paul 1980, "Resolved-acceleration control of mechanical manipulators".
    """
    skewed = R_reference @ R.T
    return 0.5 * np.array([skewed[2, 1] - skewed[1, 2], skewed[0, 2] - skewed[2, 0], skewed[1, 0] - skewed[0, 1]])


MOST_RATIO = 0.8
"""Limit of sqrt(K / m) dt over every mode of the tip: five sixths of where the loop diverges."""
STEPS_S = (RECORD_S / 17, RECORD_S / 34, RECORD_S / 68)
"""Time steps of a controller, the longest first: about 1, .5 and .25 ms, and records fall on steps."""


@dataclass(frozen=True)
class Stiffness:
    """A spring at the tip; what is left of an error is gone after so many times 1/K_i, and 0 keeps the compliance."""

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
    modes = root[:, None] * U  # K^1/2 U
    w = np.sqrt(np.maximum(squares, SLOWEST**2 * squares[-1]))
    return np.asarray(2.0 * stiffness.damping_ratio * (modes / w) @ modes.T)


def stability_ratio(stiffness: Stiffness, J: Floats, M: Floats, dt: float) -> float:
    """sqrt(K / m) dt of the fastest mode: the largest eigenvalue of Lambda^-1 K = J M^-1 J' K."""
    root = np.sqrt(stiffness.diagonal)[:, None] * J  # symmetric form: the same eigenvalues
    fastest = np.linalg.eigvalsh(root @ np.linalg.solve(M, root.T))[-1]
    return float(np.sqrt(fastest) * dt)


def allowed_step(stiffness: Stiffness, J: Floats, M: Floats) -> float:
    """The longest of `STEPS_S` that the stiffness is stable with at a pose; refused where none is."""
    stable = [dt for dt in STEPS_S if stability_ratio(stiffness, J, M, dt) < MOST_RATIO]
    if not stable:
        refuse_unstable(stiffness, J, M, STEPS_S[-1])
    return stable[0]


def refuse_unstable(stiffness: Stiffness, J: Floats, M: Floats, dt: float) -> None:
    """Refuse a stiffness that a time step, s, cannot carry at a pose: Jacobian of the tip and joint masses, (6, 6)."""
    ratio = stability_ratio(stiffness, J, M, dt)
    if not ratio < MOST_RATIO:
        what = f"a stiffness of {stiffness.translation_n_m:g} N/m at steps of {1e3 * dt:g} ms would diverge"
        allowed = f"below {MOST_RATIO}: less stiffness or a shorter step"
        refuse(f"{what}: sqrt(K/m) dt = {ratio:.2f}", "impedance", allowed, "control_unstable")


@dataclass(frozen=True, eq=False)
class Reference:
    """One row a step of the controller: q (n, 6), rad, its derivatives; the tip (n, 3), base frame, its twist."""

    model: UrModel
    tip_m: float
    q: Floats
    speed: Floats  # shape (n, 6), rad/s
    acceleration: Floats  # shape (n, 6), rad/s^2
    position_m: Floats  # shape (n, 3), of the tip, base frame
    R_base_tip: Floats  # shape (n, 3, 3)
    twist: Floats


def reference_of(model: UrModel, tip_m: float, trajectory: Trajectory, dt: float, hold_s: float = 0.0) -> Reference:
    """A trajectory at every step, smooth between its samples (cubic spline, at rest at both ends), then constant."""
    moving = int(np.ceil(trajectory.duration_s / dt)) + 1
    times = np.minimum(dt * np.arange(moving + round(hold_s / dt)), trajectory.duration_s)
    q, speed = np.tile(trajectory.q[0], (len(times), 1)), np.zeros((len(times), 6))
    acceleration = speed
    if len(trajectory.q) > 1:
        spline = CubicSpline(trajectory.times_s, trajectory.q, bc_type="clamped")
        at_rest = (times >= trajectory.duration_s)[:, None]  # the spline's slopes there are rounding
        q, speed, acceleration = spline(times), *(np.where(at_rest, 0.0, spline(times, order)) for order in (1, 2))
    tip = tips(model, tip_m, q)
    twist = (tip.J @ speed[..., None])[..., 0]
    return Reference(model, tip_m, q, speed, acceleration, tip.position_m, tip.R_base_tip, twist)


class Tip(NamedTuple):
    """The tip (n, 3) at n configurations, base frame, and the flange's axes (n, 3, 3), z to the tip."""

    position_m: Floats  # shape (n, 3)
    R_base_tip: Floats  # shape (n, 3, 3), the flange's axes; z points along the needle to its tip
    J: Floats  # shape (n, 6, 6): tip velocity (m/s), then angular velocity (rad/s), from joint speeds (rad/s)


def tips(model: UrModel, tip_m: float, q: Floats) -> Tip:
    """The tip, so far from the flange along its z, and its Jacobian, at joints (n, 6), rad."""
    frames, J = np.empty((len(q), 7, 4, 4)), np.empty((len(q), 6, 6))
    link_frames(model.lengths, np.array(q, order="C"), frames)
    jacobians(frames, J)
    flange = frames[:, 6]
    arm_m = tip_m * flange[:, :3, 2]
    # v_tip = v_flange + w x r
    J[:, :3] = J[:, :3] / MM_PER_M - skew(arm_m) @ J[:, 3:]
    return Tip(flange[:, :3, 3] / MM_PER_M + arm_m, flange[:, :3, :3], J)


TIP_LINK = "needle"


class Measured(NamedTuple):
    """A controller's measurements at one step: encoders (6,), rad, rad/s; contact force at the tip (3,), base frame."""

    q: Floats  # shape (6,), rad, what the encoders say
    speed: Floats  # shape (6,), rad/s
    force_n: Floats  # shape (3,), of contact at the tip, base frame


class Goals(NamedTuple):
    """Goals of the position motors: encoders (6,), rad, and rad/s."""

    q: Floats  # shape (6,), rad, encoders
    speed: Floats  # shape (6,), rad/s


class Controller(Protocol):
    """Moves the joints from one step to the next."""

    dt: float

    def act(self, measured: Measured, reference: Reference, row: int) -> Floats | Goals:
        """Joint torques (6,), N m, for the next step, the motors off, or goals of these."""


class Push(NamedTuple):
    """A force (3,) on the rigid needle, and the point (3,) of its shaft where it acts, base frame."""

    force_n: Floats  # shape (3,), base frame
    point_m: Floats  # shape (3,), base frame


Resistance = Callable[[Tip], Sequence[Push]]
"""Forces of tissue on the needle for the present tip (one row). It may remember where the tip was."""


@dataclass(frozen=True, eq=False)
class Run:
    """Records of a run, a row a step: encoders (n, 6), rad, at its start, and the force (n, 3) of the step before."""

    dt: float
    q: Floats  # shape (n, 6), rad, encoders
    tip_m: Floats  # shape (n, 3), true tip, base frame
    force_n: Floats  # shape (n, 3), N, on the tip
    stopped: bool


Stop = Callable[[Measured], bool]


def run(
    arm: Arm, controller: Controller, reference: Reference, joint_offsets: Floats, *,
    resistance: Resistance | None = None, stop: Stop | None = None, watch: Callable[[int], None] | None = None,
) -> Run:  # fmt: skip
    """Follow a reference from where the arm is, by the controller's step; ``watch`` is called after each row's step."""
    pybullet.setPhysicsEngineParameter(fixedTimeStep=controller.dt, physicsClientId=arm.client)
    arm.release()  # motors that hold on would work against torques; goals switch them on again
    q, places, forces = [], [], []
    for row in range(len(reference.q)):
        state = arm.state()
        tip = tips(reference.model, reference.tip_m, state.q[None])
        force = contact_force(arm, TIP_LINK)
        for push in () if resistance is None else resistance(tip):
            arm.push(TIP_LINK, push.force_n, push.point_m)
            force = force + push.force_n
        measured = Measured(state.q - joint_offsets, state.speed, force)
        q.append(measured.q)
        places.append(tip.position_m[0])
        forces.append(force)
        if stop is not None and stop(measured):
            break
        action = controller.act(measured, reference, row)
        if isinstance(action, Goals):
            arm.command(action.q + joint_offsets, action.speed)  # encoders to true joints
        else:
            arm.torque(action)
        step(arm.client)
        if watch is not None:
            watch(row)
    return Run(controller.dt, np.array(q), np.array(places), np.array(forces), len(q) < len(reference.q))


class Motors:
    """A controller that passes the reference's joints to the motors, whatever is measured."""

    dt = TIME_STEP_S

    def act(self, measured: Measured, reference: Reference, row: int) -> Goals:
        """Goals of the next step."""
        return Goals(reference.q[row], reference.speed[row])


@dataclass(frozen=True)
class RigidModel:
    """The controller's model of the arm's masses; it never moves.

    PyBullet evaluates inverse dynamics as if the body's base were not rotated in the world: gravity enters in world
    axes and leaves in base axes. The model therefore has a world of its own, its URDF base unrotated, under a gravity
    that was rotated instead: g_urdf = R_urdf_base g_base.
    """

    kinematics: UrModel
    tip_m: float
    arm: Arm

    def inverse_dynamics(self, q: Floats, speed: Floats, acceleration: Floats) -> Floats:
        """Torques that give accelerations: tau = M(q) qdd + c(q, qd) + g(q); all of shape (6,), rad, s, N m."""
        motion = q.tolist(), speed.tolist(), acceleration.tolist()
        return np.array(pybullet.calculateInverseDynamics(self.arm.body, *motion, physicsClientId=self.arm.client))

    def mass_matrix(self, q: Floats) -> Floats:
        """M(q), shape (6, 6), kg m^2."""
        return np.array(pybullet.calculateMassMatrix(self.arm.body, q.tolist(), physicsClientId=self.arm.client))


@contextmanager
def rigid_model(model: UrModel, tool: Tool, down_base: Floats) -> Iterator[RigidModel]:
    """Open the model of an arm, and close it again.

    ``down_base`` (3,) is the unit vector of gravity in the controller's base frame: any mount is a direction.

    Raises:
        InputError: There is no body of that arm.
    """
    T_base_root = model_urdf(model).T_base_root
    with physics_client(down=T_base_root[:3, :3].T @ down_base) as client:
        # T_world_urdf = T_world_base T_base_urdf = identity
        arm = load_arm(client, model, tool, np.asarray(np.linalg.inv(T_base_root), np.float64))
        yield RigidModel(model, tool.needle_length_mm / MM_PER_M, arm)
