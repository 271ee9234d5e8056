"""From home to standoff: paths checked by brute force, refusals with their reason, and the law of time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from planning.approach import (
    CLEARANCE_STEP_MM,
    FINER,
    MAX_SWEEP_MM,
    RESOLUTION_RAD,
    Approach,
    dense_states,
    least_clearance,
    path_length,
    plan_approach,
)
from planning.errors import InputError, NoAnswerError
from planning.mesh import TriangleMesh
from planning.robot.cell import Box, CellChecker, Tool
from planning.robot.kinematics import flange_pose
from planning.robot.ur import ur_model
from planning.trajectory import Trajectory, drive_smoothly, in_sequence, stop_and_go

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
LEFT = np.array([0.9, -1.9, 1.6, -1.2, -1.5, 0.3])
RIGHT = np.array([-0.9, -1.9, 1.6, -1.2, -1.5, 0.3])
"""The arm bent, needle down, to both sides of where the wall stands."""


def wall() -> Box:
    """A wall between LEFT and RIGHT that the arm can go over."""
    T = np.eye(4)
    T[:3, 3] = (-350.0, -110.0, 100.0)
    return Box("wall", T, (400.0, 10.0, 300.0))


def floor() -> Box:
    """The table that the arm stands on."""
    T = np.eye(4)
    T[2, 3] = -60.0
    return Box("table", T, (2000.0, 2000.0, 100.0))


def on_the_way_in_contact(checker: CellChecker) -> np.ndarray:
    """A state on the straight way from LEFT to RIGHT that touches the wall."""
    straight = dense_states(checker, np.stack([LEFT, RIGHT]), 0.05)
    contacts = [checker.contact(q, needle_may_touch_patient=False) for q in straight]
    hits = [q for q, contact in zip(straight, contacts, strict=True) if contact and contact.other == "wall"]
    assert hits, "the wall must stand in the way"
    return np.asarray(hits[len(hits) // 2])


def assert_sound(checker: CellChecker, path: Approach, home: np.ndarray, goals: np.ndarray) -> None:
    """Exact ends, straight segments, and no contact at random places along them."""
    assert np.array_equal(path.waypoints[0], home)
    assert np.array_equal(path.waypoints[-1], np.atleast_2d(goals)[path.goal_index])
    assert UR3.within_limits(path.waypoints).all()
    assert checker.sweep_mm(path.checked_q).max() <= MAX_SWEEP_MM
    assert np.linalg.norm(np.diff(path.checked_q, axis=0), axis=1).max() <= RESOLUTION_RAD / FINER + 1e-12
    assert path_length(path.checked_q) == pytest.approx(path.length_rad)
    rng = np.random.default_rng(0)
    for a, b in pairwise(path.waypoints):
        for share in rng.uniform(0.0, 1.0, 60):
            assert checker.contact(a + share * (b - a), needle_may_touch_patient=False) is None


def test_a_free_way_is_straight() -> None:
    """With nothing between, shortening leaves home and goal alone."""
    checker = CellChecker(UR3, TOOL, [floor()])
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert len(path.waypoints) == 2 and path.attempts == 1
    assert path.length_rad == pytest.approx(np.linalg.norm(RIGHT - LEFT))
    assert_sound(checker, path, LEFT, RIGHT)


def test_a_wall_is_gone_around() -> None:
    """The straight way collides; the planned one does not, and it is longer."""
    checker = CellChecker(UR3, TOOL, [floor(), wall()])
    on_the_way_in_contact(checker)
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert path.length_rad > np.linalg.norm(RIGHT - LEFT)
    assert path.clearance.boxes.mm > 0.0 and np.isinf(path.clearance.patient.mm)
    assert_sound(checker, path, LEFT, RIGHT)


def test_a_thin_plate_that_the_planner_steps_over_is_seen_on_a_closer_look() -> None:
    """Half a millimetre of plate hides between the planner's states; such a plan is refused and made again, finer."""
    T = np.eye(4)
    T[:3, 3] = (-350.0, -110.0, 100.0)
    checker = CellChecker(UR3, TOOL, [floor(), Box("plate", T, (400.0, 0.5, 300.0))])
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert path.attempts > 1
    assert all(checker.contact(q, needle_may_touch_patient=False) is None for q in path.checked_q)


def test_padding_keeps_its_distance_all_along() -> None:
    """With 5 mm of padding the arm as it is never comes nearer than 4 mm: half a sweep less, between checked states."""
    boxes = [floor(), wall()]
    path = plan_approach(CellChecker(UR3, TOOL, boxes, padding_mm=5.0), LEFT, RIGHT, seed=3)
    bare = CellChecker(UR3, TOOL, boxes)
    assert path.clearance.boxes.mm >= 5.0
    rng = np.random.default_rng(1)
    between = [a + rng.uniform() * (b - a) for a, b in pairwise(path.checked_q)]
    assert min(bare.nearest(q, "boxes").mm for q in between) >= 5.0 - MAX_SWEEP_MM / 2.0


def test_the_same_seed_gives_the_same_path_whatever_ran_before() -> None:
    """Bit by bit, though OMPL's generator serves the whole process; another seed goes another way."""
    checker = CellChecker(UR3, TOOL, [floor(), wall()])
    first = plan_approach(checker, LEFT, RIGHT, seed=7)
    other = plan_approach(checker, LEFT, RIGHT, seed=8)
    again = plan_approach(CellChecker(UR3, TOOL, [floor(), wall()]), LEFT, RIGHT, seed=7)
    assert np.array_equal(first.waypoints, again.waypoints) and np.array_equal(first.checked_q, again.checked_q)
    assert not np.array_equal(first.waypoints, other.waypoints)


def test_of_several_goals_a_free_one_is_taken() -> None:
    """A goal in the wall is left out; the answer says which of the others it is."""
    checker = CellChecker(UR3, TOOL, [floor(), wall()])
    in_wall = on_the_way_in_contact(checker)
    goals = np.stack([in_wall, RIGHT])
    path = plan_approach(checker, LEFT, goals, seed=1)
    assert path.goal_index == 1
    assert_sound(checker, path, LEFT, goals)


def test_home_is_a_goal_too() -> None:
    """Where home is the goal the path stays there."""
    path = plan_approach(CellChecker(UR3, TOOL), LEFT, LEFT, seed=1)
    assert path.length_rad == 0.0 and np.array_equal(path.waypoints, np.stack([LEFT, LEFT]))


def test_refusals_say_what_touches_what() -> None:
    """Home in a box, a goal in a box: both named, at once."""
    checker = CellChecker(UR3, TOOL, [wall()])
    in_wall = on_the_way_in_contact(checker)
    with pytest.raises(NoAnswerError, match=r"home is in collision: \w+ touches wall"):
        plan_approach(checker, in_wall, RIGHT, seed=1)
    with pytest.raises(NoAnswerError, match=r"every goal is in collision: \w+ touches wall"):
        plan_approach(checker, LEFT, in_wall, seed=1)


def test_a_walled_in_goal_ends_in_a_bounded_number_of_iterations() -> None:
    """No clock: the planner gives up after its iterations and says so."""
    flange = flange_pose(UR3, RIGHT)
    plates = []
    for name, turn in (("plus", 1.0), ("minus", -1.0)):
        T = flange.copy()
        T[:3, 3] = flange[:3, 3] + 120.0 * flange[:3, 2] + turn * 25.0 * flange[:3, 0]
        plates.append(Box(f"x_{name}", T, (4.0, 300.0, 150.0)))
        T = flange.copy()
        T[:3, 3] = flange[:3, 3] + 120.0 * flange[:3, 2] + turn * 25.0 * flange[:3, 1]
        plates.append(Box(f"y_{name}", T, (300.0, 4.0, 150.0)))
    checker = CellChecker(UR3, TOOL, plates)
    assert checker.contact(RIGHT, needle_may_touch_patient=False) is None
    with pytest.raises(NoAnswerError, match=r"no path within 300 iterations.*\(seed 1\)"):
        plan_approach(checker, LEFT, RIGHT, seed=1, max_iterations=300)


def test_angles_outside_the_limits_are_refused() -> None:
    """Home and goals must be within the joint limits and finite."""
    checker = CellChecker(UR3, TOOL)
    beyond = LEFT + np.array([0.0, 0.0, 2.0, 0.0, 0.0, 0.0])
    with pytest.raises(InputError, match="goal"):
        plan_approach(checker, LEFT, beyond, seed=1)
    with pytest.raises(InputError, match="home"):
        plan_approach(checker, np.full(6, np.nan), RIGHT, seed=1)
    with pytest.raises(InputError, match="goal"):
        plan_approach(checker, LEFT, np.empty((0, 6)), seed=1)


def test_the_least_clearance_is_that_of_every_state() -> None:
    """Skipping states by how far the bodies moved finds what measuring all of them finds, to its step."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=100.0)
    skin = TriangleMesh(np.asarray(ball.vertices) + np.array([-330.0, -100.0, 10.0]), np.asarray(ball.faces))
    checker = CellChecker(UR3, TOOL, [floor(), wall()], skin)
    states = dense_states(checker, np.stack([LEFT, LEFT + 0.3, LEFT + np.array([0.2, -0.1, 0.0, 0.3, 0.0, 0.0])]), 0.02)
    found = least_clearance(checker, states)
    every = [checker.distances(q) for q in states]
    for pair in ("patient", "needle", "boxes"):
        least = min(getattr(distances, pair).mm for distances in every)
        assert least <= getattr(found, pair).mm <= least + CLEARANCE_STEP_MM


whole_thousandths = st.integers(-3000, 3000).map(lambda n: n / 1000.0)
rows = st.lists(st.lists(whole_thousandths, min_size=6, max_size=6), min_size=2, max_size=5).map(np.array)


@given(waypoints=rows, scale=st.floats(0.05, 1.0))
@settings(max_examples=60, deadline=None)
def test_stop_and_go_keeps_the_limits_and_the_path(waypoints: np.ndarray, scale: float) -> None:
    """Ends exact, speed and acceleration within limits by the samples' own differences, every sample on the path."""
    trajectory = stop_and_go(UR3, waypoints, speed_scale=scale)
    assert np.array_equal(trajectory.q[0], waypoints[0]) and np.abs(trajectory.q[-1] - waypoints[-1]).max() < 1e-9
    assert (trajectory.max_speeds() <= scale * UR3.max_speeds * (1 + 1e-9)).all()
    assert (trajectory.max_accelerations() <= UR3.max_acceleration * (1 + 1e-6) + 1e-9).all()
    assert path_length(trajectory.q) == pytest.approx(path_length(waypoints), abs=1e-6)
    for waypoint in waypoints:
        assert np.abs(trajectory.q - waypoint).max(axis=1).min() < 1e-9


@pytest.mark.parametrize("turn", [0.1, 1.0, 7.5])
def test_one_joint_runs_in_the_shortest_time(turn: float) -> None:
    """A triangle where the limit speed is not reached, else a trapezoid: 2 sqrt(L/a), or L/v + v/a."""
    v, a = UR3.max_speeds[0], UR3.max_acceleration
    shortest = 2.0 * np.sqrt(turn / a) if turn < v * v / a else turn / v + v / a
    trajectory = stop_and_go(UR3, np.array([[0.0] * 6, [turn, 0, 0, 0, 0, 0]]))
    assert trajectory.duration_s == pytest.approx(shortest)
    assert trajectory.max_speeds()[0] == pytest.approx(min(v, np.sqrt(turn * a)), rel=0.02)


@pytest.mark.parametrize("tip_speed", [2.0, 20.0, 2000.0])
def test_a_smooth_drive_keeps_the_tips_speed_and_the_joints_limits(tip_speed: float) -> None:
    """Through every row without a stop; the slower of tip and joints decides."""
    depths = np.linspace(0.0, 100.0, 51)
    q = LEFT + np.sin(depths[:, None] / 80.0) * np.array([0.1, 0.5, -0.8, 0.3, 0.05, 0.0])
    trajectory = drive_smoothly(UR3, q, depths, max_tip_speed_mm_s=tip_speed)
    assert trajectory.q[0] == pytest.approx(q[0]) and trajectory.q[-1] == pytest.approx(q[-1])
    assert (trajectory.max_speeds() <= UR3.max_speeds * (1 + 1e-6)).all()
    assert (trajectory.max_accelerations() <= UR3.max_acceleration * (1 + 1e-3)).all()
    assert trajectory.duration_s >= 100.0 / tip_speed
    if tip_speed == 2.0:
        assert trajectory.duration_s == pytest.approx(50.0, rel=0.05)
        apart = np.abs(trajectory.q[:, None] - q[None]).max(axis=2).min(axis=0)
        assert apart.max() < 2e-4


def test_a_trajectory_is_sampled_anywhere_and_cannot_be_changed() -> None:
    """Linear between samples, clamped outside; arrays are read-only; parts join end to start."""
    trajectory = Trajectory(np.array([0.0, 1.0, 3.0]), np.array([[0.0] * 6, [1.0] * 6, [2.0] * 6]))
    assert trajectory.at(2.0).tolist() == [1.5] * 6
    assert trajectory.at(np.array([-1.0, 9.0])).tolist() == [[0.0] * 6, [2.0] * 6]
    assert trajectory.duration_s == 3.0 and trajectory.max_speeds().tolist() == [1.0] * 6
    with pytest.raises(ValueError, match="read-only"):
        trajectory.q[0, 0] = 1.0
    onward = Trajectory(np.array([0.0, 0.5]), np.array([[2.0] * 6, [1.0] * 6]))
    whole = in_sequence([trajectory, onward])
    assert whole.times_s.tolist() == [0.0, 1.0, 3.0, 3.5] and whole.q[-1].tolist() == [1.0] * 6
    with pytest.raises(InputError, match="off the end before it"):
        in_sequence([onward, onward])


@pytest.mark.parametrize(
    ("times", "q"),
    [
        ([0.0, 1.0], np.zeros((3, 6))),
        ([0.0, 0.0], np.zeros((2, 6))),
        ([1.0, 2.0], np.zeros((2, 6))),
        ([0.0, np.nan], np.zeros((2, 6))),
        ([0.0, 1.0], np.full((2, 6), np.inf)),
        ([], np.zeros((0, 6))),
    ],
)
def test_trajectories_that_make_no_sense_are_refused(times: list[float], q: np.ndarray) -> None:
    """Shapes, rising times, finite numbers."""
    with pytest.raises(InputError, match="trajectory"):
        Trajectory(np.array(times), q)


def test_time_laws_refuse_bad_numbers() -> None:
    """Speeds and depths that make no sense are input errors, not infinities."""
    two = np.stack([LEFT, RIGHT])
    with pytest.raises(InputError, match="speed_scale"):
        stop_and_go(UR3, two, speed_scale=0.0)
    with pytest.raises(InputError, match="max_tip_speed"):
        drive_smoothly(UR3, two, np.array([0.0, 1.0]), max_tip_speed_mm_s=np.nan)
    with pytest.raises(InputError, match="rising depth"):
        drive_smoothly(UR3, two, np.array([1.0, 0.0]), max_tip_speed_mm_s=1.0)
    with pytest.raises(InputError, match="no joint moves"):
        drive_smoothly(UR3, np.stack([LEFT, LEFT]), np.array([0.0, 1.0]), max_tip_speed_mm_s=1.0)
