"""The page on one's own arm and tool: its case and its commands, as written, with an arm of no UR's lengths."""

import json
import re
import shlex
import tomllib
from xml.etree import ElementTree

import numpy as np
import pytest
from case_world import NEEDLE, SKIN, case_text, structure, write_case
from own_arms import JOINTS, LENGTHS, write_holder, write_own_arm
from places import ROOT
from refusals import refused_command

from puncture_twin.planning.case.case import load_case
from puncture_twin.run_twin import main

PAGE = (ROOT / "docs" / "how-to" / "own-arm.md").read_text(encoding="utf-8")
COMMANDS = re.findall(r"^run-twin (.+)$", PAGE, re.MULTILINE)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The page's folder: its case, about the usual patient; an own arm; a holder with something at its side."""
    top = tmp_path_factory.mktemp("page")
    (case := top / "my-case").mkdir()
    (block,) = re.findall(r"```toml\n(.*?)```", PAGE, re.DOTALL)
    assert set(tomllib.loads(block)) == {"robot", "tool"}
    parts = (SKIN, structure("organ", "target"), structure("rib", "avoid", margin_mm=3.0))
    write_case(case, text=case_text(*parts, needle=NEEDLE, search="theta_deg = [0, 10]\nstep_deg = 10.0") + block)
    write_own_arm(case / "arm")
    write_holder(case / "holder.stl")
    return top


@pytest.fixture(scope="module")
def said(folder):
    """What each command says, run one after another."""
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        said = {}
        for command in COMMANDS:
            assert main([*shlex.split(command), "--json"]) == 0, command
            said[command.split()[0]] = command
    return said


def test_the_pages_commands_end_well(folder, said):
    """Check, plan, rehearse and export: the plan's arm is the URDF's, and the needle ends on its target."""
    assert list(said) == ["check", "plan", "rehearse", "export"]
    plan = json.loads((folder / "out/plan/plan.json").read_text())
    assert plan["robot"] == "toy" and plan["arm"]["lengths_mm"] == list(LENGTHS) and plan["arm"]["shipped"] is False
    assert plan["arm"]["joint_limits_rad"][1] == pytest.approx([-np.pi, 0.0])
    roles = {one["role"] for one in plan["inputs"]}
    assert {"urdf", "urdf mesh", "tool mesh"} <= roles
    rehearsal = json.loads((folder / "out/rehearsal/rehearsal.json").read_text())
    assert rehearsal["contacts"] == []
    assert (folder / "out/plan/scene.png").stat().st_size > 10_000


def test_moveit_is_given_the_urdfs_names_and_the_tool(folder, said):
    """The joints' own names in the goals; the tool attached to the flange, and in the URDF at its file."""
    out = folder / "out/ros"
    goals = json.loads((out / "plan.goals.json").read_text())
    assert goals["approach"]["trajectory"]["joint_names"] == list(JOINTS)
    scene = json.loads((out / "plan.scene.json").read_text())
    attached = scene["robot_state"]["attached_collision_objects"]
    assert [one["object"]["id"] for one in attached] == ["needle_holder", "needle", "tool"]
    assert attached[2]["link_name"] == "tool0" and "hand" in attached[2]["touch_links"]
    assert scene["world"]["collision_objects"][0]["header"]["frame_id"] == "base_link"
    robot = ElementTree.parse(out / "plan.urdf").getroot()
    tool = next(link for link in robot.findall("link") if link.get("name") == "tool")
    assert tool.find("collision/geometry/mesh").get("filename") == (folder / "my-case/holder.stl").as_uri()
    assert tool.find("collision/geometry/mesh").get("scale") == "0.001 0.001 0.001"
    meshes = [mesh.get("filename") for mesh in robot.iter("mesh")]
    assert (folder / "my-case/arm/ulna.stl").as_uri() in meshes


def test_a_plan_is_refused_once_a_mesh_has_changed(folder, said, capsys):
    mesh = folder / "my-case/arm/ulna.stl"
    before = mesh.read_bytes()
    try:
        mesh.write_bytes(b"y" + before[1:])
        plan, case = str(folder / "out/plan/plan.json"), str(folder / "my-case")
        command = ["export", plan, "--case", case, "--format", "csv", "--out", folder / "out/no"]
        refused_command(command, capsys, "input_changed", "arm/ulna.stl")
        assert load_case(case).robot.model.name == "toy"
    finally:
        mesh.write_bytes(before)
