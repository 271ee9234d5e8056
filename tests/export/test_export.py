"""Export: what a robot is given is the plan, within the arm's limits, and nothing that a name holds gets out of it."""

import math
import re
import sys
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from places import ROOT
from refusals import refused
from scipy.interpolate import CubicHermiteSpline, CubicSpline
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.insertion import every_branch, needle_lines
from puncture_twin.planning.arm.inverse_kinematics import inverse, nearest_within_limits
from puncture_twin.planning.arm.kinematics import SpeedLimits, flange_pose, jacobian, slowed
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import JOINT_NAMES, UR_MODELS, ur_model
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.export.exporter import FORMATS, GROUP, blend_radii_mm, csv_text, export_plan, read_csv
from puncture_twin.planning.export.program import (
    PLAIN,
    check_program,
    check_sampled,
    check_trajectory,
    corner_rows,
    program_of,
    rests_at,
    waypoint_rows,
)
from puncture_twin.planning.export.ros2 import read_ros2, ros2_text, velocities
from puncture_twin.planning.export.urscript import read_urscript, urscript_text
from puncture_twin.planning.motion.follow import follow, follow_smoothly
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_document import read_plan, write_plan
from puncture_twin.twin.jobs.patient.export_jobs import refuse_format

UR3 = ur_model("ur3")
TOOL = Tool(needle_length_mm=250.0, shaft_mm=150.0, needle_diameter_mm=1.2, holder_diameter_mm=30.0)
STANDOFF_MM = 60.0
BENT = np.array([0.4, -1.9, 1.6, -1.2, -1.5, 0.3])
HOME = np.array([0.0, -1.5707963267948966, 0.0, -1.5707963267948966, 0.0, 0.0])
WAYPOINTS = np.stack([HOME, [0.3, -1.2, 0.7, -0.9, -0.6, 0.9], [0.9, -1.5, 1.2, -1.6, -1.1, -0.4]])
SOURCE = Path("plan.json")


def tip_poses(model, q, length):
    poses = flange_pose(model, np.asarray(q))
    poses[..., :3, 3] += length * poses[..., :3, 2]
    return poses


FAST = SpeedLimits(1000.0, 10.0, 1.0, 1.0)
"""What these plans keep: the joints' own limits are what is tested."""


HALF = slowed(UR3, FAST._replace(joint_speed_fraction=0.5))


def plan_to(waypoints, *, arm=HALF, tip_mm_s=10.0):
    """A plan over some waypoints to the standoff at BENT, and 60 mm straight in."""
    tip = tip_poses(UR3, BENT, TOOL.needle_length_mm)
    outward, target = -tip[:3, 2], tip[:3, 3] + STANDOFF_MM * tip[:3, 2]
    depths = np.linspace(0.0, STANDOFF_MM, 61)
    line = needle_lines(target[None], outward[None])[0]
    ways = every_branch(UR3, line, TOOL.needle_length_mm + STANDOFF_MM - depths)
    way = ways[np.nanargmin(np.abs(ways[:, 0, :5] - BENT[:5]).max(axis=1))]
    way = way + (BENT - way[0]) * [0, 0, 0, 0, 0, 1]
    T_base_ct = np.eye(4)
    T_base_ct[:3, 3] = (100.0, -200.0, 50.0)
    return Plan(
        case_name="liver-s7",
        inputs=(Input("case", "case.toml", "0" * 64), Input("mesh liver", "liver.stl", "a" * 64)),
        seed=3,
        model=UR3,
        T_base_ct=T_base_ct,
        expected_target_error_mm=math.nan,
        theta=0.1,
        beta=0.2,
        entry_ct=target - T_base_ct[:3, 3] + 40.0 * outward,
        target_ct=target - T_base_ct[:3, 3],
        outward_ct=outward,
        roll=0.0,
        standoff_mm=STANDOFF_MM,
        needle_length_mm=TOOL.needle_length_mm,
        approach=follow(arm, np.concatenate([waypoints, way[:1]])),
        insertion=follow_smoothly(UR3, way, depths, max_tip_speed_mm_s=tip_mm_s),
        clearance_mm={"approach": 12.0},
        speeds=FAST if arm is HALF else FAST._replace(tip_speed_mm_s=5000.0),
        warnings=(),
    )


@pytest.fixture(scope="module")
def plan():
    return plan_to(WAYPOINTS)


@pytest.fixture(scope="module")
def smooth(plan):
    spline = CubicSpline([0.0, 4.0, 8.0, 12.0], plan.approach.q[corner_rows(plan.approach.q)], bc_type="clamped")
    times = 0.008 * np.arange(1501)
    return replace(plan, approach=Trajectory(times, np.concatenate([spline(times[:-1]), plan.insertion.q[:1]])))


class HaltError(Exception):
    """The program ended itself."""


class TouchedError(Exception):
    """The tool met something."""


class Controller:
    """Runs the subset of URScript that is written here: straight joint moves, straight tip moves, guards."""

    def __init__(self, q, model=UR3, operator=lambda robot: None, contact=None):
        self.q, self.model, self.operator = np.array(q, dtype=float), model, operator
        self.contact, self.inside = contact, False  # the part of the insertion after which it meets something
        self.length = 0.0
        self.events, self.way = [], [self.q.copy()]

    def run(self, text):
        code = "\n".join([*(line for line in text.splitlines() if line.strip() != "end"), "puncture()"])
        code = re.sub(r"p\[([^]]*)\]", r"(\1)", code).replace("local ", "").replace("halt", "raise HaltError")
        code = code.replace("thread insert():", "def insert():\n    nonlocal inserted").replace("global ", "")
        code = code.replace("run insert()", "run(insert)").replace("kill insertion", "kill(insertion)")
        names = {name: getattr(self, name) for name in dir(self) if not name.startswith("_")}
        try:
            exec(code, {**names, "run": self.run_thread, "HaltError": HaltError, "norm": abs, "sin": math.sin})
        except HaltError:
            return False
        return True

    def run_thread(self, thread):
        self.inside = True
        with suppress(TouchedError):
            thread()
        self.inside = False

    def tool_contact(self, direction):
        return 0 if self.contact is None else 4

    def get_target_tcp_speed(self):
        return [0.0, 0.0, 0.01, 0.0, 0.0, 0.0]

    def kill(self, thread):
        self.events.append(("kill",))

    def sync(self):
        """The rest of the cycle."""

    def set_tcp(self, pose):
        assert pose[:2] == (0.0, 0.0) and pose[3:] == (0.0, 0.0, 0.0)
        self.length = 1000.0 * pose[2]

    def get_actual_joint_positions(self):
        return self.q.tolist()

    def get_actual_tcp_pose(self):
        T = tip_poses(self.model, self.q, self.length)
        return (*(T[:3, 3] / 1000.0), *Rotation.from_matrix(T[:3, :3]).as_rotvec())

    def get_inverse_kin(self, pose, near):
        T = self.matrix(pose)
        T[:3, 3] -= self.length * T[:3, 2]
        q = nearest_within_limits(self.model, inverse(self.model, T)[0], np.array(near))
        return q[np.nanargmin(np.abs(q - near).max(axis=1))].tolist()

    def point_dist(self, first, second):
        return math.dist(first[:3], second[:3])

    def matrix(self, pose):
        T = np.eye(4)
        T[:3, :3] = Rotation.from_rotvec(pose[3:]).as_matrix()
        T[:3, 3] = 1000.0 * np.array(pose[:3])
        return T

    def popup(self, message, title="Popup", warning=False, error=False, blocking=False):
        self.events.append(("popup", title, blocking))
        self.operator(self)

    def movej(self, q, a, v, r=0.0):
        start, q = self.q.copy(), np.array(q)
        far = np.abs(q - start).max()
        if far == 0.0:
            return
        v = min(v, math.sqrt(far * a))
        end = far / v + v / a
        for t in np.linspace(0.0, end, max(2, math.ceil(end / 0.002)) + 1)[1:]:
            fall = max(0.0, t - (end - v / a))
            run = a * min(t, v / a) ** 2 / 2 + v * (t - min(t, v / a)) - a * fall**2 / 2
            self.way.append(start + run / far * (q - start))
        self.q = q
        self.events.append(("movej", q, a, v, r))

    def servoj(self, q, a, v, t, lookahead, gain):
        self.q = np.array(q)
        self.way.append(self.q)
        if self.events[-1:] != [("servoj",)]:
            self.events.append(("servoj",))

    def movel(self, pose, a, v):
        """Newton's steps along the straight line of the tip: nothing of the closed form that the export uses."""
        start, end = tip_poses(self.model, self.q, self.length), self.matrix(pose)
        turn = Rotation.from_matrix(end[:3, :3] @ start[:3, :3].T).as_rotvec()
        for share in np.linspace(0.0, 1.0, 201)[1:]:
            if self.inside and self.contact is not None and share > self.contact:
                raise TouchedError
            wanted = start[:3, 3] + share * (end[:3, 3] - start[:3, 3])
            R = Rotation.from_rotvec(share * turn).as_matrix() @ start[:3, :3]
            flange = wanted - self.length * R[:, 2]
            for _ in range(4):
                T = flange_pose(self.model, self.q)
                spin = Rotation.from_matrix(R @ T[:3, :3].T).as_rotvec()
                step = np.concatenate([flange - T[:3, 3], spin])
                self.q = self.q + np.linalg.solve(jacobian(self.model, self.q), step)
            self.way.append(self.q.copy())
        self.events.append(("movel", self.q.copy(), a, v))

    def stopl(self, a):
        self.events.append(("stopl",))

    def stopj(self, a):
        self.events.append(("stopj",))


def script(plan, blends=None):
    return urscript_text(program_of(plan, blends), plan, case_checked=False)


def finer(trajectory):
    """Its states at four times as many instants: straight in joint angles, so curved for the tip."""
    share = np.arange(0.0, len(trajectory.q) - 0.999, 0.25)
    return trajectory.at(np.interp(share, np.arange(len(trajectory.q)), trajectory.times_s))


def kinds(robot):
    return [event[0] for event in robot.events]


def off_way_mm(model, plan_q, way_q):
    """How far the tip and the flange of planned states are from a way's, the way being straight between its states."""
    worst = 0.0
    for length in (0.0, TOOL.needle_length_mm):
        points, way = (tip_poses(model, np.asarray(q), length)[:, :3, 3] for q in (plan_q, way_q))
        for start in range(0, len(points), 200):
            part = points[start : start + 200, None]
            a, ab = way[:-1], np.diff(way, axis=0)
            squared = np.maximum((ab**2).sum(-1), 1e-30)
            t = np.clip(((part - a) * ab).sum(-1) / squared, 0.0, 1.0)
            worst = max(worst, np.linalg.norm(part - a - t[..., None] * ab, axis=-1).min(axis=1).max())
    return worst


def test_the_program_drives_the_plan_in_its_time(plan):
    robot = Controller(plan.approach.q[0])
    assert robot.run(script(plan))
    went = ["movej", "movej", "movej", "movel", "popup", "movel", "stopl"]
    assert kinds(robot) == [*went, "popup", "movel", "stopl"]
    assert [robot.events[at] for at in (4, 7)] == [("popup", "Insertion", True), ("popup", "Inserted", True)]
    back = len(robot.way) - 200  # the way back is as long as the way in
    robot.q, robot.way = robot.way[back - 1], robot.way[:back]
    planned = np.concatenate([finer(plan.approach), finer(plan.insertion)])
    assert off_way_mm(UR3, planned[::7], robot.way) < 0.01
    assert off_way_mm(UR3, robot.way[::7], planned) < 0.01
    tip = tip_poses(UR3, robot.q, plan.needle_length_mm)[:3, 3]
    assert np.linalg.norm(tip - plan.T_base_ct[:3, 3] - plan.target_ct) < 0.01
    np.testing.assert_allclose(robot.q, plan.insertion.q[-1], atol=1e-4)
    assert robot.length == pytest.approx(plan.needle_length_mm, abs=1e-9)
    moves = program_of(plan).moves
    path = [plan.approach.q[0], *(move.q for move in moves)]
    lengths = [np.abs(b - a).max() for a, b in pairwise(path)]
    took = sum(far / m.speed + m.speed / m.acceleration for far, m in zip(lengths, moves, strict=True))
    assert took == pytest.approx(plan.approach.duration_s, rel=1e-6)
    assert max(move.acceleration for move in moves) <= UR3.max_acceleration * (1 + 1e-9)
    found = program_of(plan, np.array([3.0, 2.0]))
    assert 9.5 < found.insertion_mm_s <= 10.0
    takes = STANDOFF_MM / found.insertion_mm_s + found.insertion_mm_s / found.insertion_mm_s2
    assert takes == pytest.approx(plan.insertion.duration_s, rel=1e-6)
    assert [move.blend_mm for move in found.moves] == [3.0, 2.0, 0.0]
    assert f"movel(target_m, a={found.insertion_mm_s2 / 1000:.12f}, v={found.insertion_mm_s / 1000:.12f})" in script(
        plan
    )
    lines = script(plan).splitlines()
    assert lines[0] == "def puncture():" and lines[-1] == "end"
    assert all(line.startswith("  ") or line == "" for line in lines[1:-1])
    assert [line for line in lines if "research software, not a medical device" in line]
    assert script(plan).isascii()
    body = "\n".join(line for line in script(plan).splitlines() if not line.startswith("  #"))
    assert not re.search(r"\d[eE][-+]?\d|nan|inf\b", body)
    assert "-0.000000000000" not in body


def test_a_contact_stops_the_insertion_and_it_retracts(plan):
    robot = Controller(plan.approach.q[0], contact=0.4)
    assert robot.run(script(plan))
    assert kinds(robot)[-6:] == ["movel", "popup", "kill", "stopl", "popup", "movel", "stopl"][-6:]
    assert robot.events[-3] == ("popup", "Stopped", True)
    tips = tip_poses(UR3, np.array(robot.way), plan.needle_length_mm)[:, :3, 3] - plan.T_base_ct[:3, 3]
    assert np.linalg.norm(tips - plan.target_ct, axis=1).min() == pytest.approx(0.6 * STANDOFF_MM, abs=0.5)
    np.testing.assert_allclose(robot.q, plan.insertion.q[0], atol=1e-4)


@pytest.mark.parametrize("joint", range(6))
def test_an_arm_elsewhere_is_not_moved(plan, joint):
    """A joint 0.003 rad off, or a whole turn: the program says so and ends; 0.001 rad is close enough."""
    for off, runs in ((0.003, False), (2 * math.pi, False), (0.001, True)):
        robot = Controller(plan.approach.q[0] + off * np.eye(6)[joint])
        assert robot.run(script(plan)) is runs
        if not runs:
            assert robot.events == [("popup", "Refused", True)]


@pytest.mark.parametrize("name", sorted(set(UR_MODELS) - {"ur3"}))
def test_another_arm_is_not_moved(plan, name):
    robot = Controller(plan.approach.q[0], model=ur_model(name))
    try:
        ended = robot.run(script(plan))
    except ValueError:  # this arm does not reach the target at all: a real controller stops with its own error
        ended = False
    assert not ended
    assert "movej" not in kinds(robot)


def test_an_arm_that_moved_while_it_waited_inserts_nothing(plan):
    def push(robot):
        robot.q = robot.q + 0.01

    robot = Controller(plan.approach.q[0], operator=push)
    assert not robot.run(script(plan))
    assert kinds(robot) == ["movej"] * 3 + ["movel", "popup", "popup"]


def test_a_smooth_approach_is_streamed_and_none_has_no_moves(smooth, plan):
    assert len(waypoint_rows(smooth)) == 0
    text = script(smooth)
    check_program(read_urscript(text, where=SOURCE), smooth, where=SOURCE)
    robot = Controller(smooth.approach.q[0])
    assert robot.run(text)
    assert kinds(robot) == ["servoj", "stopj", "movel", "popup", "movel", "stopl", "popup", "movel", "stopl"]
    assert off_way_mm(UR3, smooth.approach.q, robot.way) < 1e-6
    there = replace(plan, approach=Trajectory(np.array([0.0, 1.0]), np.stack([plan.insertion.q[0]] * 2)))
    robot = Controller(plan.insertion.q[0])
    text = script(there)
    check_program(read_urscript(text, where=SOURCE), there, where=SOURCE)
    assert robot.run(text)
    assert kinds(robot) == ["movel", "popup", "movel", "stopl", "popup", "movel", "stopl"]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**31), st.integers(2, 7))
def test_waypoints_are_found_again(seed, count):
    """From the samples alone, every corner of a random path, with one that turns straight back."""
    waypoints = np.random.default_rng(seed).uniform(-2.0, 2.0, (count, 6))
    waypoints = np.concatenate([waypoints, 0.5 * (waypoints[-2:-1] + waypoints[-1:])])
    path = follow(HALF, waypoints)
    rows = corner_rows(path.q)
    np.testing.assert_allclose(path.q[rows], waypoints, atol=1e-12)
    assert rests_at(UR3, path, rows[1:-1])


def test_a_way_back_within_the_way_is_found():
    """Forth, back and forth again on one line, all of it between its ends: both turns are waypoints."""
    way = np.array([1.0, -0.5, 0.2, 0.0, 0.3, 0.1])
    waypoints = HOME + np.array([[0.0], [0.8], [0.3], [1.0]]) * way
    path = follow(UR3, waypoints)
    np.testing.assert_allclose(path.q[corner_rows(path.q)], waypoints, atol=1e-12)


def test_accelerations_are_held_to_the_limit_alone(plan):
    """A motion well below every speed limit, but 1 % above the acceleration's, is refused; at it, it is not."""
    for factor, caught in ((1.0, False), (1.005**-1, True)):
        part = Trajectory(plan.approach.times_s * factor, plan.approach.q)
        assert (part.peaks().speed < 0.7 * UR3.max_speeds).all()
        try:
            check_trajectory(UR3, part, time_resolution_s=1e-9, what="approach", where=SOURCE)
        except InputError as error:
            assert caught and "rad/s^2" in str(error)
        else:
            assert not caught


def free_checker(*boxes):
    return CellChecker(UR3, TOOL, boxes)


def test_corners_are_rounded_only_where_all_is_free(plan):
    waypoints = plan.approach.q[waypoint_rows(plan)]
    free = blend_radii_mm(free_checker(), waypoints)
    assert (free == 5.0).all()
    corner = waypoints[1]
    tips = tip_poses(UR3, np.stack([waypoints[0], corner, waypoints[2]]), TOOL.needle_length_mm)[:, :3, 3]
    inward = sum((t - tips[1]) / np.linalg.norm(t - tips[1]) for t in tips[[0, 2]])
    T = np.eye(4)
    T[:3, 3] = tips[1] + 1.5 * inward / np.linalg.norm(inward)
    blocked = free_checker(Box("pin", T, (0.4, 0.4, 0.4)))
    on_path = [waypoints[0] + s * (corner - waypoints[0]) for s in np.linspace(0.97, 1.0, 40)]
    assert all(blocked.contact(q, needle_may_touch_patient=False) is None for q in on_path)
    np.testing.assert_array_equal(blend_radii_mm(blocked, waypoints)[1], 5.0)
    assert blend_radii_mm(blocked, waypoints)[0] < 5.0
    turned = BENT + [0, 0, 0, 0, 0, 1.0]
    assert blend_radii_mm(free_checker(), np.stack([turned + 0.2, turned, BENT])).tolist() == [0.0]


@pytest.mark.parametrize("name", FORMATS)
def test_what_is_exported_is_the_plan(plan, smooth, name, tmp_path):
    for number, one in enumerate((plan, smooth)):
        source = tmp_path / f"plan{number}.json"
        write_plan(one, source)
        done = export_plan(read_plan(source), name, tmp_path / "out", source=source)
        text = done.path.read_text(encoding="ascii")
        if name == "urscript":
            check_program(read_urscript(text, where=source), one, where=source)
        else:
            read = read_csv(text, where=source) if name == "csv" else read_ros2(text, UR3, where=source)
            check_sampled(read, one, time_resolution_s=1e-9, where=source)
    assert len(list((tmp_path / "out").iterdir())) == 2


@pytest.fixture
def package(tmp_path, monkeypatch):
    def install(text, names="degrees = own_format:DEGREES"):
        (tmp_path / "own.dist-info").mkdir()
        (tmp_path / "own.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: own\nVersion: 1\n")
        (tmp_path / "own.dist-info" / "entry_points.txt").write_text(f"[{GROUP}]\n{names}\n")
        (tmp_path / "own_format.py").write_text(text)
        monkeypatch.syspath_prepend(tmp_path)
        monkeypatch.delitem(sys.modules, "own_format", raising=False)

    return install


EXAMPLE = (ROOT / "examples" / "06_export_your_own_format.py").read_text(encoding="utf-8")


def test_a_package_adds_a_format(plan, package, tmp_path):
    package(EXAMPLE)
    refuse_format("degrees")
    done = export_plan(plan, "degrees", tmp_path / "out", source=SOURCE)
    assert (done.path.name, done.notes) == ("plan.degrees.txt", ("the insertion is for the operator to start",))
    last = np.array(done.path.read_text().split("\n\n")[1].split()[-6:], float)
    np.testing.assert_allclose(np.radians(last), plan.insertion.q[-1], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new"),
    [("np.degrees(one.q)", "np.degrees(one.q) + 1e-6"), ("np.radians(block[:, 1:])", "block[:, 1:]")],
    ids=["written wrong", "read wrong"],
)
def test_a_package_that_writes_another_motion_is_refused(plan, package, tmp_path, old, new):
    package(EXAMPLE.replace(old, new))
    with pytest.raises(InputError):
        export_plan(plan, "degrees", tmp_path / "out", source=SOURCE)
    assert list((tmp_path / "out").glob("*")) == []


@pytest.mark.parametrize(
    ("text", "name", "code"),
    [
        (EXAMPLE, "radians", "unknown_format"),
        ("DEGREES = 1\n", "degrees", "no_exporter"),
        ("import nothing_of_that_name\n", "degrees", "no_exporter"),
        ("", "degrees", "no_exporter"),
        (EXAMPLE.replace(".degrees.txt", ".json"), "degrees", "no_exporter"),
    ],
    ids=["another name", "no exporter", "no import", "no such name", "the plan's own name"],
)
def test_a_package_without_an_exporter_is_refused(plan, package, tmp_path, text, name, code):
    package(text)
    with pytest.raises(InputError) as refused:
        export_plan(plan, name, tmp_path / "out", source=SOURCE)
    assert refused.value.code == code and not (tmp_path / "out").exists()


def test_a_package_takes_no_name_of_ours(plan, package, tmp_path):
    package(EXAMPLE, "csv = own_format:DEGREES")
    assert export_plan(plan, "csv", tmp_path / "out", source=SOURCE).path.name == "plan.csv"


def test_table_and_messages_are_exact(plan):
    read = read_csv(csv_text(plan, case_checked=True), where=SOURCE)
    for phase in ("approach", "insertion"):
        np.testing.assert_array_equal(getattr(read, phase).q, getattr(plan, phase).q)
        np.testing.assert_array_equal(getattr(read, phase).times_s, getattr(plan, phase).times_s)
    text = ros2_text(plan, case_checked=True)
    assert text.count(f"joint_names: [{', '.join(JOINT_NAMES)}]") == 2
    read = read_ros2(text, UR3, where=SOURCE)
    np.testing.assert_allclose(read.approach.times_s, plan.approach.times_s, rtol=0, atol=0.51e-9)
    numbers = re.findall(r"(?:positions|velocities): \[([^]]*)\]", text)
    assert all(re.fullmatch(r"-?\d+\.\d+(e[-+]\d+)?", n) for row in numbers for n in row.split(", "))
    assert all(int(n) < 1_000_000_000 for n in re.findall(r"nanosec: (\d+)", text))
    path = plan.approach
    speeds = velocities(UR3, path)
    rests = corner_rows(path.q)
    assert (speeds[rests] == 0.0).all()
    slopes = np.diff(path.q, axis=0) / np.diff(path.times_s)[:, None]
    assert (np.abs(speeds[1:] - slopes).max(axis=0) <= UR3.max_acceleration * 0.008).all()
    fine = np.linspace(0.0, path.duration_s, 20_001)
    cubic = CubicHermiteSpline(path.times_s, path.q, speeds)(fine)
    after = np.clip(np.searchsorted(path.times_s, fine), 1, len(path.q) - 1)
    low, high = (f(path.q[after - 1], path.q[after]) for f in (np.minimum, np.maximum))
    assert (cubic >= low - 1e-12).all() and (cubic <= high + 1e-12).all()
    ends = CubicHermiteSpline(path.times_s, path.q, speeds).derivative(2)
    bends = [ends(path.times_s[:-1] + 1e-9), ends(path.times_s[1:] - 1e-9)]
    assert np.abs(bends).max() <= UR3.max_acceleration * (1 + 1e-5)


def hurried(plan, phase, factor):
    part = getattr(plan, phase)
    return replace(plan, **{phase: Trajectory(part.times_s * factor, part.q)})


def bent_elbow(plan, angle=3.2):
    waypoints = plan.approach.q[corner_rows(plan.approach.q)].copy()
    waypoints[1, 2] = angle
    return replace(plan, approach=follow(HALF, waypoints))


def branch_change(plan):
    """The plan with an insertion that changes its branch half way, slowly: every sample has its tip on the line."""
    q = plan.insertion.q
    other = next(row for row in inverse(UR3, flange_pose(UR3, q[-1]))[0] if np.abs(row - q[-1]).max() > 0.5)
    times = np.append(plan.insertion.times_s[: len(q) // 2], 1000.0)
    return replace(plan, insertion=Trajectory(times, np.concatenate([q[: len(q) // 2], other[None]])))


NOT_EXPORTED = {
    "a hurried approach": (lambda p: hurried(p, "approach", 0.6), "tip_too_fast"),
    "a hurried insertion": (lambda p: hurried(p, "insertion", 0.05), "tip_too_fast"),
    "an elbow beyond half a turn": (bent_elbow, "joint_beyond_limits"),
    "an elbow whose limit was rounded away": (lambda p: bent_elbow(p, math.pi + 1e-8), "joint_beyond_limits"),
    "a swing through the patient between two samples on the line": (branch_change, "not_straight"),
    "another target": (lambda p: replace(p, target_ct=p.target_ct + 1.0), "not_straight"),
    "no needle": (lambda p: replace(p, needle_length_mm=math.nan), "not_straight"),
    "another needle": (lambda p: replace(p, needle_length_mm=p.needle_length_mm + 1.0), "not_straight"),
}


@pytest.mark.parametrize("name", FORMATS)
@pytest.mark.parametrize("what", NOT_EXPORTED)
def test_a_plan_beyond_the_limits_or_that_contradicts_itself_is_not_exported(plan, what, name, tmp_path):
    change, message = NOT_EXPORTED[what]
    with refused(message):
        export_plan(change(plan), name, tmp_path / "out", source=tmp_path / "plan.json")
    assert not (tmp_path / "out").exists()


def test_a_program_ends_on_the_plans_own_branch(plan):
    changed = branch_change(plan)
    with refused("not_read_back"):
        check_program(read_urscript(script(changed), where=SOURCE), changed, where=SOURCE)


@pytest.mark.parametrize("name", FORMATS)
def test_a_plan_at_its_limits_and_tiny_and_turning_segments_are_exported(name, tmp_path):
    """Full speed, the elbow and a wrist at the very end of their range: not refused for rounding."""
    waypoints, small = WAYPOINTS.copy(), np.stack([HOME, HOME + 1e-7, HOME + 0.3, HOME + 0.1, HOME + 0.1 + 1e-5])
    waypoints[1, 2], waypoints[1, 5] = math.pi, 2 * math.pi
    fast, slow = plan_to(waypoints, arm=UR3), plan_to(WAYPOINTS[:1] + 1e-7, tip_mm_s=0.5)
    for one in (fast, slow, plan_to(small)):
        assert export_plan(one, name, tmp_path, source=tmp_path / "plan.json").path.is_file()


NAMES = [
    'x"); halt #',
    "a\nmovej([0,0,0,0,0,0])\n",
    "\u202eевил\x00",
    "'''",
    "case: {a: [}",
    "=cmd|'/c calc'!A1",
    "l" * 10_000,
]


@pytest.mark.parametrize("name", NAMES)
def test_a_name_stays_in_its_comment(plan, name, tmp_path):
    odd = replace(plan, case_name=name, inputs=(Input(name, name, name),))
    for one in FORMATS:
        texts = [
            export_plan(p, one, tmp_path / str(n), source=Path("plan.json")).path.read_text(encoding="ascii")
            for n, p in enumerate((plan, odd))
        ]
        bodies = [[line for line in text.splitlines() if not line.lstrip().startswith("#")] for text in texts]
        assert bodies[0] == bodies[1]
        lines = [line.strip() for line in texts[1].splitlines()]
        comments = [line[2:] for line in lines if line.startswith(("# case:", "# input:"))]
        assert len(comments) >= 2
        assert set("".join(comments)) <= PLAIN and max(map(len, comments)) < 600


DOUBT = "markers_ct with x and y negated, as LPS and RAS differ, would lie on the skin; 'too alike' to tell \"; halt"


@pytest.mark.parametrize("name", FORMATS)
def test_warnings_stand_whole_in_every_file(plan, name, tmp_path):
    said = {(DOUBT, "a\nb"): "2 warnings when this was planned:", (): "warnings when this was planned: none"}
    bodies = []
    for number, (warnings, line) in enumerate(said.items()):
        path = export_plan(replace(plan, warnings=warnings), name, tmp_path / str(number), source=SOURCE).path
        lines = [one.strip() for one in path.read_text(encoding="ascii").splitlines()]
        assert [one for one in lines if one.startswith(f"# {line}")]
        bodies.append([one for one in lines if not one.startswith(("#", "popup("))])
        if warnings:
            comment = " ".join(one[2:] for one in lines if one.startswith("# "))
            assert "would lie on the skin, too alike to tell" in comment and "warning: a_b" in comment
    assert bodies[0] == bodies[1]


@pytest.mark.parametrize(
    ("warnings", "words"),
    [
        ((), ""),
        ((DOUBT, "another"), "2 warnings: markers_ct with x and y negated, as LPS and RAS differ, "),
        (("x" * 500,), "1 warning: ... See the program. "),
    ],
)
def test_the_operator_is_told_of_warnings_before_the_insertion(plan, warnings, words):
    """In the popup that waits at the standoff: how many, and the first words; the program still reads back."""
    doubted = replace(plan, warnings=warnings)
    text = urscript_text(program_of(doubted), doubted, case_checked=True)
    (popup,) = [line for line in text.splitlines() if line.startswith('  popup("Needle at standoff.')]
    assert popup.startswith(f'  popup("Needle at standoff. {words}')
    assert popup.endswith('Continue inserts it.", title="Insertion", blocking=True)')
    assert popup.count('"') == 4 and len(popup) < 250
    check_program(read_urscript(text, where=SOURCE), doubted, None, where=SOURCE)


TAMPERED = {
    "no wait": (lambda t: re.sub(r'  popup\("Needle.*\n', "", t), "insertion_unguarded"),
    "a wait after the insertion": (
        lambda t: re.sub(r'(  popup\("Needle.*\n)((?:.*\n)*?)(    movel\(target_m.*\n)', r"\2\3\1", t),
        "insertion_unguarded",
    ),
    "no guard": (
        lambda t: t.replace("if tool_contact(direction=get_target_tcp_speed()) > 0:", "if False:"),
        "insertion_unguarded",
    ),
    "a faster way back": (
        lambda t: re.sub(r"    movel\(standoff_m, a=0.", "    movel(standoff_m, a=1.", t),
        "insertion_unguarded",
    ),
    "no thread": (lambda t: t.replace("  insertion = run insert()\n", ""), "insertion_unguarded"),
    "a joint changed": (lambda t: t.replace("  movej([0.3000", "  movej([0.3001"), "not_read_back"),
    "a blend at the end": (lambda t: re.sub(r"r=0\.0+\)(?!(?:.*\n)+  movej)", "r=0.010000000000)", t), "not_read_back"),
    "another target": (lambda t: re.sub(r"target_m = p\[.", "target_m = p[-1", t), "not_read_back"),
    "another move": (lambda t: t.replace("  stopl", "  movel(start_q)\n  stopl"), "not_read_back"),
    "a fast insertion": (
        lambda t: re.sub(r"(movel\(target_m, a=)[\d.]+(, v=)[\d.]+", r"\g<1>90.0\g<2>9.0", t),
        "insertion_unguarded",
    ),
    "a fast approach": (lambda t: re.sub(r"v=\d\.\d+(, r=)", r"v=9.0\1", t), "not_read_back"),
    "a blend that nobody looked at": (lambda t: t.replace("r=0.0000", "r=0.0020", 1), "not_read_back"),
    "no speed at all": (lambda t: re.sub(r"v=\d\.\d+(, r=)", r"v=0.0\1", t), "not_read_back"),
    "another tool": (lambda t: t.replace("0.250000000000, 0.0", "0.200000000000, 0.0"), "not_read_back"),
}


@pytest.mark.parametrize("what", TAMPERED)
def test_a_program_that_is_not_the_plan_does_not_read_back(plan, what):
    change, message = TAMPERED[what]
    text = script(plan)
    assert change(text) != text
    with refused(*message.split()):
        check_program(read_urscript(change(text), where=SOURCE), plan, where=SOURCE)


SAMPLED = {"ros2": (ros2_text, partial(read_ros2, model=UR3), 1e-9), "csv": (csv_text, read_csv, 0.0)}
"""Writer, reader, and the resolution of times (s)."""


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("ros2", lambda t: t.replace("elbow_joint, wrist_1_joint", "wrist_1_joint, elbow_joint"), "missing_message"),
        ("ros2", lambda t: t.replace("insertion:", "retraction:"), "missing_message"),
        ("ros2", lambda t: t.replace("sec: 0, nanosec: 0}}\n", "sec: 0, nanosec: 1}}\n", 1), "times_not_rising"),
        ("ros2", lambda t: re.sub(r"positions: \[[^,]*,", "positions: [", t, count=1), "bad_value"),
        ("ros2", lambda t: re.sub(r"positions: \[[^,]*,", "positions: [nan,", t, count=1), "not_finite"),
        ("ros2", lambda t: re.sub(r"positions: \[[^,]*,", "positions: [0.1,", t, count=1), "not_read_back"),
        (
            *("ros2", lambda t: re.sub(r"velocities: \[[^,]*,", "velocities: [99.0,", t, count=1)),
            "joint_too_fast shoulder_pan_joint 99",
        ),
        ("ros2", lambda t: t + "    - {}\n", "wrong_format"),
        ("csv", lambda t: t.replace("q1_rad,q2_rad", "q2_rad,q1_rad"), "wrong_columns"),
        ("csv", lambda t: t + "retraction,0,0,0,0,0,0,0\n", "unknown_name retraction"),
        ("csv", lambda t: t + "insertion,99,0,0,0,0,0\n", "ragged_row"),
        ("csv", lambda t: t + "insertion,x,0,0,0,0,0,0\n", "not_a_number"),
        ("csv", lambda t: t + "insertion,99,0,0,0,0,0,0\n", "not_read_back"),
    ],
)
def test_messages_and_tables_that_are_not_the_plan_do_not_read_back(plan, name, change, message):
    write, read, resolution_s = SAMPLED[name]
    text = write(plan, case_checked=False)
    assert change(text) != text
    with refused(*message.split()):
        check_sampled(read(change(text), where=SOURCE), plan, time_resolution_s=resolution_s, where=SOURCE)


def test_samples_closer_than_a_nanosecond_are_refused_for_ros(plan, tmp_path):
    times, q = plan.approach.times_s.copy(), plan.approach.q.copy()
    times[1], q[1] = 1e-10, q[0]
    close = replace(plan, approach=Trajectory(times, q))
    with refused("times_not_rising", "plan.json"):
        export_plan(close, "ros2", tmp_path / "out", source=SOURCE)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", FORMATS)
def test_a_very_long_plan_is_exported(plan, name, tmp_path):
    part = plan.approach
    slow = part.times_s * (1800.0 / part.duration_s)
    times = np.union1d(slow, np.linspace(0.0, 1800.0, 20_000))
    times = times[np.append(True, np.diff(times) > 1e-6)]
    long = replace(plan, approach=Trajectory(times, Trajectory(slow, part.q).at(times)))
    done = export_plan(long, name, tmp_path, source=SOURCE)
    if name == "csv":
        assert len(read_csv(done.path.read_text(), where=SOURCE).approach.q) == len(times)


@pytest.mark.parametrize("name", ["urscript", "ros2"])
def test_absurd_times_are_refused_in_bounded_work(plan, smooth, name, tmp_path):
    part = smooth.approach
    century = Trajectory(np.append(part.times_s, 3e9), np.concatenate([part.q, part.q[-1:]]))
    approach = replace(smooth, approach=century)
    for one in (hurried(plan, "insertion", 3e9), approach):
        with refused("not_read_back" if name == "urscript" and one is not approach else "too_long"):
            export_plan(one, name, tmp_path / "out", source=SOURCE)
    assert not (tmp_path / "out").exists()
