"""The servo loop: an arm that is off, a look that is injected, and every reason to stop."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from servo_world import CASE, HELD, NoContacts, start_configurations

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.case.errors import ArmErrors
from puncture_twin.planning.collision.state_checker import Contact, FirstContact
from puncture_twin.twin.guidance.stereo.servo_law import ServoStop, StepLimits, ball_base
from puncture_twin.twin.guidance.stereo.servo_loop import Lost, Seen, Task, path_contact, servo
from puncture_twin.twin.plant.truth import draw_true_arm

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
    usual = {
        "rod": HELD,
        "T_base_c": T_BASE_C,
        "tolerance_mm": 0.1,
        "max_steps": 10,
        "looks": 3,
        "limits": StepLimits(),
        "checker": NoContacts(),
    }
    return Task(**{**usual, **changes})


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


def test_a_perfect_arm_does_not_move():
    twin = Twin(off(link_mm=0.0))
    done = run(twin)
    assert (done.stop, done.steps, twin.drives) == (ServoStop.CONVERGED, 0, 0)


def test_a_ball_that_is_not_seen_is_lost_and_the_arm_does_not_move():
    twin, looks = Twin(off()), []

    def blind(q_command):
        looks.append(q_command)
        return Lost("camera 2: too few edges")

    done = servo(task(looks=4), Q_START, blind, twin)
    assert (done.stop, twin.drives, len(looks)) == (ServoStop.LOST_BALL, 0, 4)
    assert done.detail == "camera 2: too few edges"
    assert np.array_equal(done.q_command, Q_START)


def test_one_missed_look_is_tried_again():
    twin = Twin(off())
    outcomes = iter([Lost("a fly")])

    def now_and_then(q_command):
        return next(outcomes, None) or twin.look(q_command)

    assert servo(task(), Q_START, now_and_then, twin).stop is ServoStop.CONVERGED


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


def test_a_way_that_touches_something_is_not_driven():
    twin = Twin(off())
    done = run(twin, checker=Touches())
    assert (done.stop, twin.drives, done.detail) == (ServoStop.CONTACT, 0, "needle and table")


def test_a_singular_start_says_so():
    """With the wrist aligned and a long way to go the needle would turn: singular, and the arm stays."""
    twin = Twin(off(link_mm=0.0))
    q = Q_START.copy()
    q[4] = np.radians(0.3)
    rod = HELD._replace(R_base_flange=HELD.R_base_flange)
    far = Task(rod, T_BASE_C, 0.1, 10, 3, StepLimits(), NoContacts())
    done = servo(far, q, lambda command: Seen(np.zeros(3), np.full(3, 30.0), np.eye(3)), twin)
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
