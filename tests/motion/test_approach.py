"""From home to standoff: paths checked by brute force, refusals with their reason, and the law of time."""

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from kept_checkers import built
from refusals import refused

from puncture_twin.planning.arm.kinematics import (
    DEFAULT_SPEEDS,
    SpeedLimits,
    TipLimit,
    flange_pose,
    slowed,
    tip_rates,
    tip_speeds,
)
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel, ur_model
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import Contact
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.motion.approach import Approach, plan_approach
from puncture_twin.planning.motion.follow import (
    LENGTH_SLACK,
    MAX_JERK,
    Rates,
    follow,
    follow_smoothly,
    reachable_speed,
    rounded,
    speed_change_length,
    time_law,
)
from puncture_twin.planning.motion.path_check import (
    CLEARANCE_STEP_MM,
    FINER,
    MAX_SWEEP_MM,
    RESOLUTION_RAD,
    dense_states,
    least_clearance,
    path_length,
)
from puncture_twin.planning.motion.rrt_connect import STALLED, Limits, connect
from puncture_twin.planning.motion.trajectory import SAMPLE_S, Trajectory

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=200.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
LEFT = np.array([0.9, -1.9, 1.6, -1.2, -1.5, 0.3])
RIGHT = np.array([-0.9, -1.9, 1.6, -1.2, -1.5, 0.3])
"""The arm bent, needle down, to both sides of where the wall stands."""


def wall() -> Box:
    T = np.eye(4)
    T[:3, 3] = (-350.0, -110.0, 100.0)
    return Box("wall", T, (400.0, 10.0, 300.0))


def floor() -> Box:
    T = np.eye(4)
    T[2, 3] = -60.0
    return Box("table", T, (2000.0, 2000.0, 100.0))


def on_the_way_in_contact(checker: CellChecker) -> np.ndarray:
    straight = dense_states(checker, np.stack([LEFT, RIGHT]), 0.05)
    contacts = [checker.contact(q, needle_may_touch_patient=False) for q in straight]
    hits = [q for q, contact in zip(straight, contacts, strict=True) if contact and contact.other == "wall"]
    assert hits, "the wall must stand in the way"
    return np.asarray(hits[len(hits) // 2])


def assert_sound(checker: CellChecker, path: Approach, home: np.ndarray, goals: np.ndarray) -> None:
    """Exact ends, all of it within the limits, and no contact for FCL alone at random moments."""
    q, times = path.trajectory.q, path.trajectory.times_s
    assert np.array_equal(q[0], home) and np.array_equal(q[-1], np.atleast_2d(goals)[path.goal_index])
    assert UR3.within_limits(q).all()
    assert checker.sweep_mm(path.checked_q).max() <= MAX_SWEEP_MM
    assert np.linalg.norm(np.diff(path.checked_q, axis=0), axis=1).max() <= RESOLUTION_RAD / FINER + 1e-12
    assert np.abs(path.checked_q[:, None] - q[::7]).max(axis=2).min(axis=0).max() < 1e-12
    peaks = path.trajectory.peaks()
    tips = tip_speeds(UR3, q, times, TOOL.needle_length_mm)
    assert tips.max(initial=0.0) <= DEFAULT_SPEEDS.tip_speed_mm_s * (1 + 1e-9)
    assert (peaks.speed <= DEFAULT_SPEEDS.joint_speed_fraction * UR3.max_speeds * (1 + 1e-6)).all()
    assert (peaks.acceleration <= UR3.max_acceleration * (1 + 1e-6)).all() and (peaks.jerk <= MAX_JERK * 1.001).all()
    for moment in np.random.default_rng(0).uniform(0.0, times[-1], 150):
        state = path.trajectory.at(moment)
        assert CellChecker.contact(checker, state, needle_may_touch_patient=False) is None


KINDS = pytest.mark.parametrize("kind", [CellChecker, FastChecker])


@KINDS
def test_a_free_way_is_straight(kind: type[CellChecker]) -> None:
    checker = built(kind, UR3, TOOL, [floor()])
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert len(path.waypoints) == 2 and path.attempts == 1
    assert path_length(path.waypoints) == pytest.approx(np.linalg.norm(RIGHT - LEFT))
    assert_sound(checker, path, LEFT, RIGHT)


@KINDS
def test_the_straight_way_leads_to_the_nearest_goal_that_is_free(kind: type[CellChecker]) -> None:
    """A nearer goal where the needle touches the arm is passed over; where no goal or home is free, that is said."""
    folded, near = LEFT + [0.0, 0.0, 0.0, 0.7, 0.0, 0.0], LEFT + [0.8, 0.0, 0.0, 0.0, 0.0, 0.0]
    checker = built(kind, UR3, TOOL, [floor()])
    path = plan_approach(checker, LEFT, np.stack([RIGHT, folded, near]), seed=1)
    assert path.goal_index == 2 and len(path.waypoints) == 2
    assert_sound(checker, path, LEFT, np.stack([RIGHT, folded, near]))
    with refused("home_in_collision", "upper_arm", by=NoAnswerError):
        plan_approach(checker, folded, near, seed=1)
    with refused("goals_in_collision", "upper_arm", by=NoAnswerError):
        plan_approach(checker, LEFT, folded, seed=1)


@KINDS
def test_a_wall_is_gone_around_and_of_several_goals_a_free_one_is_taken(kind: type[CellChecker]) -> None:
    checker = built(kind, UR3, TOOL, [floor(), wall()])
    goals = np.stack([on_the_way_in_contact(checker), RIGHT])
    path = plan_approach(checker, LEFT, goals, seed=1)
    assert path.goal_index == 1
    assert path_length(path.waypoints) > np.linalg.norm(RIGHT - LEFT)
    assert len(path.cuts) == len(path.waypoints) - 2 and path.cuts.max() > 0.0
    slow_arm, tip = slowed(UR3, DEFAULT_SPEEDS), TipLimit(TOOL.needle_length_mm, DEFAULT_SPEEDS.tip_speed_mm_s)
    assert path.trajectory.duration_s < follow(slow_arm, path.waypoints, tip=tip).duration_s
    clearance = least_clearance(checker, path.checked_q)
    assert clearance.boxes.mm > 0.0 and np.isinf(clearance.patient.mm)
    assert_sound(checker, path, LEFT, goals)


def test_a_thin_plate_is_seen_on_a_closer_look_and_by_proofs_at_once():
    checker = CellChecker(UR3, TOOL, [floor(), plate()])
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert path.attempts > 1
    assert all(checker.contact(q, needle_may_touch_patient=False) is None for q in path.checked_q)
    checker = built(FastChecker, UR3, TOOL, [floor(), plate()])
    path = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert path.attempts == 1
    assert_sound(checker, path, LEFT, RIGHT)


def plate() -> Box:
    T = np.eye(4)
    T[:3, 3] = (-350.0, -110.0, 100.0)
    return Box("plate", T, (400.0, 0.5, 300.0))


@KINDS
def test_padding_keeps_its_distance_all_along(kind: type[CellChecker]) -> None:
    boxes = [floor(), wall()]
    checker = built(kind, UR3, TOOL, boxes, padding_mm=5.0)
    path = plan_approach(checker, LEFT, RIGHT, seed=3)
    bare = CellChecker(UR3, TOOL, boxes)
    assert least_clearance(checker, path.checked_q).boxes.mm >= 5.0
    rng = np.random.default_rng(1)
    between = [a + rng.uniform() * (b - a) for a, b in pairwise(path.checked_q[::3])]
    assert min(bare.nearest(q, "boxes").mm for q in between) >= 5.0 - MAX_SWEEP_MM / 2.0


def test_the_same_seed_gives_the_same_path_whatever_ran_before() -> None:
    checker = built(FastChecker, UR3, TOOL, [floor(), wall()])
    first = plan_approach(checker, LEFT, RIGHT, seed=7)
    other = plan_approach(checker, LEFT, RIGHT, seed=28)
    again = plan_approach(built(FastChecker, UR3, TOOL, [floor(), wall()]), LEFT, RIGHT, seed=7)
    assert np.array_equal(first.waypoints, again.waypoints) and np.array_equal(first.checked_q, again.checked_q)
    assert not np.array_equal(first.waypoints, other.waypoints)


def test_of_several_goals_the_cheapest_that_is_reached_is_taken():
    checker = built(FastChecker, UR3, TOOL, [floor(), wall()])
    this_side = LEFT + np.array([0.9, 0.0, 0.0, 0.0, 0.0, 1.6])
    assert np.linalg.norm(RIGHT - LEFT) < np.linalg.norm(this_side - LEFT)
    path = plan_approach(checker, LEFT, np.stack([RIGHT, this_side]), seed=1)
    assert path.goal_index == 1
    around = plan_approach(checker, LEFT, RIGHT, seed=1)
    assert path_length(path.waypoints) <= path_length(around.waypoints)
    path = plan_approach(CellChecker(UR3, TOOL), LEFT, LEFT, seed=1)
    assert path.trajectory.duration_s == 0.0 and np.array_equal(path.waypoints, np.stack([LEFT, LEFT]))


@KINDS
def test_a_walled_in_goal_ends_in_a_bounded_number_of_samples(kind: type[CellChecker]) -> None:
    flange = flange_pose(UR3, RIGHT)
    plates = []
    for name, turn in (("plus", 1.0), ("minus", -1.0)):
        T = flange.copy()
        T[:3, 3] = flange[:3, 3] + 120.0 * flange[:3, 2] + turn * 25.0 * flange[:3, 0]
        plates.append(Box(f"x_{name}", T, (4.0, 300.0, 150.0)))
        T = flange.copy()
        T[:3, 3] = flange[:3, 3] + 120.0 * flange[:3, 2] + turn * 25.0 * flange[:3, 1]
        plates.append(Box(f"y_{name}", T, (300.0, 4.0, 150.0)))
    checker = built(kind, UR3, TOOL, plates)
    assert checker.contact(RIGHT, needle_may_touch_patient=False) is None
    for home, goal, where in ((LEFT, RIGHT, "the goals are"), (RIGHT, LEFT, "home is")):
        with refused("no_approach", "150 samples (seed 1)", where, by=NoAnswerError):
            plan_approach(checker, home, goal, seed=1, max_samples=150)


@pytest.mark.parametrize("shut_in", ["home", "goal"])
def test_a_tree_that_never_grows_ends_the_search_early(shut_in: str) -> None:
    ends, known = {"home": LEFT, "goal": RIGHT}, {tuple(LEFT), tuple(RIGHT)}

    def contact_of(start: np.ndarray, end: np.ndarray) -> Contact | None:
        assert tuple(start) in known
        inside = [np.linalg.norm(q - ends[shut_in]) < 0.01 for q in (start, end)]
        if inside[0] != inside[1]:
            return Contact("needle", "wall")
        known.add(tuple(end))
        return None

    found = connect(contact_of, LEFT, RIGHT[None], Limits(UR3.joint_limits, 10 * STALLED), seed=1)
    assert found.waypoints is None and found.samples == STALLED
    shut, open_ = (found.home_states, found.goal_states)[:: 1 if shut_in == "home" else -1]
    assert shut == 1 and open_ > 100 and shut + open_ == len(known)
    assert set(found.blocked) == {Contact("needle", "wall")}


def test_a_shortcut_is_taken_only_where_its_own_check_allows() -> None:
    """Where no shortcut is allowed the path stays as the planner found it; it goes where segments may."""

    def contact_of(start: np.ndarray, end: np.ndarray) -> Contact | None:
        states = start + np.linspace(0.0, 1.0, 100)[:, None] * (end - start)
        return Contact("needle", "wall") if (np.abs(states[:, :2] - block).max(axis=1) < 0.5).any() else None

    def never(start: np.ndarray, end: np.ndarray) -> Contact | None:
        return Contact("needle", "wall")

    block, limits = ((LEFT + RIGHT) / 2.0)[:2], Limits(UR3.joint_limits, 2000)
    short = connect(contact_of, LEFT, RIGHT[None], limits, seed=1).waypoints
    found = connect(contact_of, LEFT, RIGHT[None], limits, seed=1, clear_of=never).waypoints
    assert short is not None and found is not None
    assert path_length(short) < 0.8 * path_length(found)
    for path in (short, found):
        assert all(contact_of(*ends) is None for ends in pairwise(path))


@KINDS
def test_the_least_clearance_is_that_of_every_state(kind: type[CellChecker], ball: Callable[..., TriangleMesh]) -> None:
    """Skipping states by how far bodies moved, or by bounds, finds what measuring all of them finds, to its step."""
    skin = ball(100.0, (-330.0, -100.0, 10.0))
    ways = np.stack([LEFT, LEFT + 0.3, LEFT + np.array([0.2, -0.1, 0.0, 0.3, 0.0, 0.0])])
    for padding in (0.0, 5.0):
        checker = built(kind, UR3, TOOL, [floor(), wall()], skin, padding_mm=padding)
        states = dense_states(checker, ways, 0.02)[::2]
        found = least_clearance(checker, states)
        every = [checker.distances(q) for q in states]
        for pair in ("patient", "needle", "boxes"):
            least = min(getattr(distances, pair).mm for distances in every)
            assert least <= getattr(found, pair).mm <= least + CLEARANCE_STEP_MM


whole_thousandths = st.integers(-3000, 3000).map(lambda n: n / 1000.0)
rows = st.lists(st.lists(whole_thousandths, min_size=6, max_size=6), min_size=2, max_size=5).map(np.array)


def scaled(fraction: float) -> UrModel:
    return slowed(UR3, SpeedLimits(joint_speed_fraction=fraction, joint_acceleration_fraction=1.0))


def assert_within(trajectory: Trajectory, scale: float) -> None:
    assert np.allclose(np.diff(trajectory.times_s), SAMPLE_S, rtol=0, atol=1e-12)
    steps = np.concatenate(
        [np.repeat(trajectory.q[:1], 3, axis=0), trajectory.q, np.repeat(trajectory.q[-1:], 3, axis=0)]
    )
    limits = (scale * UR3.max_speeds, np.full(6, UR3.max_acceleration), np.full(6, MAX_JERK))
    for order, (limit, peak) in enumerate(zip(limits, trajectory.peaks(), strict=True), start=1):
        found = np.abs(np.diff(steps, n=order, axis=0) / SAMPLE_S**order).max(axis=0)
        rounding = 1e-14 / SAMPLE_S**order
        assert (found <= limit * (1 + 1e-6) + rounding).all()
        assert np.allclose(found, peak, rtol=1e-6, atol=rounding)


@given(waypoints=rows, scale=st.floats(0.05, 1.0))
@settings(max_examples=25, deadline=None)
def test_without_rounding_the_path_is_kept(waypoints: np.ndarray, scale: float) -> None:
    trajectory = follow(scaled(scale), waypoints)
    assert np.array_equal(trajectory.q[0], waypoints[0]) and np.array_equal(trajectory.q[-1], waypoints[-1])
    assert_within(trajectory, scale)
    assert path_length(trajectory.q) == pytest.approx(path_length(waypoints), abs=1e-6)
    for waypoint in waypoints:
        assert np.abs(trajectory.q - waypoint).max(axis=1).min() < 1e-9


@given(waypoints=rows, scale=st.floats(0.05, 1.0), share=st.floats(0.01, 0.5))
@settings(max_examples=30, deadline=None)
def test_rounded_corners_keep_the_limits_and_their_triangle(waypoints: np.ndarray, scale: float, share: float) -> None:
    """Within every limit, and off the segments by no more than 3/16 of the corner that is cut."""
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    if not lengths.all():
        return
    cuts = share * np.minimum(lengths[:-1], lengths[1:])
    trajectory = follow(scaled(scale), waypoints, cuts)
    assert_within(trajectory, scale)
    units = np.diff(waypoints, axis=0) / lengths[:, None]
    allowed = np.max(3.0 / 16.0 * cuts * np.linalg.norm(np.diff(units, axis=0), axis=1), initial=0.0)
    assert max(to_path(q, waypoints) for q in trajectory.q[::9]) <= allowed + 1e-9


def to_path(q: np.ndarray, waypoints: np.ndarray) -> float:
    a, ab = waypoints[:-1], np.diff(waypoints, axis=0)
    share = np.clip(((q - a) * ab).sum(axis=1) / (ab**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(q - a - share[:, None] * ab, axis=1).min())


def test_a_rounded_corner_is_the_integral_of_its_speed() -> None:
    """The closed form against numbers: the velocity turns from one direction to the other by 3 x^2 - 2 x^3."""
    u, w, corner = np.eye(6)[0], np.array([0.0, 0.6, 0.8, 0.0, 0.0, 0.0]), np.arange(6.0)
    x = np.linspace(0.0, 1.0, 20001)
    f = (3.0 * x**2 - 2.0 * x**3)[:, None]
    velocity = 2.0 * 0.3 * ((1.0 - f) * u + f * w)
    summed = (
        corner
        - 0.3 * u
        + np.concatenate([np.zeros((1, 6)), np.cumsum((velocity[:-1] + velocity[1:]) / 2.0, axis=0)]) / 20000
    )
    assert np.abs(rounded(corner, u, w, 0.3, x) - summed).max() < 1e-8
    assert np.allclose(rounded(corner, u, w, 0.3, np.ones(1)), corner + 0.3 * w)


@pytest.mark.parametrize("turn", [0.002, 0.1, 1.0, 7.5])
def test_one_joint_runs_in_the_shortest_time(turn: float) -> None:
    v, a, j = UR3.max_speeds[0], UR3.max_acceleration, MAX_JERK
    if turn < v * (v / a + a / j):
        v = a * (-a / j + np.sqrt((a / j) ** 2 + 4.0 * turn / a)) / 2.0
    shortest = turn / v + v / a + a / j if v >= a * a / j else 4.0 * (turn / (2.0 * j)) ** (1.0 / 3.0)
    trajectory = follow(UR3, np.array([[0.0] * 6, [turn, 0, 0, 0, 0, 0]]))
    assert shortest - 1e-9 <= trajectory.duration_s <= shortest + SAMPLE_S


def test_a_speed_is_reached_where_it_can_be() -> None:
    """The way to a speed is the least: ruckig needs just as long; half of it allows a lower speed, which just fits."""
    rates = Rates(3.0, 1.4, 14.0)
    for start, end in ((0.0, 0.05), (0.2, 1.5), (1.0, 1.01)):
        length = speed_change_length(start, end, rates) * (1.0 + 2.0 * LENGTH_SLACK)
        law = time_law(length, rates, start, end)
        assert law.duration_s == pytest.approx(2.0 * length / (start + end), rel=1e-3)
        assert reachable_speed(start, end, length, rates) == end
        less = reachable_speed(start, end, length / 2.0, rates)
        assert start < less < end
        assert speed_change_length(start, less, rates) == pytest.approx(length / 2.0, rel=1e-5)


@pytest.mark.parametrize(("start", "end"), [(0.0, 0.0), (0.4, 0.9), (1.0, 0.0), (1.3, 0.0)])
def test_many_times_at_once_are_as_ruckig_has_them(start: float, end: float) -> None:
    """Each of the positions that ``travelled`` gives is ``at_time``'s, braking from above the speed limit included."""
    law = time_law(3.0, Rates(1.0, 1.4, 14.0), start, end)
    assert law.profile is not None
    assert (law.profile.profiles[0][0].brake.duration > 0.0) == (start > 1.0)
    times = np.linspace(0.0, law.duration_s, 500)
    expected = [law.profile.at_time(time)[0][0] for time in times.tolist()]
    assert law.travelled(times) == pytest.approx(np.array(expected), abs=1e-14)


@pytest.mark.parametrize("tip_speed", [2.0, 20.0, 2000.0])
def test_a_smooth_drive_keeps_the_tips_speed_and_the_joints_limits(tip_speed: float) -> None:
    depths = np.linspace(0.0, 100.0, 51)
    q = LEFT + np.sin(depths[:, None] / 80.0) * np.array([0.1, 0.5, -0.8, 0.3, 0.05, 0.0])
    trajectory = follow_smoothly(UR3, q, depths, max_tip_speed_mm_s=tip_speed)
    assert trajectory.q[0] == pytest.approx(q[0]) and trajectory.q[-1] == pytest.approx(q[-1])
    assert_within(trajectory, 1.0)
    assert trajectory.duration_s >= 100.0 / tip_speed
    if tip_speed == 2.0:
        assert trajectory.duration_s == pytest.approx(50.0, rel=0.05)
        apart = np.abs(trajectory.q[:, None] - q[None]).max(axis=2).min(axis=0)
        assert apart.max() < 2e-4


def test_a_trajectory_is_sampled_anywhere_and_has_a_motion():
    trajectory = Trajectory(np.array([0.0, 1.0, 3.0]), np.array([[0.0] * 6, [1.0] * 6, [2.0] * 6]))
    assert trajectory.at(2.0).tolist() == [1.5] * 6
    assert trajectory.at(np.array([-1.0, 9.0])).tolist() == [[0.0] * 6, [2.0] * 6]
    assert trajectory.duration_s == 3.0 and trajectory.peaks().speed.tolist() == [1.0] * 6
    with pytest.raises(ValueError, match="read-only"):
        trajectory.q[0, 0] = 1.0
    with refused("no_motion"):
        follow_smoothly(UR3, np.stack([LEFT, LEFT]), np.array([0.0, 1.0]), max_tip_speed_mm_s=1.0)


@pytest.mark.parametrize(
    ("times", "q", "code"),
    [
        ([0.0, 1.0], np.zeros((3, 6)), "wrong_shape"),
        ([0.0, 0.0], np.zeros((2, 6)), "times_not_rising"),
        ([1.0, 2.0], np.zeros((2, 6)), "times_not_rising"),
        ([0.0, 1.0], np.full((2, 6), np.inf), "not_finite"),
        ([], np.zeros((0, 6)), "wrong_shape"),
    ],
)
def test_trajectories_that_make_no_sense_are_refused(times: list[float], q: np.ndarray, code: str) -> None:
    with refused(code, "trajectory"):
        Trajectory(np.array(times), q)


@given(waypoints=rows, share=st.floats(0.0, 0.5), limit=st.floats(20.0, 1000.0), tip_mm=st.floats(0.0, 400.0))
@settings(max_examples=25, deadline=None)
def test_the_tip_never_exceeds_its_limit(waypoints: np.ndarray, share: float, limit: float, tip_mm: float) -> None:
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    if not lengths.all():
        return
    cuts = share * np.minimum(lengths[:-1], lengths[1:])
    slow = follow(UR3, waypoints, cuts, tip=TipLimit(tip_mm, limit))
    assert tip_speeds(UR3, slow.q, slow.times_s, tip_mm).max() <= limit * (1 + 1e-9)
    assert_within(slow, 1.0)


def test_a_joint_alone_takes_the_tip_to_the_limit_and_slower_ones_take_longer():
    two = np.array([[0.0] * 6, [1.5, 0, 0, 0, 0, 0]])
    slow = follow(UR3, two, tip=TipLimit(200.0, 250.0))
    assert tip_speeds(UR3, slow.q, slow.times_s, 200.0).max() == pytest.approx(250.0, rel=3e-3)
    assert np.array_equal(follow(UR3, two, tip=TipLimit(200.0, 5000.0)).q, follow(UR3, two).q)
    q, u = np.random.default_rng(3).uniform(-3.0, 3.0, (2, 20, 6))
    step = 1e-6
    pairs = [np.stack([a - step * b, a + step * b]) for a, b in zip(q, u, strict=True)]
    by_differences = [tip_speeds(UR3, pair, np.array([0.0, 2.0 * step]), 150.0)[0] for pair in pairs]
    assert tip_rates(UR3, q, u, 150.0) == pytest.approx(by_differences, rel=1e-6)
    checker = built(FastChecker, UR3, TOOL, [floor(), wall()])
    usual = plan_approach(checker, LEFT, RIGHT, seed=1).trajectory
    for speeds in (SpeedLimits(tip_speed_mm_s=100.0), SpeedLimits(joint_speed_fraction=0.05)):
        path = plan_approach(checker, LEFT, RIGHT, seed=1, speeds=speeds).trajectory
        assert path.duration_s > usual.duration_s
        assert tip_speeds(UR3, path.q, path.times_s, TOOL.needle_length_mm).max() <= speeds.tip_speed_mm_s
        assert (path.peaks().speed <= speeds.joint_speed_fraction * UR3.max_speeds * (1 + 1e-6)).all()
