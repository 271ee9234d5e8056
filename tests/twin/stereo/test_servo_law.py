"""The servo: one step, singularities, limits; the loop with an arm that is off, every reason to stop; the mapping."""

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused
from scipy.spatial.transform import Rotation
from servo_world import CASE, HELD, NoContacts, start_configurations

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.collision.bodies import Contact, FirstContact
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.registration.fits import fit_rigid, fit_triad
from puncture_twin.planning.registration.registration import leverage
from puncture_twin.twin.guidance.stereo.camera_calibration import Points
from puncture_twin.twin.guidance.stereo.servo_law import (
    MIN_SIGMA,
    CarriedRod,
    Lost,
    Seen,
    ServoStop,
    StepLimits,
    Task,
    ball_base,
    ball_jacobian,
    damped,
    map_head,
    orientation_error,
    path_contact,
    servo,
    servo_step,
    smallest_sigma,
)
from puncture_twin.twin.plant.truth import draw_true_arm

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


def test_long_moves_and_turns_are_cut_short():
    """A wish of 40 mm becomes a step of 10 mm in its direction; or ends where the fastest joint may turn no farther."""
    rod = rod_at(GOOD)
    step = servo_step(rod, GOOD, np.array([0.0, 40.0, 0.0]), StepLimits(step_mm=10.0))
    moved = ball_base(rod, step.q_path[-1]) - ball_base(rod, GOOD)
    assert moved == pytest.approx([0.0, 10.0, 0.0], abs=5e-3)
    step = servo_step(rod, GOOD, np.array([0.0, 9.0, 0.0]), StepLimits(joint_step_rad=0.005))
    assert np.abs(step.q_path[-1] - GOOD).max() == pytest.approx(0.005)


def test_near_the_wrist_singularity_the_position_still_arrives():
    """At q5 = 0.5 deg, where damped steps of the whole pose hardly move, small corrections arrive in 95 % of draws."""
    rng = np.random.default_rng(2)
    arrived = 0
    for _ in range(60):
        q = GOOD + rng.uniform(-0.2, 0.2, 6)
        q[4] = np.radians(0.5)
        rod, wish = rod_at(q), rng.normal(size=3)
        wish *= 1.5 / np.linalg.norm(wish)
        assert smallest_sigma(ball_jacobian(rod, q)) < MIN_SIGMA
        step = servo_step(rod, q, wish, StepLimits())
        assert step.stop in {None, ServoStop.SINGULAR}
        assert np.degrees(np.linalg.norm(orientation_error(rod, step.q_path[-1]))) <= 1.0
        off = np.linalg.norm(ball_base(rod, step.q_path[-1]) - ball_base(rod, q) - wish)
        arrived += step.stop is None and off < 0.05
    assert arrived >= 57


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


Q_START = start_configurations()[12]
T_BASE_C = np.eye(4)
T_BASE_C[:3, :3] = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
T_BASE_C[:3, 3] = [300.0, 20.0, 100.0]
TARGET_C = (ball_base(HELD, Q_START) - T_BASE_C[:3, 3]) @ T_BASE_C[:3, :3]


class Touches(NoContacts):
    """A judge who sees a contact on every way."""

    def first_contact(self, q_path, *, needle_may_touch_patient):
        return FirstContact(0, Contact("needle", "table"))


def off(**keys):
    """An arm whose lengths are off by .3 mm, and what else is stated."""
    exact = {"link_mm": 0.3, "twist_deg": 0.0, "joint_deg": 0.0, "repeatability_deg": 0.0}
    return ArmErrors(**{**exact, **keys})


class Twin:
    """A true arm in C, with eyes of a given noise; counts its looks and drives."""

    def __init__(self, errors, noise_mm=0.0, seed=0, T_base_c=T_BASE_C):
        self.rng = np.random.default_rng(seed)
        self.arm = draw_true_arm(HELD.model, errors, self.rng)
        self.q, self.noise, self.T = Q_START, noise_mm, T_base_c
        self.looks, self.drives = 0, 0

    def ball(self, q_true):
        flange = self.arm.flange_pose(q_true)
        return (flange[:3, 3] + HELD.rod_mm * flange[:3, 2] - self.T[:3, 3]) @ self.T[:3, :3]

    def look(self, q_command):
        self.looks += 1
        return Seen(self.ball(self.q) + self.rng.normal(0.0, self.noise, 3), TARGET_C, self.noise**2 * np.eye(3))

    def move_jp(self, q_command):
        self.drives += 1
        self.q = self.arm.settle(q_command, self.q, self.rng)


def task(**changes):
    usual = Task(HELD, T_BASE_C, tolerance_mm=0.1, max_steps=10, looks=3, limits=StepLimits(), checker=NoContacts())
    return replace(usual, **changes)


def run(twin, **changes):
    return servo(task(**changes), Q_START, twin.look, twin)


@pytest.mark.parametrize("seed", range(4))
def test_it_takes_the_arms_own_error_out(seed):
    """An arm that is millimetres off ends within the tolerance, play and all; the target is never told to the arm."""
    twin = Twin(
        off(twist_deg=0.02, joint_deg=0.05, backlash_deg=0.02, repeatability_deg=0.003), noise_mm=0.01, seed=seed
    )
    done = run(twin)
    before, after = (np.linalg.norm(twin.ball(q) - TARGET_C) for q in (Q_START, twin.q))
    assert done.stop is ServoStop.CONVERGED
    assert after < 0.1 + 4 * 0.01 < before
    assert done.steps <= 4
    assert len(done.errors_mm) == done.steps + 1
    assert done.errors_mm[-1] <= 0.1


def test_a_perfect_arm_does_not_move_nor_one_whose_way_touches_something():
    twin = Twin(off(link_mm=0.0))
    done = run(twin)
    assert (done.stop, done.steps, twin.drives) == (ServoStop.CONVERGED, 0, 0)
    twin = Twin(off())
    done = run(twin, checker=Touches())
    assert (done.stop, twin.drives, done.detail) == (ServoStop.CONTACT, 0, "needle and table")


def test_a_ball_that_is_not_seen_is_lost_and_one_missed_look_is_tried_again():
    twin, looks, outcomes = Twin(off()), [], iter([Lost("a fly")])

    def blind(q_command):
        looks.append(q_command)
        return Lost("camera 2: too few edges")

    done = servo(task(looks=4), Q_START, blind, twin)
    assert (done.stop, twin.drives, len(looks)) == (ServoStop.LOST_BALL, 0, 4)
    assert done.detail == "camera 2: too few edges"
    assert np.array_equal(done.q_command, Q_START)
    again = servo(task(), Q_START, lambda q_command: next(outcomes, None) or twin.look(q_command), twin)
    assert again.stop is ServoStop.CONVERGED


def test_a_wrong_calibration_diverges():
    """C turned by 150 deg against what the robot believes: two steps that make it worse end it, still near."""
    wrong = T_BASE_C.copy()
    wrong[:3, :3] = wrong[:3, :3] @ Rotation.from_euler("z", 150, degrees=True).as_matrix()
    twin = Twin(off(link_mm=0.0), T_base_c=wrong)
    target = twin.ball(Q_START) + np.array([1.0, 0.5, 0.0])
    done = servo(task(), Q_START, lambda command: Seen(twin.ball(twin.q), target, np.eye(3)), twin)
    assert done.stop is ServoStop.DIVERGING
    assert done.steps == 2


def test_a_hand_that_trembles_does_not_reach_a_fine_tolerance():
    """Repeatability of .05 deg against 0.02 mm: the steps run out, and that is what it says."""
    twin = Twin(off(repeatability_deg=0.05), seed=3)
    done = run(twin, tolerance_mm=0.02, max_steps=6)
    assert (done.stop, done.steps, twin.drives) == (ServoStop.TOLERANCE_NOT_REACHED, 6, 6)


def test_a_singular_start_says_so():
    """With the wrist aligned and a long way to go the needle would turn: singular, and the arm stays."""
    twin, q = Twin(off(link_mm=0.0)), Q_START.copy()
    q[4] = np.radians(0.3)
    done = servo(task(), q, lambda command: Seen(np.zeros(3), np.full(3, 30.0), np.eye(3)), twin)
    assert (done.stop, twin.drives) == (ServoStop.SINGULAR, 0)


def test_joint_limit_is_a_reason_of_its_own():
    """Joint 1 stands just inside its range: a target on one side is beyond it, on the other side it is reached."""
    q = Q_START.copy()
    q[0] = HELD.model.joint_limits[0, 1] - 1e-4
    rod = HELD._replace(R_base_flange=flange_pose(HELD.model, q)[:3, :3])
    ends = {}
    for sign in (1.0, -1.0):
        across = sign * 2.0 * np.array([-np.sin(q[0]), np.cos(q[0]), 0.0])
        goal = (ball_base(rod, q) + across - T_BASE_C[:3, 3]) @ T_BASE_C[:3, :3]
        twin = Twin(off(link_mm=0.0))

        def look(q_command, goal=goal):
            return Seen((ball_base(rod, q_command) - T_BASE_C[:3, 3]) @ T_BASE_C[:3, :3], goal, np.eye(3))

        stop = servo(task(rod=rod), q, look, twin).stop
        ends[stop] = twin.drives
    assert ends == {ServoStop.JOINT_LIMIT: 0, ServoStop.CONVERGED: 1}


def test_the_judge_is_asked_about_states_between_the_waypoints():
    """No two checked states are farther apart than the planner's own check has them."""
    asked = []

    class Records(NoContacts):
        def first_contact(self, q_path, *, needle_may_touch_patient):
            asked.append((q_path, needle_may_touch_patient))

    assert path_contact(Records(), np.array([Q_START, Q_START + 0.1])) is None
    (path, may_touch) = asked[0]
    assert not may_touch
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() <= 0.005 + 1e-12
    assert CASE.file.servo.padding_mm >= 1.0


NAMES = ("M1", "M2", "M3", "M4", "M5")
MARKERS = np.array([[-40.0, -80, 26], [40, -80, 26], [-76, 5, 26], [76, 5, 26], [0, -101, -12]])
TARGETS = np.array([[30.0, 0, 10], [-20, 30, -5]])
T_TRUE = np.eye(4)
T_TRUE[:3, :3] = Rotation.from_rotvec([0.3, -1.2, 0.7]).as_matrix()
T_TRUE[:3, 3] = [12.0, -40.0, 900.0]


def seen(covariances, rng):
    errors = np.array([rng.multivariate_normal(np.zeros(3), cov) for cov in covariances])
    return Points(apply(T_TRUE, MARKERS) + errors, np.asarray(covariances))


def test_equal_round_errors_give_the_plain_fit():
    """Then it is the rigid least squares of the planner, and Fitzpatrick's expected error; of three markers a triad."""
    rng = np.random.default_rng(1)
    markers = seen(np.tile(0.04 * np.eye(3), (5, 1, 1)), rng)
    found = map_head(NAMES, markers, MARKERS, 0.0, TARGETS, "mapping")
    assert found.T_c_m == pytest.approx(fit_rigid(MARKERS, markers.points_c), abs=1e-8)
    expected = np.sqrt(3 * 0.04) * leverage(MARKERS, TARGETS)
    assert found.expected_tre_mm(TARGETS) == pytest.approx(expected, rel=0.01)
    alone, with_own = found.expected_tre_mm(TARGETS), found.expected_tre_mm(TARGETS, 0.2)
    assert with_own**2 - alone**2 == pytest.approx(3 * 0.2**2)
    three = Points(apply(T_TRUE, MARKERS[:3]), np.tile(0.01 * np.eye(3), (3, 1, 1)))
    exact = map_head(NAMES[:3], three, MARKERS[:3], 0.1, TARGETS, "mapping")
    assert exact.T_c_m == pytest.approx(fit_triad(MARKERS[:3], three.points_c), abs=1e-8)
    assert found.fre_mm == pytest.approx(np.sqrt(np.mean(np.sum(found.residuals**2, axis=1))))


def test_expected_error_is_the_error_that_comes():
    """Long errors along the view, one bad marker: rms and covariance are those expected, below the plain fit's."""
    rng = np.random.default_rng(2)
    covariances = np.tile(np.diag([0.01, 0.04, 0.6]), (5, 1, 1))
    covariances[3] *= 9.0
    ours, plain, squared, truth = [], [], [], apply(T_TRUE, TARGETS)
    for _ in range(250):
        markers = seen(covariances, rng)
        read = MARKERS + rng.normal(0.0, 0.1, MARKERS.shape)
        found = map_head(NAMES, markers, read, 0.1, TARGETS, "mapping")
        ours.append(found.to_c(TARGETS) - truth)
        plain.append(apply(fit_rigid(read, markers.points_c), TARGETS) - truth)
        squared.append(np.einsum("ni,nij,nj->n", ours[-1], np.linalg.inv(found.covariance_at(TARGETS)), ours[-1]))
    rms = np.sqrt(np.mean(np.sum(np.square(ours), axis=2), axis=0))
    assert rms == pytest.approx(found.expected_tre_mm(TARGETS), rel=0.08)
    assert np.mean(squared) == pytest.approx(3.0, rel=0.12)
    assert np.all(rms < 0.95 * np.sqrt(np.mean(np.sum(np.square(plain), axis=2), axis=0)))


@pytest.mark.parametrize(
    ("points", "what"),
    [(MARKERS[:2], "too_few_markers"), (MARKERS * [1, 1, -1], "markers_mirrored"), (MARKERS / 10, "wrong_unit")],
)
def test_bad_marker_sets_are_refused_by_name(points, what):
    markers = Points(points, np.tile(np.eye(3), (len(points), 1, 1)))
    with refused(what):
        map_head(NAMES[: len(points)], markers, MARKERS[: len(points)], 0.1, TARGETS, "mapping")
