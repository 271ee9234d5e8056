"""What MoveIt and ROS 2 are given: by the definitions of their messages, and back in millimetres where the plan is."""

import ast
import json
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import report_world as world
import yaml
from export.ros_check import holds, through_ros
from export.ros_messages import type_store
from refusals import refused, refused_command
from rosbags.typesys import Stores
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.links import T_BASE_URDFBASE
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import JOINT_NAMES, ur_model
from puncture_twin.planning.case.settings import Gantry, Obstacle
from puncture_twin.planning.export.moveit import (
    BOX,
    CYLINDER,
    SENDER_TEXT,
    check_goals,
    goal_messages,
    scene_message,
    urdf_with_needle,
)
from puncture_twin.planning.export.ros2 import ros2_text
from puncture_twin.planning.motion.trajectory import Trajectory

SLOWER = 30.0
"""The small patient's plan runs at any speed."""


@pytest.fixture(scope="module")
def room():
    case = world.make_case()
    plan = world.make_plan(case, world.make_candidates(case))
    case.obstacles = (Obstacle("table", "ct", np.array([0.0, 120.0, 0.0]), np.array([500.0, 20.0, 1800.0])),)
    case.gantry = Gantry(np.eye(4), 700.0, 200.0, 300.0)
    anatomy = world.make_anatomy()
    anatomy.surroundings = (SimpleNamespace(mesh=anatomy.skin.mesh, role=Role.AVOID),)
    return case, anatomy, plan


def matrix(pose):
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([pose["orientation"][name] for name in "xyzw"]).as_matrix()
    T[:3, 3] = [1000 * pose["position"][name] for name in "xyz"]
    return T


@pytest.mark.parametrize("release", [Stores.ROS2_HUMBLE, Stores.ROS2_JAZZY])
def test_messages_are_what_their_definitions_say(room, release):
    case, anatomy, plan = room
    store = type_store(release)
    scene = scene_message(case, anatomy, plan)
    assert holds(through_ros(store, scene, "moveit_msgs/msg/PlanningScene"), scene)
    for goal in goal_messages(plan).values():
        assert holds(through_ros(store, goal, "control_msgs/msg/FollowJointTrajectoryGoal"), goal)
    trajectories = yaml.safe_load(ros2_text(slowly(plan), case_checked=True))
    assert list(trajectories) == ["approach", "insertion"]
    for message in trajectories.values():
        assert holds(through_ros(store, message, "trajectory_msgs/msg/JointTrajectory"), message)


def test_shapes_and_lists_mean_what_their_definitions_say(room):
    """Numbers of box and cylinder, order of sides, a pose for each shape, unit quaternions, nothing removed."""
    case, anatomy, plan = room
    store = type_store()
    constants = {name: value for name, _, value in store.fielddefs["shape_msgs/msg/SolidPrimitive"][0]}
    assert (constants["BOX"], constants["CYLINDER"]) == (BOX, CYLINDER)
    assert (constants["CYLINDER_HEIGHT"], constants["CYLINDER_RADIUS"]) == (0, 1)
    assert [constants[f"BOX_{axis}"] for axis in "XYZ"] == [0, 1, 2]
    scene = through_ros(store, scene_message(case, anatomy, plan), "moveit_msgs/msg/PlanningScene")
    carried = [one["object"] for one in scene["robot_state"]["attached_collision_objects"]]
    assert scene["is_diff"] and scene["robot_state"]["is_diff"]
    for thing in (*scene["world"]["collision_objects"], *carried):
        poses = [*thing["primitive_poses"], *thing["mesh_poses"], thing["pose"]]
        assert len(thing["primitives"]) == len(thing["primitive_poses"]) and thing["operation"] == 0
        assert len(thing["meshes"]) == len(thing["mesh_poses"]) and len(poses) > 1
        for primitive in thing["primitives"]:
            assert len(primitive["dimensions"]) == {BOX: 3, CYLINDER: 2}[primitive["type"]]
            assert min(primitive["dimensions"]) > 0
        for pose in poses:
            assert sum(pose["orientation"][name] ** 2 for name in "xyzw") == pytest.approx(1.0, abs=1e-8)


def test_the_scene_holds_patient_table_gantry_and_needle(room):
    case, anatomy, plan = room
    scene = scene_message(case, anatomy, plan)
    things = {one["id"]: one for one in scene["world"]["collision_objects"]}
    assert sum(name.startswith("gantry") for name in things) == 24 and {"patient", "table"} < set(things)
    T_ros_ct = matrix(things["patient"]["mesh_poses"][0])
    assert np.allclose(T_BASE_URDFBASE @ T_ros_ct, plan.T_base_ct, atol=1e-5)
    (mesh,) = things["patient"]["meshes"]
    vertices = 1000 * np.array([[v[name] for name in "xyz"] for v in mesh["vertices"]])
    assert np.abs(vertices - anatomy.skin.mesh.vertices).max() < 1e-3
    faces = [face["vertex_indices"] for face in mesh["triangles"]]
    assert np.array_equal(faces, anatomy.skin.mesh.faces)
    (pose,), (table,) = things["table"]["primitive_poses"], things["table"]["primitives"]
    assert table["dimensions"] == pytest.approx([0.5, 0.02, 1.8])
    assert np.allclose(matrix(pose), T_BASE_URDFBASE @ plan.T_base_ct @ matrix_at([0.0, 120.0, 0.0]), atol=1e-5)
    assert scene["robot_state"]["joint_state"]["position"] == plan.approach.q[0].tolist()


def matrix_at(place):
    T = np.eye(4)
    T[:3, 3] = place
    return T


def test_the_attached_needle_ends_on_the_target(room):
    """At the plan's last state the end of the attached cylinder is the target; the holder begins at the flange."""
    case, anatomy, plan = room
    holder, needle = scene_message(case, anatomy, plan)["robot_state"]["attached_collision_objects"]
    height, radius = needle["object"]["primitives"][0]["dimensions"]
    T = matrix(needle["object"]["primitive_poses"][0])
    T_base_flange = flange_pose(plan.model, plan.insertion.q[-1:])[0]
    tip = (T_base_flange @ T @ matrix_at([0, 0, 500 * height]))[:3, 3]
    assert np.allclose(tip, (plan.T_base_ct @ [*case.target_ct, 1.0])[:3], atol=1e-3)
    assert (height, radius) == pytest.approx((0.15, 0.0006))
    start = (
        matrix(holder["object"]["primitive_poses"][0])[2, 3] - 500 * holder["object"]["primitives"][0]["dimensions"][0]
    )
    assert start == pytest.approx(0.0)
    assert needle["link_name"] == "tool0" and "wrist_3_link" in needle["touch_links"]


def slowly(plan):
    parts = {name: getattr(plan, name) for name in ("approach", "insertion")}
    slow = {name: Trajectory(SLOWER * part.times_s, part.q) for name, part in parts.items()}
    return SimpleNamespace(**{**vars(plan), **slow})


def test_goals_read_back_as_the_plan(room, tmp_path):
    plan = slowly(room[2])
    text = json.dumps(goal_messages(plan))
    check_goals(json.loads(text), plan, where=tmp_path)
    changed = json.loads(text)
    changed["insertion"]["trajectory"]["points"][3]["positions"][2] += 1e-6
    with refused("not_read_back"):
        check_goals(changed, plan, where=tmp_path)
    changed = json.loads(text)
    changed["approach"]["trajectory"]["joint_names"].reverse()
    with refused("other_joints"):
        check_goals(changed, plan, where=tmp_path)


@pytest.mark.parametrize("name", ["ur3", "ur10e"])
def test_the_urdf_carries_the_needle(name):
    robot = ElementTree.fromstring(urdf_with_needle(ur_model(name), Tool(210.0, 150.0, 1.2, 30.0)))
    links = {link.get("name") for link in robot.findall("link")}
    assert {"base_link", "tool0", "needle", "needle_holder", "needle_tip"} <= links
    assert [j.get("name") for j in robot.findall("joint") if j.get("type") == "revolute"] == list(JOINT_NAMES)
    ends = {j.find("child").get("link"): j for j in robot.findall("joint")}
    assert set(ends) == links - {"base_link"}  # a tree
    assert ends["needle_tip"].find("parent").get("link") == "tool0"
    assert float(ends["needle_tip"].find("origin").get("xyz").split()[2]) == pytest.approx(0.21)
    assert all(mesh.get("filename").startswith("file:///") for mesh in robot.iter("mesh"))


def test_the_sender_is_short_and_sound():
    """It compiles, asks before it sends, names both files, and has ten statements in lines below its imports."""
    text = SENDER_TEXT.format(sender="plan.send.py", scene="plan.scene.json", goals="plan.goals.json")
    tree = ast.parse(text)
    assert "plan.scene.json" in text and "plan.goals.json" in text
    calls = [node.func for node in ast.walk(tree) if isinstance(node, ast.Call)]
    assert "input" in {call.id for call in calls if isinstance(call, ast.Name)}
    assert len(text.strip().splitlines()) - 7 <= 10


def test_a_plan_without_its_case_has_no_scene(tmp_path, capsys):
    (tmp_path / "plan.json").write_text("{}")
    command = ["export", tmp_path / "plan.json", "--format", "moveit", "--out", tmp_path / "out"]
    refused_command(command, capsys, "missing_option", "--case CASE")
