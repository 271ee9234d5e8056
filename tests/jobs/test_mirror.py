"""The mirror of a running arm: what it shows, what it refuses, and that it never sends anything."""

import importlib.util
import itertools
import json
import sys
import time
from types import SimpleNamespace

import numpy as np
import pytest
from refusals import refused, refused_command
from rtde_server import PERIOD_S, START_S, rtde_server

from puncture_twin import run_twin
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.insertion import ReachRequest
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.base.files import sha256
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.formats.points import read_points
from puncture_twin.planning.geometry.spaces import Unit
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.planning.registration.marker_noise import touches
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.twin.jobs.live import mirror

ABDOMEN = folder() / "abdomen"
HOST = "127.0.0.47"  # a loopback address of its own, so that a controller's ports are free there
COLUMNS = "time_s,q1_rad,q2_rad,q3_rad,q4_rad,q5_rad,q6_rad"
needs_the_extra = pytest.mark.skipif(
    importlib.util.find_spec("rtde_receive") is None, reason="ur-rtde is not installed: pip install '.[mirror]'"
)


class FakeArm:
    """Reads like a robot, row after row, and stays at the last where it `stays`; all but its readings is an error."""

    def __init__(self, rows, *, time=100.0, step_s=0.5, connected=True, stays=False):
        self.rows, self.time, self.step_s, self.connected, self.stays = list(rows), time, step_s, connected, stays

    def getActualQ(self):  # noqa: N802
        return self.rows[0] if self.stays and len(self.rows) == 1 else self.rows.pop(0)

    def getTimestamp(self):  # noqa: N802
        self.time += self.step_s
        return self.time

    def isConnected(self):  # noqa: N802
        return self.connected


@pytest.fixture(scope="module")
def drive():
    """A straight insertion of the abdomen's arm from the front of the body, (m, 6) rad, with its tip distances."""
    case = load_case(ABDOMEN)
    T = load_placement(case).T_base_ct
    target = T[:3, :3] @ case.target_ct + T[:3, 3]
    model = ur_model("ur3")

    checker = CellChecker(model, case_tool(case))
    for tilt in np.linspace(-0.6, 0.6, 13):
        u = T[:3, :3] @ [-np.sin(abs(tilt)), -np.cos(tilt), 0.0]
        answer = assess_reach_all(checker, [ReachRequest(target, u / np.linalg.norm(u), 210.0, 120.0)])[0]
        if answer.reachable:
            return answer
    raise AssertionError("the arm must hold some of these")


def test_the_tip_comes_straight_to_the_target(drive):
    """Along an insertion the target stays on the needle's line, and the distance is the standoff less the depth."""
    shown = mirror.Mirror.of(load_case(ABDOMEN))
    for q, depth in zip(drive.insertion_q, drive.insertion_depth_mm, strict=True):
        one = shown.show(mirror.RecordedState(0.0, q))
        assert one.off_axis_mm < 1e-6 and one.to_target_mm == pytest.approx(120.0 - depth, abs=1e-6)


def test_a_live_arm_is_read_until_its_time_is_over(drive):
    """By the robot's clock: four readings in 1.5 seconds."""
    arm = FakeArm([list(drive.insertion_q[0])] * 9)
    states = list(mirror.live_states(arm, period_s=0.0, seconds=1.5))
    assert [state.time_s for state in states] == [100.5, 101.0, 101.5, 102.0]


def test_joint_angles_that_are_none_are_refused():
    for row in ([0.0] * 5, [0.0] * 5 + [np.nan]):
        with refused("joints"):
            next(mirror.live_states(FakeArm([row]), period_s=0.0, seconds=None))


@pytest.mark.parametrize("connected", [False, True])
def test_an_old_state_is_not_shown_again(monkeypatch, connected):
    """The last word of a robot that is gone must not look like an arm that stands still."""
    monkeypatch.setattr(mirror, "SILENCE_S", 0.05)
    silent = FakeArm(
        [[0.0] * 6] * 1000, time=7.5, step_s=0.0, connected=connected
    )  # as the library once the line is gone
    states = mirror.live_states(silent, period_s=0.001, seconds=None)
    assert next(states).time_s == 7.5
    with refused("robot_silent", "7.500"):
        next(states)


def test_before_the_first_word_nothing_is_shown():
    """Time 0 and angles 0 are what the library has before it has heard anything."""
    arm = FakeArm([[0.0] * 6, [0.1] * 6])
    times = iter([0.0, 3.0])
    arm.getTimestamp = lambda: next(times)
    state = next(mirror.live_states(arm, period_s=0.0, seconds=None))
    assert state.time_s == 3.0 and state.q[0] == 0.1


@pytest.fixture(scope="module")
def rows(drive):
    """The drive as a controller would tell it, 125 times a second for four seconds."""
    q = drive.insertion_q
    at = np.linspace(0.0, len(q) - 1.0, 500)
    return np.stack([np.interp(at, np.arange(len(q)), q[:, joint]) for joint in range(6)], axis=1)


@needs_the_extra
def test_a_controller_is_mirrored_as_its_recording_is(rows, tmp_path, run):
    """Through ur-rtde itself: the same tips. The controller is sent four packages that set up the reading, no more."""
    recording = tmp_path / "joints.csv"
    lines = [f"{START_S + i * PERIOD_S!r},{','.join(map(repr, map(float, q)))}" for i, q in enumerate(rows)]
    recording.write_text("\n".join([COLUMNS, *lines]))
    _, recorded = run("mirror", "--case", ABDOMEN, "--from", recording)
    with rtde_server(HOST, rows) as controller:
        code, live = run("mirror", HOST, "--case", ABDOMEN, "--seconds", 0.5, "--rate", 50)
    said = live["states"]
    assert code == 0 and len(said) >= 5 and said[-1]["time_s"] - said[0]["time_s"] > 0.3
    by_joints = {tuple(one["q_deg"]): one for one in recorded["states"]}
    for one in said:
        same = by_joints[tuple(one["q_deg"])]  # bit for bit the recording's
        assert one["time_s"] == pytest.approx(same["time_s"], abs=1.5 * PERIOD_S)
        assert {**one, "time_s": 0} == {**same, "time_s": 0}
    assert "".join(kind for kind, _ in controller.received) == "VvOS"  # an input's setup would be an I, its data a U
    assert controller.received[2][1][8:].decode().strip(",") == "timestamp,actual_q"
    assert controller.knocks == []  # no dashboard, no interface that takes programs


@needs_the_extra
@pytest.mark.parametrize("order", ["hang up", "hang"])
def test_a_controller_that_stops_ends_the_mirror(rows, order):
    with rtde_server(HOST, rows) as controller:
        states = mirror.live_states(mirror.connect(HOST), period_s=0.02, seconds=None)
        assert len(list(itertools.islice(states, 3))) == 3
        controller.order(order)
        with refused("robot_silent"):
            list(states)


@needs_the_extra
def test_a_host_without_a_robot_is_one_line(capfd):
    assert run_twin.main(["mirror", HOST, "--case", str(ABDOMEN)]) == 2
    said = capfd.readouterr().err.strip()
    assert "the robot does not answer" in said and f"mirror {HOST}, port 30004" in said and len(said.splitlines()) == 1


def test_a_recording_is_mirrored(drive, tmp_path, capsys):
    """As `export --format csv` writes it, comments and other columns and all; text a line a state, JSON one object."""
    path = tmp_path / "joints.csv"
    rows = [f"{i * 0.1},{','.join(map(repr, map(float, q)))}" for i, q in enumerate(drive.insertion_q[-2:])]
    phases = [f"approach,{rows[1]}", *(f"insertion,{row}" for row in rows)]  # it begins again at 0 s
    path.write_text("\n".join(["# a comment", f"phase,{COLUMNS}", *phases]))
    assert run_twin.main(["mirror", "--case", str(ABDOMEN), "--from", str(path)]) == 0
    captured = capsys.readouterr()
    assert "joints.csv: its last line has no line break at its end; was the file cut?" in captured.err
    lines = captured.out.strip().splitlines()
    assert len(lines) == 3 and "to target    0.00 mm" in lines[-1]
    assert run_twin.main(["mirror", "--case", str(ABDOMEN), "--from", str(path), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    listed = {one["role"]: one for one in document["inputs"]}
    assert listed["recording"] == {"role": "recording", "path": "joints.csv", "sha256": sha256(path)}
    assert "case" in listed and len(listed) > 2
    said = document["states"]
    np.testing.assert_allclose(said[-1]["tip_ct_mm"], load_case(ABDOMEN).target_ct, atol=1e-6)
    np.testing.assert_allclose(np.radians(said[-1]["q_deg"]), drive.insertion_q[-1], atol=1e-12)


def test_recordings_that_cannot_be_read_are_refused(tmp_path):
    wrong = {"time_s,q1_rad\n0,0\n": "missing_column q2_rad", f"{COLUMNS}\n0,0,0,x,0,0,0\n": "not_a_number"}
    path = tmp_path / "joints.csv"
    with refused("no_such_file"):
        mirror.recorded(path)
    for text, said in wrong.items():
        path.write_text(text)
        with refused(*said.split()):
            mirror.recorded(path)


@pytest.mark.parametrize(("model", "exits"), [("ur3", 0), ("ur3e", 2)])
def test_an_rtde_recording_is_mirrored_if_it_is_of_the_case_s_arm(drive, tmp_path, capsys, model, exits):
    """RTDE's own headers; the controller's pose beside its joints tells a UR3e from the case's UR3."""
    poses = flange_pose(ur_model(model), drive.insertion_q)[:, :3, 3] / 1000.0
    names = ["timestamp", *(f"actual_q_{k}" for k in range(6)), *(f"actual_TCP_pose_{k}" for k in range(3))]
    rows = [
        " ".join(map(repr, [0.008 * i, *map(float, q), *map(float, place)]))
        for i, (q, place) in enumerate(zip(drive.insertion_q, poses, strict=True))
    ]
    path = tmp_path / "robot_data.csv"
    path.write_text("\n".join([" ".join(names), *rows, ""]))
    assert run_twin.main(["mirror", "--case", str(ABDOMEN), "--from", str(path)]) == exits
    said = capsys.readouterr()
    if exits:
        assert "those of a ur3e do not" in said.err and len(said.err.splitlines()) == 1 and not said.out
    else:
        assert "to target    0.00 mm" in said.out.splitlines()[-1]


def test_without_the_extra_one_line_says_what_to_install(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "rtde_receive", None)
    refused_command(["mirror", "192.0.2.1", "--case", ABDOMEN], capsys, "missing_extra", "mirror")


def test_one_arm_at_a_time(capsys):
    refused_command(["mirror", "--case", ABDOMEN], capsys, "conflicting_options")


def test_only_the_receiving_half_is_ever_named():
    """The library's controlling half stands nowhere in what reads a robot."""
    files = [*(folder().parent / "twin" / "jobs" / "live").glob("*.py")]
    text = "".join(one.read_text() for one in files)
    assert "rtde_receive" in text and not any(word in text for word in ("rtde_control", "rtde_io", "RTDEControl"))


def test_a_led_arm_is_read_at_rest():
    """Not while it moves: the mean of half a second in which no joint turned; `move_jp` passes over other rests."""
    moving = np.linspace(0.0, 1.0, 50)[:, None] * np.ones(6)
    rest, noise = np.full(6, 1.2), np.random.default_rng(0).uniform(-1e-4, 1e-4, (60, 6))
    arm = mirror.LedArm(FakeArm([*moving, *(rest + noise), rest], step_s=0.01, stays=True), period_s=0.0)
    q = arm.measured_jp()
    assert 0.0 < np.abs(q - rest).max() < 2e-5  # of the mean of fifty readings
    elsewhere = np.full((80, 6), 0.3)
    arm = mirror.LedArm(FakeArm([*elsewhere, *moving, rest], step_s=0.01, stays=True), period_s=0.0)
    arm.move_jp(rest + np.radians(0.4))
    np.testing.assert_allclose(arm.measured_jp(), rest, atol=1e-12)


def test_an_arm_that_nobody_leads_is_not_waited_for_without_end(monkeypatch):
    monkeypatch.setattr(mirror, "LED_S", 3.0)
    for rows in ([np.zeros(6)], np.linspace(0.0, 5.0, 400)[:, None] * np.ones(6)):
        with pytest.raises(NoAnswerError) as error:
            mirror.LedArm(FakeArm(rows, step_s=0.01, stays=True), period_s=0.0).move_jp(np.ones(6) * 2.0)
        assert error.value.code == "not_led"


@pytest.fixture(scope="module")
def touched_q():
    case = load_case(ABDOMEN)
    placement = load_placement(case)
    markers = placement.registration.markers
    return case, markers, touches(case, markers)


@needs_the_extra
def test_markers_are_read_off_a_controller(touched_q, tmp_path, run, monkeypatch):
    """Through ur-rtde: `touch.csv` is what the nominal arm computes of the joints, and registers; nothing is sent."""
    case, markers, q = touched_q
    monkeypatch.setattr(mirror, "STILL_S", 0.2)
    called, lines = [], iter(q)

    def connected(*args, connect=mirror.connect):
        called.append(connect(*args))
        return called[0]

    class Terminal:
        def readline(self):
            place = next(lines)
            while np.abs(np.array(called[0].getActualQ()) - place).max() > 1e-9:
                time.sleep(0.005)
            return "\n"

    monkeypatch.setattr(mirror, "connect", connected)
    monkeypatch.setattr(sys, "stdin", Terminal())
    with rtde_server(HOST, np.repeat(q, 250, axis=0)) as controller:
        code, said = run("touch", ABDOMEN, "--host", HOST, "--out", tmp_path)
    assert code == 0 and said["suffices"]
    read = read_points(tmp_path / "touch.csv", default_unit=Unit.MM)
    listed = [markers.names.index(name) for name in read.names]
    np.testing.assert_allclose(read.joints, q[listed], atol=1e-9)
    flange = flange_pose(case.robot.model, q[listed])
    np.testing.assert_allclose(read.points, (flange @ [0.0, 0.0, case.needle.length_mm, 1.0])[:, :3], atol=1e-6)
    assert said["fre_mm"] == pytest.approx(0.0, abs=3.0)
    assert "".join(kind for kind, _ in controller.received) == "VvOS"


def test_too_few_touches_by_hand(touched_q, tmp_path):
    """None is refused; two are kept, and do not register: the rest is named."""
    case, markers, q = touched_q
    arm, answers = SimpleNamespace(measured_jp=iter(q).__next__), iter([True, True, False])
    with refused("empty"):
        mirror.touch_by_hand(case, arm, lambda _: False, tmp_path)
    assert not list(tmp_path.iterdir())
    read = mirror.touch_by_hand(case, arm, lambda _: next(answers), tmp_path)
    assert not read.suffices and len(read.left_out) == len(markers.names) - 2
    assert read.summary()["fre_mm"] is None and f"not touched: {read.left_out[0]}" in mirror.led_text(read)


def test_no_tour_is_planned_for_an_arm_that_is_led(capsys):
    """A direction or a seed beside --host is refused before anyone is called."""
    for more in (["--seed", "1"], ["--theta", "18", "--beta", "232"]):
        refused_command(["touch", ABDOMEN, "--host", HOST, *more], capsys, "conflicting_options")
