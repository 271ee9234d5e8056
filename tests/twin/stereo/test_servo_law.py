"""One servo step: the Jacobian at the ball, straight ways, singularities, limits."""

import numpy as np
import pytest

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.twin.guidance.stereo.servo_law import (
    MIN_SIGMA,
    CarriedRod,
    ServoStop,
    StepLimits,
    ball_base,
    ball_jacobian,
    damped,
    orientation_error,
    servo_step,
    smallest_sigma,
)

MODEL = ur_model("ur3")
GOOD = np.radians([14.0, -73.0, -132.0, -55.0, 88.0, -76.0])


def rod_at(q, rod_mm=160.0):
    return CarriedRod(MODEL, rod_mm, flange_pose(MODEL, q)[:3, :3])


def test_jacobian_at_the_ball_is_the_slope_of_its_pose():
    """Against central differences of the ball's place and of the flange's turn, at random configurations."""
    rng = np.random.default_rng(1)
    for _ in range(20):
        q = rng.uniform(-np.pi, np.pi, 6)
        rod = rod_at(q)
        slope = np.empty((6, 6))
        for j, step in enumerate(1e-6 * np.eye(6)):
            slope[:3, j] = (ball_base(rod, q + step) - ball_base(rod, q - step)) / 2e-6
            slope[3:, j] = (orientation_error(rod, q - step) - orientation_error(rod, q + step)) / 2e-6
        assert np.abs(ball_jacobian(rod, q) - slope).max() < 1e-5


def test_step_moves_the_ball_straight_and_keeps_the_needle():
    """The ball arrives within 5 micrometres, never leaves the line by more, and the needle does not turn."""
    rod = rod_at(GOOD)
    move = np.array([3.0, -4.0, 2.0])
    step = servo_step(rod, GOOD, move, StepLimits())
    places = ball_base(rod, step.q_path)
    along = (places - places[0]) @ move / np.linalg.norm(move)
    aside = places - places[0] - along[:, None] * move / np.linalg.norm(move)
    assert step.stop is None
    assert not step.position_only
    assert np.linalg.norm(places[-1] - places[0] - move) < 5e-3
    assert np.linalg.norm(aside, axis=1).max() < 5e-3
    assert max(np.linalg.norm(orientation_error(rod, q)) for q in step.q_path) < 1e-4


def test_long_moves_are_cut_short():
    """A wish of 40 mm becomes a step of 10 mm in its direction."""
    rod = rod_at(GOOD)
    step = servo_step(rod, GOOD, np.array([0.0, 40.0, 0.0]), StepLimits(step_mm=10.0))
    moved = ball_base(rod, step.q_path[-1]) - ball_base(rod, GOOD)
    assert moved == pytest.approx([0.0, 10.0, 0.0], abs=5e-3)


def test_no_joint_turns_farther_than_its_limit():
    """The way ends where the fastest joint has turned as far as it may, and not before."""
    rod = rod_at(GOOD)
    step = servo_step(rod, GOOD, np.array([0.0, 9.0, 0.0]), StepLimits(joint_step_rad=0.005))
    assert np.abs(step.q_path[-1] - GOOD).max() == pytest.approx(0.005)


def test_near_the_wrist_singularity_the_position_still_arrives():
    """At q5 = 0.5 deg, where damped steps of the whole pose hardly move, small corrections arrive in 95 % of draws.

    The plain damped step of position and orientation together is the peer: its misses show that the case is hard.
    """
    rng = np.random.default_rng(2)
    ours, peer = 0, 0
    for _ in range(60):
        q = GOOD + rng.uniform(-0.2, 0.2, 6)
        q[4] = np.radians(0.5)
        rod, wish = rod_at(q), rng.normal(size=3)
        wish *= 1.5 / np.linalg.norm(wish)
        assert smallest_sigma(ball_jacobian(rod, q)) < MIN_SIGMA
        step = servo_step(rod, q, wish, StepLimits())
        assert step.stop in {None, ServoStop.SINGULAR}
        turn = np.degrees(np.linalg.norm(orientation_error(rod, step.q_path[-1])))
        assert turn <= 1.0
        ours += step.stop is None and np.linalg.norm(ball_base(rod, step.q_path[-1]) - ball_base(rod, q) - wish) < 0.05
        J = ball_jacobian(rod, q) / np.array([300.0] * 3 + [1.0] * 3)[:, None]
        goal = np.r_[wish / 300.0, 0.0, 0.0, 0.0]
        blind = q + J.T @ np.linalg.solve(J @ J.T + 0.05**2 * np.eye(6), goal)
        peer += np.linalg.norm(ball_base(rod, blind) - ball_base(rod, q) - wish) < 0.05
    assert ours >= 57
    assert peer <= 30


def test_damping_is_nothing_far_from_singular_and_bounds_the_step_near():
    """The pseudo-inverse where sigma_min is above its limit; at 0 no step is longer than goal over two dampings."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(3, 6))
    assert np.linalg.svd(J, compute_uv=False)[-1] > MIN_SIGMA
    goal = rng.normal(size=3)
    assert damped(J, goal) == pytest.approx(np.linalg.pinv(J) @ goal)
    flat = J.copy()
    flat[2] = flat[0]
    assert np.linalg.norm(damped(flat, goal)) <= np.linalg.norm(goal) / (2 * 0.05) + 1e-9


@pytest.mark.parametrize("seed", range(3))
def test_five_joints_bring_ball_and_needle_to_where_six_do(seed):
    """The paper's step, J^+ [dX; da] of 6 x 5 with the sixth joint held: da has no part about the needle."""
    rng = np.random.default_rng(seed)
    rod, start = rod_at(GOOD), GOOD + 0.03 * rng.normal(size=6)
    goal, q, six = ball_base(rod, GOOD) + rng.uniform(-8, 8, 3), start, start
    for _ in range(300):
        q = servo_step(rod, q, goal - ball_base(rod, q), StepLimits(joints=5)).q_path[-1]
        six = servo_step(rod, six, goal - ball_base(rod, six), StepLimits()).q_path[-1]
    z = flange_pose(MODEL, start)[:3, 2]  # one step is the paper's own
    J = ball_jacobian(rod, start)[:, :5] / np.repeat([300.0, 1.0], 3)[:, None]
    own = np.linalg.pinv(J) @ np.append(np.array([0.1, 0, 0]) / 300.0, np.cross(z, rod.R_base_flange[:, 2]))
    step = servo_step(rod, start, np.array([0.1, 0, 0]), StepLimits(joints=5)).q_path[-1] - start
    np.testing.assert_allclose(step, np.append(own, 0.0), atol=1e-12)
    for joints in (q, six):
        np.testing.assert_allclose(ball_base(rod, joints), goal, atol=1e-3)
        np.testing.assert_allclose(flange_pose(MODEL, joints)[:3, 2], rod.R_base_flange[:, 2], atol=1e-5)
    assert q[5] == start[5] and abs(six[5] - start[5]) > 1e-3
    np.testing.assert_allclose(q[:5], six[:5], atol=1e-5)
