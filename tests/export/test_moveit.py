"""What MoveIt and ROS 2 are given: by the definitions of their messages, and back in millimetres where the plan is."""

import ast
import json
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest
import report_world as world
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.anatomy import Role
from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.arm.model_urdf import T_BASE_URDFBASE
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import JOINT_NAMES, ur_model
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.settings import Gantry, Obstacle
from puncture_twin.planning.export.moveit.goal_messages import check_goals, goal_messages
from puncture_twin.planning.export.moveit.moveit_files import SENDER_TEXT
from puncture_twin.planning.export.moveit.scene_message import scene_message
from puncture_twin.planning.export.moveit.urdf import urdf_with_needle
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.run_twin import main

typesys = pytest.importorskip("rosbags.typesys", reason="rosbags is not installed: make install brings it")

MOVEIT = {
    "moveit_msgs/msg/PlanningScene": {
        "name": "string",
        "robot_state": "moveit_msgs/msg/RobotState",
        "robot_model_name": "string",
        "world": "moveit_msgs/msg/PlanningSceneWorld",
        "is_diff": "bool",
    },
    "moveit_msgs/msg/RobotState": {
        "joint_state": "sensor_msgs/msg/JointState",
        "attached_collision_objects": ["moveit_msgs/msg/AttachedCollisionObject"],
        "is_diff": "bool",
    },
    "moveit_msgs/msg/PlanningSceneWorld": {"collision_objects": ["moveit_msgs/msg/CollisionObject"]},
    "moveit_msgs/msg/AttachedCollisionObject": {
        "link_name": "string",
        "object": "moveit_msgs/msg/CollisionObject",
        "touch_links": ["string"],
        "weight": "float64",
    },
    "moveit_msgs/msg/CollisionObject": {
        "header": "std_msgs/msg/Header",
        "pose": "geometry_msgs/msg/Pose",
        "id": "string",
        "primitives": ["shape_msgs/msg/SolidPrimitive"],
        "primitive_poses": ["geometry_msgs/msg/Pose"],
        "meshes": ["shape_msgs/msg/Mesh"],
        "mesh_poses": ["geometry_msgs/msg/Pose"],
        "operation": "byte",
    },
    "control_msgs/action/FollowJointTrajectory_Goal": {
        "trajectory": "trajectory_msgs/msg/JointTrajectory",
        "path_tolerance": ["control_msgs/msg/JointTolerance"],
        "goal_tolerance": ["control_msgs/msg/JointTolerance"],
        "goal_time_tolerance": "builtin_interfaces/msg/Duration",
    },
    "control_msgs/msg/JointTolerance": dict.fromkeys(("position", "velocity", "acceleration"), "float64")
    | {"name": "string"},
}
"""Fields of ROS 2 Humble (moveit_msgs 2.2, control_msgs 4): those of them that a message here may set."""

STORE = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
SLOWER = 30.0
"""The small patient's plan runs at any speed."""

NUMBERS = {"float32": float, "float64": float, "bool": bool, "string": str}


def field_types(name):
    """Field to its type: a name, a list of one name, or a base type; by rosbags' own definitions where it has them."""
    if name in MOVEIT:
        return MOVEIT[name]
    return {field: typed(kind) for field, kind in STORE.fielddefs[name][1]}


def typed(kind):
    """A type of rosbags in the form of the table above."""
    node, inside = kind
    if node == typesys.base.Nodetype.BASE:
        return inside[0]
    return inside if node == typesys.base.Nodetype.NAME else [typed(inside[0])]


def check(value, kind):
    """Every field is one of its message's, and of its type; integers are no floats, and no number is NaN."""
    if isinstance(kind, list):
        assert isinstance(value, list)
        for one in value:
            check(one, kind[0])
    elif "/" in kind:
        fields = field_types(kind)
        assert set(value) <= set(fields), (kind, set(value) - set(fields))
        for field, one in value.items():
            check(one, fields[field])
    else:
        assert isinstance(value, NUMBERS.get(kind, int)), (kind, value)


@pytest.fixture(scope="module")
def room():
    """The small patient between a table and a gantry, and a plan."""
    case = world.make_case()
    plan = world.make_plan(case, world.make_candidates(case))
    case.obstacles = (Obstacle("table", "ct", np.array([0.0, 120.0, 0.0]), np.array([500.0, 20.0, 1800.0])),)
    case.gantry = Gantry(np.eye(4), 700.0, 200.0, 300.0)
    anatomy = world.make_anatomy()
    anatomy.surroundings = (SimpleNamespace(mesh=anatomy.skin.mesh, role=Role.AVOID),)
    return case, anatomy, plan


def matrix(pose):
    """A message's pose as (4, 4), mm."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_quat([pose["orientation"][name] for name in "xyzw"]).as_matrix()
    T[:3, 3] = [1000 * pose["position"][name] for name in "xyz"]
    return T


def test_messages_are_what_their_definitions_say(room):
    """Scene and goals: no field that ROS does not know, every value of its type."""
    case, anatomy, plan = room
    check(scene_message(case, anatomy, plan), "moveit_msgs/msg/PlanningScene")
    for goal in goal_messages(plan).values():
        check(goal, "control_msgs/action/FollowJointTrajectory_Goal")
    with pytest.raises(AssertionError, match="positio"):
        check({"positio": 1.0}, "control_msgs/msg/JointTolerance")


def test_the_scene_holds_patient_table_gantry_and_needle(room):
    """The patient where the registration has him, in ROS's base; the table's middle and sides; all of the bore."""
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
    """A shift, mm."""
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
    """The same way, slowly enough for the arm's limits."""
    parts = {name: getattr(plan, name) for name in ("approach", "insertion")}
    slow = {name: Trajectory(SLOWER * part.times_s, part.q) for name, part in parts.items()}
    return SimpleNamespace(**{**vars(plan), **slow})


def test_goals_read_back_as_the_plan(room, tmp_path):
    """Through JSON; another joint's order, or one angle that differs, is refused."""
    plan = slowly(room[2])
    text = json.dumps(goal_messages(plan))
    check_goals(json.loads(text), plan, where=tmp_path)
    changed = json.loads(text)
    changed["insertion"]["trajectory"]["points"][3]["positions"][2] += 1e-6
    with pytest.raises(InputError, match="the insertion does not read back"):
        check_goals(changed, plan, where=tmp_path)
    changed = json.loads(text)
    changed["approach"]["trajectory"]["joint_names"].reverse()
    with pytest.raises(InputError, match="approach is of other joints"):
        check_goals(changed, plan, where=tmp_path)


@pytest.mark.parametrize("name", ["ur3", "ur10e"])
def test_the_urdf_carries_the_needle(name):
    """Six joints as the arm's, meshes that exist, and the tip at the needle's length from the flange."""
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
    """One line, exit code 2."""
    (tmp_path / "plan.json").write_text("{}")
    assert main(["export", str(tmp_path / "plan.json"), "--format", "moveit", "--out", str(tmp_path / "out")]) == 2
    assert "allowed: export plan.json --case CASE" in capsys.readouterr().err
