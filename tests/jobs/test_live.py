"""What `live` answers: the map and the verdict are those of the API; what cannot be answered leaves nothing old."""

import json
import shutil
import signal
import socket
import struct
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from case_world import ball, changed, write_case
from igtl_client import Talk, point, text, tools, transform
from places import ROOT
from refusals import refused

import puncture_twin as pt
from puncture_twin.meshes import folder
from puncture_twin.planning.case.case import load_case
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.exit_codes import INTERRUPTED
from puncture_twin.twin.jobs.live.messages import Header, Message, Stamp, packed
from puncture_twin.twin.jobs.live.planner import NO_STRUCTURE, Planner, Question, slack_mm

ABDOMEN = folder() / "abdomen"
RAS = np.array([-1.0, -1.0, 1.0])
STAMP = Stamp(2, 1000, 2**31, 77)
PROGRAM = """
import signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell starts what is in the background without it
from puncture_twin.run_twin import main
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def context():
    return pt.prepare(load_case(ABDOMEN).replace(search={"step_deg": 10.0}))


@pytest.fixture(scope="module")
def planner(context):
    return Planner(context)


def asked(planner, kind, name, content, session=None, stamp=STAMP):
    """The answers to one message, by name; a new target's needle is answered too."""
    subject, session = planner.subject(Header(kind, name, STAMP, len(content), 0)), session or planner.session()
    question, found = Question(1, session, subject, stamp, Message(kind, name, stamp, content)), {}
    while question is not None:
        try:
            found |= {one.name: one.data for one in planner.answers(question)}
        except pt.InputError as error:
            found |= {one.name: one.data for one in planner.refused(question.subject, question.stamp, error)}
        question = planner.needle(session) if question.subject == "target" else None
    for data in found.values():
        assert struct.unpack(">II", data[34:42]) == (stamp.seconds, stamp.fraction)
        assert struct.unpack(">HHII", data[58:70])[3] == stamp.number
    return {name: data[70:-2] for name, data in found.items()}


def document(found, name):
    return json.loads(found[f"STRING {name}"][4:])


def needle(tip_ras, axis_ras):
    z = axis_ras / np.linalg.norm(axis_ras)
    x = np.cross(z, [0.3, 0.5, 0.8])
    x /= np.linalg.norm(x)
    return np.block([[np.column_stack([x, np.cross(z, x), z]), np.reshape(tip_ras, (3, 1))], [0, 0, 0, 1]])


def toward(context, theta_deg, beta_deg, *, off_mm=0.0, out_mm=150.0):
    """The pose of a needle on a direction's path, its tip so far from the target, and so far beside the path."""
    outward = RAS * context.case.direction(*np.radians([[theta_deg], [beta_deg]])).outward_ct[0]
    aside = np.cross(outward, [0.2, 0.9, 0.4])
    tip = RAS * context.case.target_ct + out_mm * outward + off_mm * aside / np.linalg.norm(aside)
    return needle(tip, -outward)


def verdict(planner, pose, **named):
    return document(asked(planner, "TRANSFORM", "Needle", transform(pose), **named), "Verdict")


def test_the_map_is_that_of_the_api_wherever_it_is_drawn(context, planner):
    """Grid and mesh of a target that was moved: verdict and structure; each quad lies about its own direction."""
    target = context.case.target_ct + [2.0, -1.0, 1.5]
    found = asked(planner, "POINT", "Target", point(RAS * target))
    expected = pt.safe_map(context, target)
    directions, n = context.case.directions(), len(expected.blocked)
    assert 0 < expected.blocked.sum() < n
    columns, rows = struct.unpack(">HH", found["IMAGE SafeGrid"][6:10])
    grid = np.frombuffer(found["IMAGE SafeGrid"][72:], "<u2")
    assert (rows, columns) == (len(directions.grid.theta), len(directions.grid.beta))
    assert np.array_equal(grid != 0, expected.blocked)
    assert np.array_equal(grid[expected.blocked] - 1, expected.structure[expected.blocked])

    mesh = found["POLYDATA SafeMap"]
    counts = struct.unpack(">10I", mesh[:40])
    assert counts == (4 * n, 0, 0, 0, 0, n, 20 * n, 0, 0, 2)
    points = np.frombuffer(mesh[40:], ">f4", 12 * n).reshape(n, 4, 3) * RAS - target
    quads = np.frombuffer(mesh[40 + 48 * n :], ">u4", 5 * n).reshape(n, 5)
    assert (quads[:, 0] == 4).all() and np.array_equal(quads[:, 1:].ravel(), np.arange(4 * n))
    assert np.allclose(np.linalg.norm(points, axis=2), context.case.needle.length_mm, atol=1e-3)
    middle = points.mean(axis=1)
    middle /= np.linalg.norm(middle, axis=1)[:, None]
    away = np.degrees(np.arccos(np.clip(np.sum(middle * directions.outward_ct, axis=1), -1, 1)))
    assert away[directions.theta > 1e-6].max() < 0.5 and away.max() < 5.0  # at the pole a cell is half a step wide
    values = np.frombuffer(mesh[-32 * n :], ">f4").reshape(2, n, 4)
    assert (values == values[:, :, :1]).all()
    assert np.array_equal(values[0, :, 0], expected.blocked) and np.array_equal(values[1, :, 0], expected.structure)
    said = document(found, "SafeMapInfo")
    assert said["blocked"] == expected.blocked.sum() and said["structures"] == list(expected.structures)
    assert np.allclose(said["target_ras_mm"], RAS * target, atol=1e-4) and "skin" in said["not_tested"]


def alike(one, other):
    """Whether two documents are the same but for the rounding of an angle to what a person types."""
    if isinstance(one, dict):
        return one.keys() == other.keys() and all(alike(one[key], other[key]) for key in one)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(alike, one, other))
    return one == pytest.approx(other, rel=1e-7, abs=1e-7) if isinstance(one, float) else one == other


def test_the_verdict_is_that_of_check(context, planner, rng):
    """A dozen needles, a target that was moved: every key of `check`, and joints and entry beside it."""
    target = context.case.target_ct + [1.0, 1.0, -2.0]
    session = planner.session()
    asked(planner, "TRANSFORM", "Target", transform(needle(RAS * target, [0, 0, 1])), session)
    at, seen = context.at(np.float32(target).astype(float)), set()
    for theta, beta in zip(rng.uniform(0, 90, 12), rng.uniform(0, 360, 12), strict=True):
        said = verdict(planner, toward(at, theta, beta), session=session)
        known = pt.check(at, said["check"]["theta_deg"], said["check"]["beta_deg"])
        assert abs(said["check"]["theta_deg"] - theta) < 1e-4
        summary = json.loads(json.dumps(known.summary()))
        assert alike(said["check"], {key: summary[key] for key in said["check"]}) and len(said["check"]) > 20
        assert said["verdict"] == known.verdict or said["slack_mm"] < said["off_line_mm"]
        entry, q = known.candidates.path.entry_ct[0], known.candidates.arm.q_insertion[0]
        assert np.allclose(said["entry_ras_mm"] or np.nan, RAS * entry, atol=1e-3, equal_nan=True)
        assert np.allclose(said["joints_deg"] or np.nan, np.degrees(q), atol=1e-3, equal_nan=True)
        seen.add(said["verdict"])
    assert {"safe", "rejected"} <= seen


@pytest.fixture(scope="module")
def paths(context):
    """Safe directions and how much more than its margins each keeps: (theta, beta, slack)."""
    found = pt.search(context)
    slack = np.nanmin(found.clearance.by_structure - found.clearance.margins, axis=1)
    rows = np.flatnonzero(found.safe)
    return np.column_stack([found.theta_deg, found.beta_deg, slack])[rows]


def test_a_needle_beside_the_line_is_not_called_safe(context, planner, paths):
    """Unless every margin is kept there too: the verdict's path is parallel to it."""
    wide = paths[np.argmax(paths[:, 2])]
    assert wide[2] > 2.5
    for off, expected in ((0.0, "safe"), (1.9, "safe"), (2.1, "not aimed"), (30.0, "not aimed")):
        said = verdict(planner, toward(context, *wide[:2], off_mm=off))
        assert (said["verdict"], said["check"]["verdict"]) == (expected, "safe")
        assert said["text"].startswith("theta" if expected == "safe" else "not aimed")
        assert said["off_line_mm"] == pytest.approx(off, abs=1e-3) and said["ahead_mm"] == pytest.approx(150, abs=1e-3)
    assert verdict(planner, toward(context, *wide[:2], out_mm=-1.0))["verdict"] == "safe"
    assert verdict(planner, toward(context, *wide[:2], out_mm=-3.0))["verdict"] == "not aimed"
    narrow = paths[np.argmin(np.where(paths[:, 2] > 0.05, paths[:, 2], np.inf))]
    assert narrow[2] < 1.8
    assert verdict(planner, toward(context, *narrow[:2], off_mm=0.0))["verdict"] == "safe"
    assert verdict(planner, toward(context, *narrow[:2], off_mm=narrow[2] + 0.05))["verdict"] == "not aimed"


def test_a_tip_beyond_the_target_is_held_against_what_lies_behind(tmp_path):
    """A ball 0.5 mm farther behind the target than its margin: 0.4 mm beyond the target is safe, 0.6 mm is too near."""
    path = write_case(tmp_path)
    radius, margin = load_case(path).needle.radius_mm, 3.0
    ball(tmp_path / "rib.stl", 5.0, (0.0, 0.0, -(5.0 + margin + radius + 0.5)))  # a corner of it is on the axis
    planner = Planner(pt.prepare(path, arm=False))
    for beyond, off, expected in ((0.0, 0.0, True), (0.4, 0.0, True), (0.6, 0.0, False), (0.4, 0.4, False)):
        said = verdict(planner, needle([off, 0.0, -beyond], [0.0, 0.0, -1.0]))
        assert said["slack_mm"] == pytest.approx(0.5, abs=1e-3) and said["check"]["verdict"].startswith("safe")
        assert said["verdict"].startswith("safe") == expected and (said["verdict"] == "not aimed") != expected


def test_what_breath_and_bending_take_is_not_spare():
    """10 mm and 4 mm of clearance over margins of 3 and 1; 5 mm at the breath's worst; 1.5 mm of bending."""
    clearance = SimpleNamespace(by_structure=np.array([[10.0, 4.0, 0.2]]), margins=np.array([3.0, 1.0, np.nan]))
    breath = SimpleNamespace(clearance=np.array([5.0]))
    for breathing, bent, expected in ((None, None, 3.0), (breath, None, 2.0), (None, 1.5, 1.5), (breath, 1.5, 0.5)):
        deflection = None if bent is None else np.array([bent])
        found = SimpleNamespace(clearance=clearance, breathing=breathing, deflection=deflection)
        assert slack_mm(found) == expected
    unknown = SimpleNamespace(clearance=np.array([np.nan]))
    assert np.isnan(slack_mm(SimpleNamespace(clearance=clearance, breathing=unknown, deflection=None)))


def test_a_needle_held_the_wrong_way_round_is_another_direction(context, planner, paths):
    pose = toward(context, *paths[0, :2])
    pose[:3, [0, 2]] *= -1.0
    assert verdict(planner, pose)["verdict"] != "safe"


def test_a_tracked_needle_is_the_same(context, planner, paths):
    pose = toward(context, *paths[0, :2])
    one = verdict(planner, pose)
    found = asked(planner, "TDATA", "Polaris", tools(Other=np.eye(4), Needle=pose))
    assert document(found, "Verdict") == one
    found = asked(planner, "TDATA", "Polaris", tools(Other=np.eye(4)))
    assert document(found, "Verdict")["error"]["code"] == "unknown_name" and found["POINT Entry"] == b""


def is_empty(found):
    mesh, grid = found["POLYDATA SafeMap"], np.frombuffer(found["IMAGE SafeGrid"][72:], "<u2")
    assert not any(struct.unpack(">10I", mesh)) and (grid == NO_STRUCTURE).all() and found["POINT Entry"] == b""
    assert document(found, "Verdict")["verdict"] == "refused"
    return document(found, "SafeMapInfo")["error"]["code"]


def test_a_refused_target_leaves_nothing_of_the_one_before(context, planner, paths):
    """Neither map nor verdict, until there is a good one: then the needle that is known is answered for it."""
    pose, target, session = toward(context, *paths[0, :2]), RAS * context.case.target_ct, planner.session()
    assert verdict(planner, pose, session=session)["verdict"] == "safe"
    far = asked(planner, "POINT", "Target", point((900.0, 0.0, 0.0)), session)
    assert is_empty(far) == "target_misplaced"
    assert "(900.0, 0.0, 0.0 mm RAS)" in document(far, "SafeMapInfo")["error"]["sentence"]  # as it was sent
    assert verdict(planner, pose, session=session)["error"]["code"] == "no_target"
    assert verdict(planner, pose)["verdict"] == "safe"  # another client has a target of its own
    for content, code in [
        (point((np.nan, 0.0, 0.0)), "not_finite"),
        (point(target, target), "wrong_count"),
        (b"", "wrong_count"),
        (point(target)[:-1], "wrong_count"),
    ]:
        assert is_empty(asked(planner, "POINT", "Target", content, session)) == code
    again = asked(planner, "POINT", "Target", point(target), session)
    assert document(again, "Verdict")["verdict"] == "safe" and document(again, "SafeMapInfo")["blocked"] > 0
    with refused("no_target"):  # one that came damaged is a refused one
        list(planner.answers(Question(1, session, "target", STAMP, fault=refusal("no_target"))))
    assert verdict(planner, pose, session=session)["error"]["code"] == "no_target"


def test_a_needle_without_a_newer_pose_has_no_verdict(context, planner, paths):
    """Nor for a new target; the status says so in both ways, until a pose comes."""
    pose, session, target = toward(context, *paths[0, :2]), planner.session(), RAS * context.case.target_ct

    def status():
        said = document(asked(planner, "STRING", "Query", text("?"), session), "Status")["needle"]
        code = struct.unpack(">H", asked(planner, "GET_STATUS", "", b"", session)["STATUS Status"][:2])[0]
        return said, code

    assert status() == (None, 1)
    assert verdict(planner, pose, session=session)["verdict"] == "safe" and status() == ("known", 1)
    with refused("needle_silent"):
        list(planner.answers(session.needle._replace(message=None, fault=refusal("needle_silent"))))
    assert status() == ("needle_silent", 7)
    found = asked(planner, "POINT", "Target", point(target), session)
    assert document(found, "Verdict")["error"]["code"] == "needle_silent" and found["POINT Entry"] == b""
    assert document(found, "SafeMapInfo")["blocked"] > 0
    assert verdict(planner, pose, session=session)["verdict"] == "safe" and status() == ("known", 1)


def refusal(code):
    return pt.InputError("damaged", where="here", allowed="none", code=code)


def test_a_pose_that_no_needle_has_is_refused(planner):
    """Mirrored, scaled, zero, huge; infinite."""
    wrong = np.diag([1.0, 1.0, -1.0, 1.0]), np.diag([2.0, 2.0, 2.0, 1.0]), np.zeros((4, 4)), np.full((4, 4), 3e38)
    for matrix, code in (*((one, "not_rigid") for one in wrong), (np.full((4, 4), np.inf), "not_finite")):
        found = asked(planner, "TRANSFORM", "Needle", transform(matrix))
        said = document(found, "Verdict")
        assert (said["verdict"], said["error"]["code"], found["POINT Entry"]) == ("refused", code, b"")


@pytest.mark.filterwarnings("error::RuntimeWarning")
def test_a_signalling_nan_is_refused_without_a_warning(planner):
    for kind, name, subject in (("TRANSFORM", "Needle", "Verdict"), ("TRANSFORM", "Target", "SafeMapInfo")):
        found = document(asked(planner, kind, name, b"\x7f\xa0\0\1" * 12), subject)
        assert found["error"]["code"] == "not_finite"


def test_of_a_stranger_nothing_is_wanted(planner):
    for kind, name in (("IMAGE", "Target"), ("POINT", "Needle"), ("POINT", "F"), ("STRING", "Text"), ("STATUS", "x")):
        assert planner.subject(Header(kind, name, STAMP, 0, 0)) is None


def test_a_case_in_a_frame_of_its_own_is_refused():
    with refused("local_space"):
        Planner(SimpleNamespace(case=load_case(folder() / "carton" / "case_m.toml")))


@pytest.fixture(scope="module")
def compiled(tmp_path_factory):
    compiler, out = shutil.which("g++"), tmp_path_factory.mktemp("client") / "live_client"
    headers = Path("/usr/include/openigtlink")
    if compiler is None or not headers.is_dir():
        pytest.skip("no C++ compiler, or no OpenIGTLink library: apt-get install g++ libopenigtlink-dev")
    words = ["-O1", "-I", headers, ROOT / "tests" / "live_client.cpp", "-o", out, "-lOpenIGTLink", "-lpthread"]
    subprocess.run([compiler, *map(str, words)], check=True)
    return out


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    """`run-twin live` of a coarse abdomen in a process of its own, and its port; ended by Ctrl-C."""
    case = tmp_path_factory.mktemp("live") / "abdomen"
    shutil.copytree(ABDOMEN, case)
    text = (case / "case.toml").read_text(encoding="utf-8")
    (case / "case.toml").write_text(changed(text, ("step_deg = 2.0", "step_deg = 10.0")), encoding="utf-8")
    command = [sys.executable, "-c", PROGRAM, "live", str(case), "--port", "0"]
    with subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT) as process:
        line = next((line for line in process.stderr if line.startswith("live: ")), "")
        port = int(line.split("port ")[1].split(";")[0])
        yield SimpleNamespace(port=port, case=case)
        with Talk(port):
            process.send_signal(signal.SIGINT)
            try:
                out, err = process.communicate(timeout=60)
            finally:
                process.kill()
        assert (process.returncode, out, err.splitlines()[-1:]) == (INTERRUPTED, "", ["interrupted"])
        socket.create_server(("127.0.0.1", port)).close()  # the port is free


def test_a_client_of_other_construction_reads_every_answer(compiled, served):
    """The OpenIGTLink library finds the checksums right, and in the messages what the API says."""
    context = pt.prepare(served.case)
    x, y, z = RAS * context.case.target_ct
    command = [compiled, *map(str, (served.port, 2, x, y, z))]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    lines, answer = [line.split(" ") for line in done.stdout.splitlines()], ["map", "grid", "info", "verdict", "entry"]
    assert [line[0] for line in lines] == [*answer, *answer, "verdict", "entry", "tracked"]
    expected, n = pt.safe_map(context), len(context.case.directions())
    assert [float(one) for one in lines[0][2:]] == [4 * n, n, expected.blocked.sum(), -1, 0]
    verdicts = [(line[2], json.loads(" ".join(line[3:]))) for line in lines if line[0] == "verdict"]
    assert [stamp for stamp, _ in verdicts] == ["1", "1", "3"]
    assert verdicts[0][1]["target_ras_mm"][2] + 0.01 == pytest.approx(verdicts[1][1]["target_ras_mm"][2], abs=1e-4)
    first = verdicts[0][1]
    known = pt.check(context, first["check"]["theta_deg"], first["check"]["beta_deg"])
    assert first["check"]["verdict"] == known.verdict and first["off_line_mm"] < 1e-3
    assert np.allclose([float(one) for one in lines[4][2:5]], RAS * known.candidates.path.entry_ct[0], atol=1e-3)
    sent, answers, oldest_ms = map(float, lines[-1][1:])
    assert 1 <= answers <= sent and oldest_ms < 2000


def test_the_status_is_told_in_both_ways(served):
    """As JSON, and as the protocol's own STATUS with code 1: well."""
    with Talk(served.port) as talk:
        talk.send("STRING", "Query", text("status"), version=2, number=5, stamp=(7, 8))
        said = talk.receive()
        assert (said.version, said.number, said.stamp) == (2, 5, (7, 8))
        assert said.document["case"] == load_case(served.case).name and said.document["arm"]
        talk.send("GET_STATUS", "")
        said = talk.receive()
        assert said.kind == "STATUS" and struct.unpack(">Hq", said.content[:10]) == (1, 0)


def test_a_port_that_is_taken_is_one_line_before_a_case_is_read(capsys):
    """Exit code 2, also where the case does not exist; so is a host that is none."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert main(["live", "nowhere", "--port", str(taken.getsockname()[1])]) == 2
    assert main(["live", "nowhere", "--host", "no.such.host.invalid"]) == 2
    assert main(["live", "nowhere", "--port", "0"]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 3


def test_what_is_packed_for_version_1_has_no_extension():
    assert len(packed("STRING", "x", STAMP._replace(version=1), b"abc")) == 58 + 3
    assert len(packed("STRING", "x", STAMP, b"abc")) == 58 + 12 + 3 + 2
