"""Control of the tip: free space, static force, walls, tissue, mounts, and what is refused."""

import time
from typing import NamedTuple

import numpy as np

from benchmarks.experiment.row import Row
from benchmarks.experiment.workbench import (
    DOWN,
    FRICTION_NM,
    OUTWARD,
    TIP_M,
    UR3,
    Position,
    WithFriction,
    along_needle,
    bench,
    follow,
    impedance,
    press,
    pressed_by,
    tissue,
    true_tip,
)
from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.plant.true_needle import TissueForce
from puncture_twin.twin.world.client import pybullet, step
from puncture_twin.twin.world.control import Admittance, VirtualMass

WALL_N_M, OVER_M = 1e5, 3e-3
MOUNTS = {"table": [0, 0, -1.0], "side": [1.0, 0, 0], "carton": DOWN, "ceiling": [0, 0, 1.0]}


def release(down, count=20, seed=1):
    """The largest joint acceleration after a release under the model's torque: ours, and under PyBullet's own."""
    rng, worst = np.random.default_rng(seed), [0.0, 0.0]
    with bench(np.array(down, dtype=float)) as world:
        world.arm.release()
        for q in rng.uniform(-3.0, 3.0, (count, 6)):
            own = np.array(
                pybullet.calculateInverseDynamics(
                    world.arm.body, q.tolist(), [0.0] * 6, [0.0] * 6, physicsClientId=world.client
                )
            )
            for which, torque in enumerate((world.model.inverse_dynamics(q, np.zeros(6), np.zeros(6)), own)):
                world.arm.place(q)
                world.arm.torque(torque)
                step(world.client)
                worst[which] = max(worst[which], float(np.abs(world.arm.state().speed).max()) * 240.0)
    return worst


def free_space(speed_mm_s, friction=None, seed=1, length_mm=20.0):
    """Mean and largest tip error of an insertion with true masses 10 % off, mm."""
    factors = np.random.default_rng(seed).uniform(0.9, 1.1, 20)
    with bench(factors=factors) as world:
        controller = impedance(world)
        controller = controller if friction is None else WithFriction(controller, friction)
        _, error = follow(world, controller, along_needle(150.0, length_mm, speed_mm_s), settle_s=0.5)
    return float(error.mean()), float(error.max())


def compliance(K, force_n, direction):
    """Displacement over F / K under a force at rest."""
    still = along_needle(60.0, 1e-3, 1.0)
    start = true_tip(still.q[-1])
    across = start.R_base_tip[0, :, direction]
    with bench() as world:
        controller = impedance(world, K, K_i=0.0)
        done, _ = follow(world, controller, still, hold_s=0.6, resistance=pressed_by(force_n * across))
    return float((done.tip_m[-1] - start.position_m[0]) @ across * K / force_n)


class Inserted(NamedTuple):
    """The largest and the mean tip error of an insertion, mm, its CPU seconds a second, and what pressed on it, N."""

    most_mm: float
    mean_mm: float
    cost: float
    felt: TissueForce


def through_layers(speed_mm_s=10.0):
    """An insertion through layers, with the bevel's lateral force."""
    with bench() as world:
        trajectory = along_needle(60.0, 40.0, speed_mm_s)
        entry = 1e3 * true_tip(trajectory.q[0]).position_m[0] - 2.0 * OUTWARD
        pressing, start = tissue(entry, -OUTWARD), time.process_time()
        done, error = follow(world, impedance(world), trajectory, hold_s=0.2, resistance=pressing)
        cost = (time.process_time() - start) / (done.dt * len(done.q))
    return Inserted(float(error.max()), float(error.mean()), cost, pressing.greatest)


def hand_over():
    """How far the tip moves when torques take over from motors at rest, mm."""
    trajectory = along_needle(60.0, 1e-3, 1.0)
    with bench() as world:
        held, _ = follow(world, Position(), trajectory, hold_s=0.5)
        taken, _ = follow(world, impedance(world), trajectory, hold_s=0.3, place=False)
    return 1e3 * float(np.linalg.norm(taken.tip_m - held.tip_m[-1], axis=1).max())


def refusal(K, dt):
    """What is said of a stiffness at a step; empty where it is taken."""
    with bench() as world:
        try:
            follow(world, impedance(world, K, dt=dt), along_needle(60.0, 0.1, 5.0), hold_s=0.01)
        except InputError as error:
            return str(error)
    return ""


def wall_rows():
    """The wall of 1e5 N/m and the rigid one, by every control."""
    found = [shown("PyBullet's position motors into the same wall", _forces(press(lambda world: Position(), WALL_N_M)))]
    for K in (1e4, 2e4):
        pressed = press(lambda world, K=K: impedance(world, K, K_i=0.0), WALL_N_M)
        series = OVER_M / (1 / K + 1 / WALL_N_M)
        name = f"wall of 1e5 N/m, K {K:g} N/m"
        found += [
            Row.between(f"{name}: steady over the series value", pressed.steady_n / series, 0.98, 1.02),
            Row.at_most(f"{name}: peak over steady", pressed.peak_n / pressed.steady_n, 1.1),
            Row.at_most(f"{name}: steps without contact after the first", pressed.lost_steps, 0),
            Row.at_most(f"{name}: felt so deep behind its face, mm", abs(pressed.felt_mm), 0.02),
        ]
    found.append(
        shown("the same with K 1e3 N/m", _forces(press(lambda world: impedance(world, 1e3, K_i=0.0), WALL_N_M)))
    )
    for name, wall in (("rigid", None), ("1e5 N/m", WALL_N_M)):
        pressed = press(lambda world: Admittance(UR3, TIP_M, VirtualMass(), 1e-3), wall)
        found.append(shown(f"admittance M 1, D 63, K 1e3, wall {name}", _forces(pressed)))
    return found


def shown(what, value):
    """A figure of which nothing is demanded."""
    return Row(what, value, "", True)


def _forces(pressed):
    return f"{pressed.steady_n:.3g} N, peak {pressed.peak_n:.3g}, lost {pressed.lost_steps}"


def rows() -> list[Row]:
    """Every demand on the control of the tip."""
    found = []
    for name, down in MOUNTS.items():
        ours, own = release(down)
        found.append(Row.at_most(f"released at 20 configurations, {name}: largest acceleration, rad/s2", ours, 1e-3))
        found.append(shown(f"the same by PyBullet's own, {name}", f"{own:.3g} rad/s2"))
    for speed in (5.0, 10.0):
        mean, most = free_space(speed)
        found.append(Row.at_most(f"free space, {speed:g} mm/s, masses +-10 %: mean error, mm", mean, 0.02))
        found.append(Row.at_most(f"free space, {speed:g} mm/s, masses +-10 %: largest error, mm", most, 0.1))
    found.append(
        Row.at_most("the same, friction .3 / .05 N m: largest error, mm", free_space(10.0, FRICTION_NM)[1], 0.1)
    )
    for K in (1e3, 2e4):
        for force_n, direction in ((1.0, 0), (5.0, 2)):
            axis = "along" if direction == 2 else "across"
            value = compliance(K, force_n, direction)
            found.append(Row.between(f"displacement over F / K, {force_n:g} N {axis}, K {K:g}", value, 0.97, 1.03))
    found += wall_rows()
    for speed in (5.0, 10.0):
        done = through_layers(speed)
        forces = f"{done.felt.along_n:.3g} N along, {done.felt.across_n:.2g} across"
        what = f"insertion at {speed:g} mm/s through layers, {forces}"
        found += [
            Row.at_most(f"{what}: largest error, mm", done.most_mm, 0.15),
            shown("its mean error, mm", f"{done.mean_mm:.3g} mm"),
            Row.at_most("its CPU seconds a second", done.cost, 1.0),
        ]
    found += [
        Row.at_most("hand-over from motors to torques, mm", hand_over(), 0.02),
    ]
    said = refusal(5e4, 1e-3)
    found.append(Row("K 5e4 N/m at 1 ms", "refused" if "would diverge" in said else "taken", "refused", bool(said)))
    found.append(Row("K 5e4 N/m at .5 ms", refusal(5e4, 5e-4) or "taken", "taken", not refusal(5e4, 5e-4)))
    return found
