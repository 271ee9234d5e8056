"""A UR3 at the carton of Chen et al. 2019, alone with a wall or a weight at its needle's tip, and what is measured."""

from contextlib import contextmanager
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.geometry.rigid import frame_about, pose
from puncture_twin.planning.motion.follow import Rates, time_law
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory
from puncture_twin.planning.registration.fits import fit_rigid
from puncture_twin.twin.world.arm import load_arm
from puncture_twin.twin.world.client import physics_client, pybullet, step
from puncture_twin.twin.world.control import Impedance, Motors, Push, Stiffness, reference_of, rigid_model, run, tips
from puncture_twin.twin.world.workcell import load_box

UR3 = ur_model("ur3")
TOOL = Tool(401.0, 250.0, 2.0, 30.0)
TIP_M = 0.401
HOME = np.radians([0, -90, -90, -90, 90, 0.0])
MARKERS_CT = np.array([[10.0, 20, 147], [110, 120, 147], [60, -10, 80]])
TOUCHED = np.array([[417.67, -291.23, 534.59], [557.74, -272.83, 534.57], [423.48, -231.41, 604.06]])
T_BASE_CT = fit_rigid(MARKERS_CT, TOUCHED)
THETA, BETA = np.radians([18.0, 232.0])
OUTWARD = T_BASE_CT[:3, :3] @ [np.sin(THETA) * np.cos(BETA), np.sin(THETA) * np.sin(BETA), np.cos(THETA)]
TARGET = T_BASE_CT[:3, :3] @ [50.0, 130, 63] + T_BASE_CT[:3, 3]
DOWN = -T_BASE_CT[:3, 2]
EXACT = np.zeros(6)
FRICTION_NM = np.array([0.3, 0.3, 0.15, 0.05, 0.05, 0.05])


def nearest(T_base_flange, q):
    found = nearest_within_limits(UR3, inverse(UR3, T_base_flange)[0], q)
    found = found[~np.isnan(found).any(axis=1)]
    return found[np.argmin(np.abs(found - q).max(axis=1))]


def along_needle(start_mm, length_mm, speed_mm_s):
    """The needle moved in from a distance to the target, from rest to rest."""
    law = time_law(length_mm, Rates(speed_mm_s, 100.0, 1000.0))
    times = np.unique(np.append(np.arange(0.0, law.duration_s, SAMPLE_S), law.duration_s))
    q = [nearest(flange_poses(TARGET, OUTWARD, TIP_M * 1e3 + start_mm)[0], HOME)]
    for distance in start_mm - law.travelled(times):
        q.append(nearest(flange_poses(TARGET, OUTWARD, TIP_M * 1e3 + distance)[0], q[-1]))
    return Trajectory(times, np.array(q[1:]))


class WithFriction:
    """A controller whose torques Coulomb friction (6,), N m, works against, blurred below 2 mrad/s."""

    def __init__(self, controller, friction_nm):
        self.dt, self._controller, self._friction = controller.dt, controller, friction_nm

    def act(self, measured, reference, row):
        action = self._controller.act(measured, reference, row)
        return action - self._friction * np.clip(measured.speed / 2e-3, -1, 1)


class Bench(NamedTuple):
    """An open world with the arm, and the controller's model of it."""

    client: int
    arm: object
    model: object


@contextmanager
def bench(down=DOWN, factors=None):
    """Open it; the true masses are the model's times some factors, one a link."""
    with physics_client(down) as client, rigid_model(UR3, TOOL, down) as model:
        arm = load_arm(client, UR3, TOOL)
        for link in range(-1, -1 if factors is None else pybullet.getNumJoints(arm.body, physicsClientId=client)):
            mass, _, inertia = pybullet.getDynamicsInfo(arm.body, link, physicsClientId=client)[:3]
            scaled = {"mass": mass * factors[link], "localInertiaDiagonal": [one * factors[link] for one in inertia]}
            pybullet.changeDynamics(arm.body, link, **scaled, physicsClientId=client)
        yield Bench(client, arm, model)


def true_tip(q):
    return tips(UR3, TIP_M, q[None])


def follow(bench, controller, trajectory, *, settle_s=0.0, hold_s=0.5, resistance=None, place=True):
    """Rest at the trajectory's start, then run it; the run, and the tip's error of every row after the rest, mm."""
    if place:
        bench.arm.place(trajectory.q[0])
    if settle_s > 0:
        rest = reference_of(UR3, TIP_M, Trajectory(np.zeros(1), trajectory.q[:1]), controller.dt, settle_s)
        run(bench.arm, controller, rest, EXACT, resistance=resistance)
    reference = reference_of(UR3, TIP_M, trajectory, controller.dt, hold_s)
    done = run(bench.arm, controller, reference, EXACT, resistance=resistance)
    return done, 1e3 * np.linalg.norm(done.tip_m - reference.position_m[: len(done.tip_m)], axis=1)


def impedance(bench, K=2e4, K_i=5.0, dt=5e-4, keep=False):
    return Impedance(bench.model, Stiffness(K, integral_per_s=K_i), dt, keep_compliance=keep)


class Pressed(NamedTuple):
    """What a wall felt."""

    times_s: np.ndarray
    force_n: np.ndarray
    steady_n: float
    peak_n: float
    lost_steps: int
    felt_mm: float
    """How deep in the wall the tip was when it was first felt."""


def press(controller_of, wall_n_m=None, *, ahead_mm=2.0, over_mm=3.0, speed_mm_s=5.0, hold_s=1.0):
    """Run the needle square onto a wall and on; the wall is rigid where it has no stiffness."""
    trajectory = along_needle(60.0, ahead_mm + over_mm, speed_mm_s)
    with bench() as world:
        face, into = TARGET + (60.0 - ahead_mm) * OUTWARD, -OUTWARD
        wall = load_box(world.client, np.array([200.0, 200, 40]), pose(frame_about(into), face + 20.0 * into))
        if wall_n_m is not None:
            soft = {"contactStiffness": wall_n_m, "contactDamping": 100.0}
            pybullet.changeDynamics(wall, -1, **soft, physicsClientId=world.client)
        done, _ = follow(world, controller_of(world), trajectory, hold_s=hold_s)
    force = np.linalg.norm(done.force_n, axis=1)
    first = int(np.argmax(force > 0))
    steady = float(force[-round(0.2 / done.dt) :].mean())
    depth = float((1e3 * done.tip_m[first] - face) @ into)
    times = done.dt * np.arange(len(force))
    return Pressed(times, force, steady, float(force.max()), int((force[first:] == 0).sum()), depth)


def pressed_by(force_n):
    return lambda tip: [Push(force_n, tip.position_m[0])]


def release(down, count=20, seed=1):
    """The largest joint acceleration after a release under the model's torque: ours, and under PyBullet's own."""
    rng, worst = np.random.default_rng(seed), [0.0, 0.0]
    with bench(np.array(down, dtype=float)) as world:
        world.arm.release()
        for q in rng.uniform(-3.0, 3.0, (count, 6)):
            rest = q.tolist(), [0.0] * 6, [0.0] * 6
            own = np.array(pybullet.calculateInverseDynamics(world.arm.body, *rest, physicsClientId=world.client))
            for which, torque in enumerate((world.model.inverse_dynamics(q, np.zeros(6), np.zeros(6)), own)):
                world.arm.place(q)
                world.arm.torque(torque)
                step(world.client)
                worst[which] = max(worst[which], float(np.abs(world.arm.state().speed).max()) * 240.0)
    return worst


def free_space(speed_mm_s, friction=None, seed=1, length_mm=20.0):
    factors = np.random.default_rng(seed).uniform(0.9, 1.1, 20)
    with bench(factors=factors) as world:
        controller = impedance(world)
        controller = controller if friction is None else WithFriction(controller, friction)
        _, error = follow(world, controller, along_needle(150.0, length_mm, speed_mm_s), settle_s=0.5)
    return float(error.mean()), float(error.max())


def compliance(K, force_n, direction):
    still = along_needle(60.0, 1e-3, 1.0)
    start = true_tip(still.q[-1])
    across = start.R_base_tip[0, :, direction]
    with bench() as world:
        controller = impedance(world, K, K_i=0.0)
        done, _ = follow(world, controller, still, hold_s=0.6, resistance=pressed_by(force_n * across))
    return float((done.tip_m[-1] - start.position_m[0]) @ across * K / force_n)


def hand_over():
    """How far the tip moves when torques take over from motors at rest, mm."""
    trajectory = along_needle(60.0, 1e-3, 1.0)
    with bench() as world:
        held, _ = follow(world, Motors(), trajectory, hold_s=0.5)
        taken, _ = follow(world, impedance(world), trajectory, hold_s=0.3, place=False)
    return 1e3 * float(np.linalg.norm(taken.tip_m - held.tip_m[-1], axis=1).max())
