"""A case that names an arm of the user's own: its files are inputs, and nothing is guessed."""

import json
from dataclasses import replace

import numpy as np
import pytest
from case_world import CASE, write_case
from own_arms import LENGTHS, write_own_arm
from refusals import refused

from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.case.case_file import case_options
from puncture_twin.planning.collision.workcell import home_configuration
from puncture_twin.planning.plan.plan_check import arm_document, read_arm, same_arm

ROBOT = '\n[robot]\nurdf = "arm/toy.urdf"\n'


def own_case(folder, *lines):
    """A case whose arm is a URDF's in a folder beside it, with further lines of its ``[robot]``."""
    write_own_arm(folder / "arm")
    return write_case(folder, text=CASE + ROBOT + "\n".join(lines) + "\n")


def test_an_own_arm_is_the_cases_and_each_of_its_files_an_input(tmp_path):
    """URDF and seven meshes, hashed; another byte of one is another input."""
    case = load_case(own_case(tmp_path))
    assert case.robot.model.lengths.tolist() == list(LENGTHS) and case.robot.model.name == "toy"
    roles = [(one.role, one.path) for one in case.inputs if "urdf" in one.role]
    assert roles[0] == ("urdf", "arm/toy.urdf") and ("urdf mesh", "arm/ulna.stl") in roles and len(roles) == 8
    mesh = tmp_path / "arm" / "ulna.stl"
    mesh.write_bytes(b"x" + mesh.read_bytes()[1:])
    other = load_case(tmp_path)
    differing = [a.path for a, b in zip(case.inputs, other.inputs, strict=True) if a.sha256 != b.sha256]
    assert differing == ["arm/ulna.stl"]


LIMITS = "[robot.limits]\n"


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ('model = "ur5"', "stated_twice"),
        ('flange = "hand"', "arm_not_as_ur hand"),
        ('flange = "gone"', "unknown_link gone"),
        (f"{LIMITS}lowest_deg = {[-90] * 6}", "keys_together lowest_deg highest_deg"),
        (f"{LIMITS}max_speed_deg_s = {[10] * 5 + [200]}", "limit_beyond_arm 171.887"),
        (f"{LIMITS}lowest_deg = {[-350] + [0] * 5}\nhighest_deg = {[9] * 6}", "limit_beyond_arm -343.775"),
        (f"{LIMITS}lowest_deg = {[0, 0, 9, 0, 0, 0]}\nhighest_deg = {[9] * 6}", "range_descends lowest_deg"),
    ],
)
def test_what_contradicts_itself_is_refused(tmp_path, lines, says):
    with refused(*says.split()):
        load_case(own_case(tmp_path, lines))


@pytest.mark.parametrize(
    ("address", "says"),
    [
        ("package://toy/ulna.stl", "outside_folder //toy/ulna.stl"),
        ("file:///tmp/ulna.stl", "outside_folder"),
        ("/tmp/ulna.stl", "outside_folder"),
        ("Ulna.stl", "no_such_file arm/Ulna.stl ulna.stl"),
        ("cut.stl", "size_mismatch cut.stl"),
    ],
)
def test_meshes_are_files_beside_the_urdf_and_whole(tmp_path, address, says):
    path = own_case(tmp_path)
    folder = tmp_path / "arm"
    (folder / "cut.stl").write_bytes((folder / "ulna.stl").read_bytes()[:-200])
    urdf = folder / "toy.urdf"
    urdf.write_text(urdf.read_text().replace('"ulna.stl"', f'"{address}"'))
    with refused(*says.split()):
        load_case(path)


def test_limits_narrow_any_arm(tmp_path):
    lines = ["[robot]", 'model = "ur5"', "[robot.limits]", "max_speed_deg_s = [90, 90, 90, 90, 90, 90]"]
    lines += ["lowest_deg = [-90, -180, -170, -360, -360, -360]", "highest_deg = [90, 0, 170, 360, 360, 360]"]
    case = load_case(write_case(tmp_path, text=CASE + "\n" + "\n".join(lines) + "\n"))
    model, known = case.robot.model, ur_model("ur5")
    assert np.degrees(model.joint_limits[1]) == pytest.approx([-180, 0]) and model.max_speeds[0] == np.pi / 2
    assert same_arm(replace(model, joint_limits=known.joint_limits, max_speeds=known.max_speeds), known)
    assert home_configuration(case)[1] == -np.pi / 2
    high = replace(case, robot=replace(case.robot, home=np.radians([0.0, 10, 0, 0, 0, 0])))
    with refused("home_beyond_limits", "10"):
        home_configuration(high)


def test_an_option_puts_one_arm_in_the_place_of_another(tmp_path):
    path = own_case(tmp_path, "[robot.limits]", "max_speed_deg_s = [90, 90, 90, 90, 90, 90]")
    assert load_case(path, case_options({"arm": {"model": "ur10"}}, where="test")).robot.model == ur_model("ur10")
    named = write_case(tmp_path, text=CASE + '\n[robot]\nmodel = "ur10"\n')
    assert load_case(named, case_options({"arm": {"urdf": "arm/toy.urdf"}}, where="test")).robot.model.name == "toy"


def test_a_plan_states_the_numbers_of_its_arm(tmp_path):
    """Of an own arm and of narrowed limits; the table's own are their name. Numbers of no arm are refused."""
    model = load_case(own_case(tmp_path)).robot.model
    narrow = replace(ur_model("ur3"), max_speeds=0.5 * ur_model("ur3").max_speeds)
    for one in (model, narrow):
        read = read_arm(one.name, json.loads(json.dumps(arm_document(one))))
        assert same_arm(read, one) and not same_arm(read, ur_model("ur3")) and read.shipped == one.shipped
    assert arm_document(ur_model("ur3")) is None and read_arm("ur3", None) == ur_model("ur3")
    for change in ({"lengths_mm": [1.0] * 6}, {"max_speeds_rad_s": [9.0] * 6}, {"joint_names": ["a"]}, {"more": 1}):
        with pytest.raises(ValueError, match=r"arm|numbers"):
            read_arm("ur3", {**arm_document(narrow), **change})
