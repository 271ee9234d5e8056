"""Commands on a case with an arm and a tool of one's own, from the outside: what each gives, and what each refuses."""

import csv
import re

import numpy as np
import pytest
from case_world import NEEDLE, SEARCH, SKIN, case_text, registration_section, structure, write_case
from own_arms import write_holder, write_own_arm
from refusals import refused_command

from puncture_twin.planning.geometry.rigid import apply, pose

T_BASE_CT = pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.0, -450.0, 0.0]))
"""The bed beside the arm, which stands at the patient's right."""
MARKERS_CT = np.round(
    [
        91.0 * direction / np.linalg.norm(direction)
        for direction in np.array([(0, -1, 0), (0.5, -0.8, 0.3), (-0.5, -0.8, 0.2), (0.1, -0.8, -0.6)])
    ],
    3,
)
"""On the front of the usual patient, who is a ball of 90 mm."""
ARM = """[robot]
urdf = "arm/toy.urdf"
[robot.limits]
lowest_deg = [-180, -180, -150, -340, -340, -340]
highest_deg = [180, 0, 150, 340, 340, 340]
max_speed_deg_s = [90, 90, 120, 150, 150, 150]
[tool]
mesh = "holder.stl"
unit = "mm"
position_mm = [0, 0, 0]
[errors]
touch_mm = 0.1
[rehearsal]
truth_base = "truth.csv"
seed = 3
"""


def own_case(folder):
    """A case with its own arm, a holder with something at its side, and markers that it touched."""
    folder.mkdir()
    parts = (SKIN, structure("organ", "target"), structure("rib", "avoid", margin_mm=3.0), registration_section())
    write_case(folder, text=case_text(*parts, needle=NEEDLE, search=SEARCH) + ARM)
    write_own_arm(folder / "arm")
    write_holder(folder / "holder.stl")
    for name, points in (
        ("markers_ct", MARKERS_CT),
        *dict.fromkeys(("touch", "truth"), apply(T_BASE_CT, MARKERS_CT)).items(),
    ):
        rows = [f"{one},{x!r},{y!r},{z!r}" for one, (x, y, z) in zip("ABCD", points.tolist(), strict=True)]
        (folder / f"{name}.csv").write_text("\n".join(["name,x_mm,y_mm,z_mm", *rows, ""]))
    return folder


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return own_case(tmp_path_factory.mktemp("own") / "case")


@pytest.fixture
def answer(run):
    """A function: what a command prints as JSON; it must end well."""

    def told(*words):
        code, found = run(*words)
        assert code == 0, found
        return found

    return told


def test_register_counts_the_errors_of_that_arm(folder, answer):
    """Markers without error have no residuals; the arm's own errors are sources of the expected one."""
    told = answer("register", folder)
    assert max(told["residual_mm"].values() if isinstance(told["residual_mm"], dict) else told["residual_mm"]) < 0.01
    assert 0.1 < told["expected_tre_target_mm"] < 5.0


def test_the_markers_are_touched(folder, tmp_path, answer):
    """All four, within the errors that are declared; the list is one that a case takes."""
    answer("touch", folder, "--out", tmp_path)
    with (tmp_path / "touch.csv").open(encoding="utf-8") as file:
        rows = {row["name"]: [float(row[f"{axis}_mm"]) for axis in "xyz"] for row in csv.DictReader(file)}
    assert sorted(rows) == list("ABCD")
    off = [
        np.linalg.norm(np.subtract(rows[name], place))
        for name, place in zip("ABCD", apply(T_BASE_CT, MARKERS_CT), strict=True)
    ]
    assert max(off) < 3.0  # tip and drift of this truth, each half a millimetre on average


def test_the_needle_turns_about_the_target(folder, tmp_path, answer):
    told = answer("rehearse", folder, "--sweep", "--out", tmp_path)
    assert (tmp_path / "sweep.json").is_file() and not told["contacts"] and told["off_point_max_mm"] < 0.1
    assert told["reached_deg"] == pytest.approx(told["wanted_deg"])


def test_slicer_gets_the_robots_place(folder, tmp_path, answer):
    answer("export", folder, "--format", "slicer", "--out", tmp_path)
    numbers = re.search(r"\nParameters: (.+)", (tmp_path / "ct_to_robot.tfm").read_text()).group(1).split()
    expected = np.linalg.inv(T_BASE_CT)
    assert [float(one) for one in numbers] == pytest.approx([*expected[:3, :3].ravel(), *expected[:3, 3]], abs=0.01)


def in_text(file, old, new):
    def change(folder):
        text = (folder / file).read_text()
        assert old in text
        (folder / file).write_text(text.replace(old, new, 1))

    return change


def with_bytes(file, data):
    return lambda folder: (folder / file).write_bytes(data)


JOINTS = "q1_deg,q2_deg,q3_deg,q4_deg,q5_deg,q6_deg\n"
BAD = [
    (in_text("arm/toy.urdf", '<axis xyz="', '<axis xyz="0 0 0" was="'), ["register"], "zero_direction toy.urdf j1"),
    (with_bytes("arm/ulna.stl", b"solid x\nendsolid x\n"), ["scan"], "file_cut ulna ulna.stl"),
    (in_text("case.toml", "position_mm = [0, 0, 0]", "position_mm = [0, 300, 0]"), ["place"], "tool_detached"),
    (with_bytes("j.csv", (JOINTS + "1,2,3,4,5,6\n" * 4).encode()), ["pivot", "j.csv"], "joints_unit j.csv"),
]
"""A command of each kind; other mistakes: tests/arm/own_arm_refusals.toml, tests/reach/test_own_tool.py."""


@pytest.mark.parametrize(("change", "command", "says"), BAD)
def test_bad_input_is_one_line_and_nothing_is_written(tmp_path, capfd, change, command, says):
    case = own_case(tmp_path / "case")
    change(case)
    out, words = tmp_path / "out", [str(case / one) if (case / one).is_file() else one for one in command[1:]]
    writes = command[0] not in ("register", "pivot")  # what was read is judged on the terminal
    refused_command([command[0], case, *words, *(("--out", out) if writes else ())], capfd, *says.split())
    assert not out.exists() or not [one for one in out.rglob("*") if one.is_file()]
