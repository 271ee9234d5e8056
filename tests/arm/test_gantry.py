"""The bore of a CT gantry as boxes: nothing of the wall is missing, and almost all of the bore is free."""

import shutil

import numpy as np
import pytest
import trimesh
from kept_checkers import built
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.tool import SIDES, Tool, gantry_boxes
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import bed_frame, load_case
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker
from puncture_twin.planning.collision.workcell import case_boxes, case_tool, home_configuration
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.registration.placement import load_placement
from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.report.scene.scene_parts import room
from puncture_twin.twin.world.execution import execute
from puncture_twin.twin.world.workcell import open_workcell

TILT = trimesh.transformations.rotation_matrix(0.35, [1.0, 0.2, 0.0])
TILT[:3, 3] = (420.0, 30.0, 80.0)
SIZES = {"bore_diameter_mm": 700.0, "wall_mm": 150.0, "depth_mm": 300.0}


def test_the_wall_is_whole_and_the_bore_free():
    """Random points: all of the wall's are in a box; none of those within the inscribed polygon's inner circle is."""
    rng = np.random.default_rng(0)
    boxes = gantry_boxes(TILT, **SIZES)
    radius, turn = rng.uniform(0.0, 500.0, 40_000), rng.uniform(0.0, 2.0 * np.pi, 40_000)
    local = np.stack([radius * np.cos(turn), radius * np.sin(turn), rng.uniform(-149.9, 149.9, 40_000)], axis=1)
    points = local @ TILT[:3, :3].T + TILT[:3, 3]
    inside = np.zeros(len(points), bool)
    for box in boxes:
        at = (points - box.T_base_box[:3, 3]) @ box.T_base_box[:3, :3]
        inside |= (np.abs(at) <= np.asarray(box.size_mm) / 2.0).all(axis=1)
    assert inside[radius > 350.0].all()
    assert not inside[radius < 350.0 * np.cos(np.pi / SIDES) - 1e-9].any()


def test_in_a_gantry_both_checkers_agree():
    tool = Tool(250.0, 150.0, 1.2, 30.0)
    ahead = trimesh.transformations.rotation_matrix(np.pi / 2.0 + 0.35, [1.0, 0.0, 0.0])
    ahead[:3, 3] = (0.0, 600.0, 150.0)
    boxes = gantry_boxes(ahead, **SIZES)
    slow, fast = (built(kind, ur_model("ur3"), tool, boxes, padding_mm=5.0) for kind in (CellChecker, FastChecker))
    met = set()
    for q in np.random.default_rng(1).uniform(-np.pi, np.pi, (300, 6)):
        contact = slow.contact(q, needle_may_touch_patient=False)
        assert fast.contact(q, needle_may_touch_patient=False) == contact
        met.add(None if contact is None else contact.other.split("_")[0])
    assert {None, "gantry"} <= met


GANTRY = """
[gantry]
bore_diameter_mm = 700.0
center_mm = [0.0, 0.0, 60.0]
thickness_mm = 300.0
wall_mm = 150.0
tilt_deg = {tilt}
"""
REGISTRATION = '[registration]\nmarkers_ct = "markers_ct.csv"\nmarkers_base = "touch.csv"\n'


@pytest.fixture
def in_gantry(tmp_path):
    """A function: the embedded abdomen in a tilted gantry, with more text."""

    def make(more="", tilt=0.0, changes=()):
        here = tmp_path / f"case{len(list(tmp_path.iterdir()))}"
        shutil.copytree(folder() / "abdomen", here)
        text = (here / "case.toml").read_text()
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        (here / "case.toml").write_text(text + GANTRY.format(tilt=tilt) + more)
        return here / "case.toml"

    return make


def test_a_tilt_leans_the_top_toward_the_feet(in_gantry):
    """The bore's axis is the head's direction turned up by the tilt; the top, square to it, leans to the feet."""
    T = load_case(in_gantry(tilt=20.0)).gantry.T_ct_gantry
    s, c = np.sin(np.radians(20.0)), np.cos(np.radians(20.0))
    np.testing.assert_allclose(T[:3, 2], [0.0, -s, c], atol=1e-12)  # LPS: the front is -y, the head +z
    np.testing.assert_allclose(T[:3, 0], [0.0, -c, -s], atol=1e-12)
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_allclose(T[:3, 3], [0.0, 0.0, 60.0])


def test_a_gantry_in_another_space_stands_at_the_same_place(in_gantry):
    more = "axis = [0.0, 0.0, 1.0]\nup = [0.0, 1.0, 0.0]\n"
    ras = (('space = "LPS"', 'space = "RAS"'),)
    T = load_case(in_gantry(more, 20.0, ras)).gantry.T_ct_gantry
    np.testing.assert_allclose(T, load_case(in_gantry(tilt=20.0)).gantry.T_ct_gantry, atol=1e-12)


def test_the_rooms_boxes_hold_the_gantry(in_gantry):
    """Reach, approach and rehearsal take their boxes from here: the obstacles, then the gantry's."""
    case = load_case(in_gantry())
    T_base_ct = load_placement(case).T_base_ct
    boxes = case_boxes(case, T_base_ct)
    assert [box.name for box in boxes] == ["table", *(f"gantry_{side}" for side in range(SIDES))]
    middle = np.mean([box.T_base_box[:3, 3] for box in boxes[1:]], axis=0)
    np.testing.assert_allclose(middle, T_base_ct[:3, :3] @ [0.0, 0.0, 60.0] + T_base_ct[:3, 3], atol=1e-9)


def test_an_arm_through_the_wall_is_a_collision_that_names_the_gantry(in_gantry):
    """A base beside the bore must reach through its wall; without the gantry the same direction is held."""
    mount = (
        "\n[robot.mount]\nposition_mm = [-330.0, -330.0, -20.0]\nx_axis = [1.0, 0.0, 0.0]\nz_axis = [0.0, 0.0, 1.0]\n"
    )
    placed = ((REGISTRATION, ""), ("step_deg = 2.0", "step_deg = 15.0"))
    walled = prepare(in_gantry(mount, changes=placed)).search()
    free_case = in_gantry(mount, changes=placed)
    free_case.write_text(free_case.read_text().replace(GANTRY.format(tilt=0.0), ""))
    free = prepare(free_case).search()
    hits = walled.verdict.reason == Reason.ARM_COLLISION.value
    named = np.char.find(walled.verdict.structure.astype(str), "/gantry_") >= 0
    held = hits & named & (free.arm.reachable == 1)
    assert held.any() and not np.char.startswith(free.verdict.structure.astype(str), "gantry").any()
    row = int(np.flatnonzero(held)[0])
    assert "touches gantry_" in walled.verdict.detail[row]


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (("bore_diameter_mm = 700.0", "bore_diameter_mm = 70.0"), "bad_value gantry.bore_diameter_mm"),
        (("tilt_deg = 0.0", "tilt_deg = 80.0"), "bad_value gantry.tilt_deg"),
        (("tilt_deg = 0.0", 'up = "head"'), "axes_parallel"),
        (("wall_mm", "wal_mm"), "unknown_key wall_mm"),
    ],
)
def test_gantries_that_make_no_sense_are_refused(in_gantry, change, match):
    path = in_gantry()
    path.write_text(path.read_text().replace(*change))
    with refused(*match.split()):
        load_case(path)


def test_the_physics_feels_the_gantry(in_gantry):
    """In the twin's room the wall is solid: an arm sent through it is stopped, and the contact names the gantry."""
    path = in_gantry()
    further = (("[0.0, 0.0, 60.0]", "[0.0, 0.0, 330.0]"), ("wall_mm = 150.0", "wall_mm = 400.0"))
    path.write_text(path.read_text().replace(*further[0]).replace(*further[1]))
    case = load_case(path)
    T_base_ct, model = load_placement(case).T_base_ct, case.robot.model
    skin = trimesh.creation.icosphere(radius=50.0)
    patient = TriangleMesh(skin.vertices, skin.faces)
    away, home = np.radians([0.0, -165.0, -90.0, 0.0, 90.0, 0.0]), home_configuration(case)
    checker = CellChecker(model, case_tool(case), case_boxes(case, T_base_ct))
    assert checker.contact(away, needle_may_touch_patient=False) is None
    assert checker.contact(home, needle_may_touch_patient=False).other.startswith("gantry_")
    commands = away + (home - away) * np.linspace(0.0, 1.0, 480)[:, None]
    down = -bed_frame(case)[:3, 2]
    with open_workcell(model, case_tool(case), patient, T_base_ct, case_boxes(case, T_base_ct), down_ct=down) as room:
        done = execute(room, commands, np.zeros(6))
    assert done.touches and {touch.body.split("_")[0] for touch in done.touches} == {"gantry"}
    assert np.abs(done.q[-1] - home).max() > np.radians(2.0)


def test_the_gantry_is_drawn(in_gantry):
    case = load_case(in_gantry(tilt=10.0))
    body = next(body for body in room(case, None) if body.name == "gantry")
    at = (body.mesh.vertices - case.gantry.T_ct_gantry[:3, 3]) @ case.gantry.T_ct_gantry[:3, :3]
    assert np.hypot(at[:, 0], at[:, 1]).min() == pytest.approx(350.0) and body.alpha < 1
    assert np.abs(at[:, 2]).max() == pytest.approx(150.0)
