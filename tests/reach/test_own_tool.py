"""A tool of the user's own on the flange: its mesh is a body of the arm wherever the arm is asked."""

import pickle
from dataclasses import replace
from pathlib import Path

import fcl
import numpy as np
import pytest
import trimesh
from case_world import CASE, write_case
from refusals import refused

from puncture_twin.planning.arm.insertion import ReachRequest
from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.arm.tool import SLABS, Box, Tool, ToolBody
from puncture_twin.planning.arm.ur import ur_model
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.case import load_case
from puncture_twin.planning.collision.bodies import arm_bodies, touch
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.place.estimate import ArmSpheres
from puncture_twin.planning.reach.reach import assess_reach_all
from puncture_twin.twin.world.arm import load_arm
from puncture_twin.twin.world.client import physics_client

UR3 = ur_model("ur3")
NEEDLE = Tool(210.0, 150.0, 1.2, 30.0)
THIN = replace(NEEDLE, holder_diameter_mm=1.2)
"""The same needle without a holder to speak of."""
BENT = np.radians([0.0, -90.0, 90.0, -90.0, -90.0, 0.0])


def body(solid):
    return ToolBody(TriangleMesh(solid.vertices, solid.faces), Path("tool.stl"), 1.0, np.eye(4), "case.toml: tool")


def rod(radius, low, high, sections=256):
    made = trimesh.creation.cylinder(radius, high - low, sections=sections)
    made.apply_translation([0.0, 0.0, (low + high) / 2])
    return made


def camera(reach_mm=120.0):
    """An arm to the side, and a block at its end: nothing that is round about the needle."""
    bar = trimesh.creation.box((reach_mm + 20, 20, 12))
    bar.apply_translation([(reach_mm - 20) / 2, 0, 8])
    block = trimesh.creation.box((30, 40, 60))
    block.apply_translation([reach_mm, 0, 32])
    return trimesh.util.concatenate([bar, block])


def ball(center):
    """A closed patient of 50 mm about a point of the base frame."""
    made = trimesh.creation.icosphere(subdivisions=3, radius=50.0)
    return TriangleMesh(made.vertices + center, made.faces)


TARGET = np.array([330.0, 40.0, 20.0])


@pytest.fixture(scope="module")
def answers():
    """Of four tools, for the same directions from above to a target before the arm."""
    outward = np.random.default_rng(11).normal(size=(16, 3)) * 0.5 + [-0.2, 0.0, 1.0]
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    asked = [ReachRequest(TARGET, one, 210.0, 80.0) for one in outward]
    tools = {
        "none": NEEDLE,
        "rod": replace(THIN, body=body(rod(15.0, -5.0, 60.0))),
        "side": replace(NEEDLE, body=body(camera())),
        "large": replace(NEEDLE, body=body(rod(200.0, 2.0, 30.0, sections=32))),
    }
    room = ([Box("table", np.eye(4) + shift(330, 0, -120), (600, 500, 60))], ball(TARGET))
    return {
        name: assess_reach_all(CellChecker(UR3, tool, *room, padding_mm=5.0), asked) for name, tool in tools.items()
    }


def test_a_mesh_cylinder_is_the_holder(answers):
    """The mesh of a holder, 0.002 mm thinner at its flats: verdict and joints are those of the holder itself."""
    assert 5 < sum(answer.reachable for answer in answers["none"]) < 16
    for known, own in zip(answers["none"], answers["rod"], strict=True):
        assert (known.reason, known.branch, known.margin) == (own.reason, own.branch, own.margin)
        np.testing.assert_array_equal(known.insertion_q, own.insertion_q)


def shift(x, y, z):
    T = np.zeros((4, 4))
    T[:3, 3] = x, y, z
    return T


def test_a_large_tool_takes_directions_and_is_named(answers):
    """A plate of 400 mm: never more directions, fewer in all, and the reason says what touched what."""
    pairs = list(zip(answers["none"], answers["large"], strict=True))
    assert all(a.reachable for a, b in pairs if b.reachable)
    blocked = [b for a, b in pairs if a.reachable and not b.reachable]
    assert len(blocked) > 3
    assert any("tool touches" in one.detail or "touches tool" in one.detail for one in blocked)
    assert all(one.reason in (Reason.ARM_COLLISION, Reason.INSERTION_BLOCKED) for one in blocked)


def test_another_roll_may_save_a_direction(answers):
    """A tool to one side is turned away: some directions are reached in another way than without it."""
    pairs = zip(answers["none"], answers["side"], strict=True)
    assert any((a.roll, a.branch) != (b.roll, b.branch) for a, b in pairs if a.reachable and b.reachable)


@pytest.mark.parametrize("hide", ["whole", "open", "inside out"])
def test_nothing_of_the_mesh_is_outside_of_the_body(hide):
    """Against FCL's answer for the mesh's own triangles: what they touch, the body touches."""
    solid = camera()
    if hide == "open":
        solid.update_faces(np.arange(len(solid.faces)) % 5 > 0)
    if hide == "inside out":
        solid.invert()
    tool = replace(NEEDLE, body=body(solid))
    assert len(tool.body.pieces) in (1, SLABS)
    bvh = fcl.BVHModel()
    bvh.beginModel(len(solid.vertices), len(solid.faces))
    bvh.addSubModel(solid.vertices, solid.faces)
    bvh.endModel()
    T, rng = flange_pose(UR3, BENT), np.random.default_rng(2)
    moved = next(one for one in arm_bodies(UR3, tool, 0.0) if one.name == "tool")
    moved.place(link_poses(UR3, BENT))
    own, touched = fcl.CollisionObject(bvh, fcl.Transform(T[:3, :3], T[:3, 3])), 0
    for place in rng.uniform([-20, -60, 10], [180, 60, 100], (40, 3)):
        block = fcl.CollisionObject(fcl.Box(25.0, 25.0, 25.0), fcl.Transform(T[:3, 3] + T[:3, :3] @ place))
        meets = bool(fcl.collide(own, block, fcl.CollisionRequest(), fcl.CollisionResult()))
        assert not meets or any(touch(piece.made, block) for piece in moved.bare.solids)
        touched += meets
    assert 4 < touched < 36


def test_spheres_sweep_and_physics_know_the_tool():
    """Spheres enclose it, the bound on motion holds for its corners, and PyBullet has it where the flange is."""
    solid = camera()
    tool, rng = replace(NEEDLE, body=body(solid)), np.random.default_rng(5)
    spheres, bare = ArmSpheres.of(UR3, tool), ArmSpheres.of(UR3, NEEDLE)
    assert len(spheres.frames) == len(bare.frames) + 1 and spheres.frames[-1] == 6
    far = spheres.starts[-2]
    inside = np.linalg.norm(solid.vertices - spheres.centres[far], axis=1) <= spheres.radii[far] + 1e-9
    assert inside.all()
    checker = CellChecker(UR3, tool)
    path = np.array([BENT, BENT + rng.normal(0, 0.02, 6)])
    a, b = (solid.vertices @ flange_pose(UR3, q)[:3, :3].T + flange_pose(UR3, q)[:3, 3] for q in path)
    assert np.linalg.norm(a - b, axis=1).max() <= checker.sweep_mm(path)[0]
    with physics_client() as client:
        arm = load_arm(client, UR3, tool)
        arm.place(BENT)
        np.testing.assert_allclose(arm.link_pose("tool"), flange_pose(UR3, BENT), atol=1e-3)
        assert arm.link_name(arm.links["tool"]) == "tool"


@pytest.mark.parametrize(
    ("solid", "says"),
    [
        (rod(15.0, 230.0, 260.0), "tool_detached"),
        (trimesh.Trimesh([[0, 0, 0], [50, 0, 0], [0, 50, 0]], [[0, 1, 2]], process=False), "flat_mesh"),
    ],
)
def test_a_tool_that_does_not_hang_on_the_flange_is_refused(solid, says):
    """One that floats could lie in the patient with nothing touching the skin."""
    with refused(says):
        CellChecker(UR3, replace(NEEDLE, body=body(solid)))


def test_a_tool_is_sent_to_another_process():
    tool = replace(NEEDLE, body=body(camera()))
    assert pickle.loads(pickle.dumps(tool)) == tool and hash(tool) != hash(NEEDLE)


def tool_case(folder, *lines, solid=None):
    (solid or rod(20.0, 0.0, 40.0)).export(folder / "holder.stl")
    return write_case(folder, text=CASE + '\n[tool]\nmesh = "holder.stl"\n' + "\n".join(lines) + "\n")


def test_a_case_states_its_tool(tmp_path):
    """Unit, place and rotation about the flange's x, y and z; the file is an input; two of one mesh are one tool."""
    path = tool_case(tmp_path, 'unit = "cm"', "position_mm = [1, 2, 3]", "rotation_deg = [0, 90, 0]")
    case = load_case(path)
    low, high = case.tool.mesh.bounds
    np.testing.assert_allclose([low, high], [[1, -198, -197], [401, 202, 203]], atol=0.1)
    assert ("tool mesh", "holder.stl") in [(one.role, one.path) for one in case.inputs]
    assert case_tool(case) == case_tool(load_case(path)) != case_tool(replace(case, tool=None))
    assert "holder.stl, 400 × 400 × 400 mm" in case._repr_html_()


@pytest.mark.parametrize(
    ("lines", "says"),
    [
        ([], "missing_key tool.unit"),
        (['unit = "inch"'], "unknown_unit inch"),
        (['unit = "m"'], "implausible_size"),
        (['unit = "mm"', "position_mm = [5000, 0, 0]"], "bad_value tool.position_mm"),
        (['unit = "mm"', "turn = 3"], "unknown_key turn"),
    ],
)
def test_a_tool_that_is_not_understood_is_refused(tmp_path, lines, says):
    with refused(*says.split()):
        load_case(tool_case(tmp_path, *lines))
