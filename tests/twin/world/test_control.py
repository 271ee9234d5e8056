"""The tip under control: dynamics at any mount, springs that yield by F / K, and what is refused before it diverges."""

import numpy as np
import pytest
from control_world import (
    FRICTION_NM,
    TIP_M,
    UR3,
    along_needle,
    bench,
    compliance,
    follow,
    free_space,
    hand_over,
    impedance,
    press,
    pressed_by,
    release,
    true_tip,
)
from refusals import refused

from puncture_twin.planning.geometry.rigid import exp_rotation
from puncture_twin.twin.world.client import STANDARD_GRAVITY_MM_S2, pybullet
from puncture_twin.twin.world.control import (
    STEPS_S,
    Admittance,
    Motors,
    Stiffness,
    VirtualMass,
    allowed_step,
    damping,
    rotation_error,
    stability_ratio,
    tips,
)

WALL_N_M = 1e5
SIDE = np.array([1.0, 0.0, 0.0])


def potential_j(world, q, down):
    """Energy of every link's weight, J: masses and their places as PyBullet has them, no dynamics."""
    world.arm.place(q)
    energy, g = 0.0, STANDARD_GRAVITY_MM_S2 / 1000.0
    for link in range(pybullet.getNumJoints(world.arm.body, physicsClientId=world.client)):
        mass = pybullet.getDynamicsInfo(world.arm.body, link, physicsClientId=world.client)[0]
        at = pybullet.getLinkState(world.arm.body, link, computeForwardKinematics=1, physicsClientId=world.client)[0]
        energy -= mass * g * float(down @ np.array(at))
    return energy


def pose_terms(world, q):
    return tips(UR3, TIP_M, q[None]).J[0], world.model.mass_matrix(q)


@pytest.mark.parametrize("down", [[0, 0, -1.0], [1.0, 0, 0], [0, 0.6, 0.8]])
def test_an_arm_released_under_the_models_torque_does_not_move(down):
    """At 20 configurations; the simulator's forward dynamics know nothing of the model's inverse."""
    assert release(down)[0] < 1e-3


def test_pybullets_own_torque_drops_an_arm_on_its_side():
    """It takes gravity as if the base were not turned: what the model's own world cures."""
    assert release(SIDE)[1] > 10.0


@pytest.mark.parametrize("down", [SIDE, np.array([0, 0, 1.0]), np.array([0, 0.6, 0.8])])
def test_the_torque_at_rest_is_the_slope_of_the_potential_energy(down):
    """g(q) = dV/dq, by differences of masses times heights."""
    q, h = np.array([0.4, -1.1, 0.9, -0.7, 1.2, 0.3]), 1e-5
    with bench(down) as world:
        ends = ([potential_j(world, q + way * h * e, down) for e in np.eye(6)] for way in (1, -1))
        slope = np.subtract(*ends) / (2 * h)
        torque = world.model.inverse_dynamics(q, np.zeros(6), np.zeros(6))
    np.testing.assert_allclose(torque, slope, atol=1e-6)


def test_an_upright_arm_has_pybullets_torques():
    """In motion too."""
    rng = np.random.default_rng(3)
    with bench(np.array([0, 0, -1.0])) as world:
        for _ in range(5):
            q, speed, acceleration = rng.uniform(-2, 2, (3, 6))
            motion = q.tolist(), speed.tolist(), acceleration.tolist()
            own = pybullet.calculateInverseDynamics(world.arm.body, *motion, physicsClientId=world.client)
            np.testing.assert_allclose(world.model.inverse_dynamics(q, speed, acceleration), own, atol=1e-9)


def test_the_tips_jacobian_is_its_slope():
    """Place by differences; turning by the change of the axes."""
    q, h = np.array([0.4, -1.1, 0.9, -0.7, 1.2, 0.3]), 1e-6
    J = tips(UR3, TIP_M, q[None]).J[0]
    for joint, e in enumerate(np.eye(6)):
        ahead, behind = (tips(UR3, TIP_M, (q + s * h * e)[None]) for s in (1, -1))
        np.testing.assert_allclose(J[:3, joint], (ahead.position_m - behind.position_m)[0] / (2 * h), atol=1e-8)
        turn = (ahead.R_base_tip[0] - behind.R_base_tip[0]) @ tips(UR3, TIP_M, q[None]).R_base_tip[0].T / (2 * h)
        np.testing.assert_allclose(J[3:, joint], [turn[2, 1], turn[0, 2], turn[1, 0]], atol=1e-8)


def test_every_mode_of_the_tip_is_damped_alike():
    """The modes of Lambda x'' + D x' + K x = 0 are pairs -zeta w +- i w sqrt(1 - zeta^2)."""
    stiffness = Stiffness(2e4, 300.0, 0.8)
    with bench() as world:
        J, M = pose_terms(world, along_needle(60.0, 1.0, 5.0).q[0])
    inverse_mass, K, D = J @ np.linalg.inv(M) @ J.T, np.diag(stiffness.diagonal), damping(stiffness, J, M)
    assert np.linalg.eigvalsh((D + D.T) / 2)[0] > 0
    roots = np.linalg.eigvals(np.block([[np.zeros((6, 6)), np.eye(6)], [-inverse_mass @ K, -inverse_mass @ D]]))
    np.testing.assert_allclose(-roots.real / np.abs(roots), 0.8, rtol=1e-6)
    assert np.abs(roots).max() * 1e-3 == pytest.approx(stability_ratio(stiffness, J, M, 1e-3))


def test_a_singular_pose_is_damped_too():
    """Straight wrist: the tip cannot turn one way, and the joints' damping goes on smoothly from poses beside it."""
    with bench() as world:
        felt = []
        for q5 in (1e-3, 0.0):
            q = np.array([0.4, -1.1, 0.9, -0.7, q5, 0.3])
            J, M = pose_terms(world, q)
            felt.append(J.T @ damping(Stiffness(), J, M) @ J)
    assert np.linalg.matrix_rank(J, tol=1e-9) == 5
    assert np.isfinite(felt[1]).all() and np.linalg.eigvalsh(felt[1])[0] > -1e-9 * np.abs(felt[1]).max()
    np.testing.assert_allclose(felt[0], felt[1], atol=2e-3 * np.abs(felt[1]).max())


def test_the_rotations_error_is_its_vector_while_it_is_small(rng):
    """Beside the logarithm; a reference that is met has none."""
    R = exp_rotation(rng.normal(size=3))
    turn = 1e-3 * rng.normal(size=3)
    np.testing.assert_allclose(rotation_error(exp_rotation(turn) @ R, R), turn, atol=1e-8)
    np.testing.assert_allclose(rotation_error(R, R), 0.0, atol=1e-15)


@pytest.mark.parametrize(("ratio", "stable"), [(0.8, True), (0.95, True), (0.97, False), (1.2, False)])
def test_the_step_diverges_where_the_rule_says(ratio, stable):
    """One mode of damping .8, integrated as the simulator does: speed first, then place."""
    x, v = 1.0, 0.0
    for _ in range(2000):
        v -= ratio**2 * x + 2 * 0.8 * ratio * v
        x += v
    assert (abs(x) < 1.0) is stable


def test_a_stiffness_that_would_diverge_is_refused():
    """Before the first torque, with both numbers; at half the step it is taken, and beyond all steps refused.

    So is a virtual mass whose D dt / M is 2 and more.
    """
    with refused("control_unstable", "4.00"):
        Admittance(UR3, TIP_M, VirtualMass(damping_ns_m=4000.0), 1e-3)
    with refused("control_unstable", "50000"):
        one_step(5e4, 1e-3)
    one_step(5e4, 5e-4)
    with bench() as world:
        J, M = pose_terms(world, along_needle(60.0, 1.0, 5.0).q[0])
        assert allowed_step(Stiffness(5e4), J, M) == STEPS_S[1]
        with refused("control_unstable"):
            allowed_step(Stiffness(1e7), J, M)


def one_step(K, dt):
    with bench() as world:
        follow(world, impedance(world, K, dt=dt), along_needle(60.0, 0.1, 5.0), hold_s=0.01)


def test_masses_that_err_by_a_tenth_leave_a_hundredth_of_a_millimetre():
    """Mean .02 and largest .1 mm are allowed; without the integral the same masses cost more than either."""
    for friction in (None, FRICTION_NM):
        mean, most = free_space(10.0, friction, length_mm=4.0)
        assert mean < (0.02 if friction is None else 0.05) and most < 0.1
    factors = np.random.default_rng(1).uniform(0.9, 1.1, 20)
    with bench(factors=factors) as world:
        _, error = follow(world, impedance(world, K_i=0.0), along_needle(150.0, 4.0, 10.0), settle_s=0.3)
    assert error.mean() > 0.02


@pytest.mark.parametrize(("force_n", "direction"), [(1.0, 0), (5.0, 2)])
def test_a_force_moves_the_tip_by_f_over_k(force_n, direction):
    """Across and along the needle, within 3 %."""
    assert compliance(2e4, force_n, direction) == pytest.approx(1.0, abs=0.03)


@pytest.fixture(scope="module")
def soft_wall():
    """The spring of 1e4 N/m, driven 1 mm past a wall of 1e5 N/m."""
    return press(lambda world: impedance(world, 1e4, K_i=0.0), WALL_N_M, ahead_mm=0.5, over_mm=1.0, hold_s=0.4)


def test_a_wall_gives_back_the_series_of_both_springs(soft_wall):
    """Steady within 2 %, no peak above 1.1 of it, never lost; met where it is, not a millimetre before."""
    assert soft_wall.steady_n == pytest.approx(1e-3 / (1 / 1e4 + 1 / WALL_N_M), rel=0.02)
    assert soft_wall.peak_n < 1.1 * soft_wall.steady_n
    assert soft_wall.lost_steps == 0 and 0.0 <= soft_wall.felt_mm < 0.02


def test_position_motors_press_without_yielding(soft_wall):
    """Into the same wall by the same millimetre."""
    stiff = press(lambda world: Motors(), WALL_N_M, ahead_mm=0.5, over_mm=1.0, hold_s=0.4)
    assert stiff.steady_n > 5 * soft_wall.steady_n


def test_admittance_settles_on_a_soft_wall_and_never_on_a_rigid_one():
    """K d in series with the wall; on a rigid body it leaves and strikes again."""
    soft, rigid = (
        press(lambda world: Admittance(UR3, TIP_M, VirtualMass(), 1e-3), wall, ahead_mm=0.5, over_mm=1.0, hold_s=0.6)
        for wall in (WALL_N_M, None)
    )
    assert soft.steady_n == pytest.approx(1.0, rel=0.1)
    assert rigid.lost_steps > 100 and rigid.peak_n > 20 * soft.peak_n


def test_torques_take_over_from_motors_without_a_jump():
    """At rest: .02 mm are allowed."""
    assert 0.0 < hand_over() < 0.02


def test_the_compliance_is_kept_in_contact():
    """The integral stands still while a force is felt: the tip stays displaced; without the gate it comes back."""
    still = along_needle(60.0, 1e-3, 1.0)
    start = true_tip(still.q[-1])
    along = start.R_base_tip[0, :, 2]
    moved = {}
    for keep in (True, False):
        with bench() as world:
            controller = impedance(world, 1e4, K_i=20.0, keep=keep)
            done, _ = follow(world, controller, still, hold_s=0.4, resistance=pressed_by(-5.0 * along))
        moved[keep] = 1e3 * float((done.tip_m[-1] - start.position_m[0]) @ along)
    assert moved[True] == pytest.approx(-0.5, rel=0.03)
    assert abs(moved[False]) < 0.1
