"""A plan for MoveIt: scene, goals and a URDF with the needle, in metres; each read back before any is published."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.links import address_file, model_urdf
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import ArmUrdf
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import case_boxes, case_tool, patient_surface
from puncture_twin.planning.export.program import SampledMotion, check_sampled, warning_lines
from puncture_twin.planning.export.ros2 import NANOSECONDS, TIME_RESOLUTION_S, velocities
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.motion.trajectory import Trajectory
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_geometry

PATIENT, NEEDLE, HOLDER = "patient", "needle", "needle_holder"


def scene_message(case: Case, anatomy: Anatomy, plan: Plan) -> dict[str, Any]:
    """The scene as a difference to what MoveIt knows: all that the plan was checked against, and its first state."""
    frames = RosFrames.of(model_urdf(plan.model))
    # the skin with all that the CT shows outside of it, in its own frame; the pose says where it lies
    patient = _mesh(patient_surface(anatomy), frames.T_root_base @ plan.T_base_ct)
    objects = [_object(PATIENT, frames.root) | patient]
    objects += [_object(box.name, frames.root) | box_message(box, frames) for box in case_boxes(case, plan.T_base_ct)]
    start = {"name": list(plan.model.joint_names), "position": [float(angle) for angle in plan.approach.q[0]]}
    carried = _attached(case_tool(case), frames)
    return {
        "name": "puncture",
        "is_diff": True,
        "robot_state": {"is_diff": True, "joint_state": start, "attached_collision_objects": carried},
        "world": {"collision_objects": objects},
    }


def _attached(tool: Tool, frames: RosFrames) -> list[dict[str, Any]]:
    ends = tool.needle_length_mm - tool.shaft_mm, tool.needle_length_mm
    parts = [(NEEDLE, *ends, tool.needle_diameter_mm)]
    if ends[0] > 0:
        parts.insert(0, (HOLDER, 0.0, ends[0], tool.holder_diameter_mm))
    bodies = [_object(name, frames.flange) | cylinder_message(start, end, wide) for name, start, end, wide in parts]
    if tool.body is not None:
        bodies.append(_object("tool", frames.flange) | _mesh(tool.body.mesh, np.eye(4)))
    return [{"link_name": frames.flange, "object": one, "touch_links": list(frames.touching)} for one in bodies]


def _object(name: str, frame: str) -> dict[str, Any]:
    """``moveit_msgs/CollisionObject``; its own pose is the frame's, those of its shapes say the rest."""
    return {"header": {"frame_id": frame}, "id": name, "pose": {"orientation": {"w": 1.0}}}


PATH_TOLERANCE_RAD, GOAL_TOLERANCE_RAD = 0.02, 0.002
"""Beyond them the controller gives up: along the path 20 mm at a metre, at the end 2 mm."""
GOAL_TIME_S = 1
"""Seconds later than planned that the arm may arrive."""


def goal_messages(plan: Plan) -> dict[str, Any]:
    """The goals ``approach`` and ``insertion``."""
    goals, names = {}, plan.model.joint_names
    for phase in SampledMotion._fields:
        trajectory: Trajectory = getattr(plan, phase)
        points = []
        speeds = velocities(plan.model, trajectory)
        for time_s, q, rates in zip(trajectory.times_s.tolist(), trajectory.q.tolist(), speeds.tolist(), strict=True):
            sec, nanosec = divmod(round(time_s * NANOSECONDS), NANOSECONDS)
            start = {"sec": sec, "nanosec": nanosec}
            points.append({"positions": q, "velocities": rates, "time_from_start": start})
        goals[phase] = {
            "trajectory": {"header": {"frame_id": ""}, "joint_names": list(names), "points": points},
            "path_tolerance": [{"name": name, "position": PATH_TOLERANCE_RAD} for name in names],
            "goal_tolerance": [{"name": name, "position": GOAL_TOLERANCE_RAD} for name in names],
            "goal_time_tolerance": {"sec": GOAL_TIME_S, "nanosec": 0},
        }
    return goals


def check_goals(goals: Any, plan: Plan, *, where: Path) -> None:
    """Refuse goals that were read back and are not the plan's, or break a limit of the arm."""
    parts = {}
    for phase in SampledMotion._fields:
        trajectory = goals[phase]["trajectory"]
        if trajectory["joint_names"] != list(plan.model.joint_names):
            refuse(f"{phase} has other joints", where, ", ".join(plan.model.joint_names), "other_joints")
        starts = [point["time_from_start"] for point in trajectory["points"]]
        times = np.array([one["sec"] + one["nanosec"] / NANOSECONDS for one in starts])
        parts[phase] = Trajectory(times, np.array([point["positions"] for point in trajectory["points"]]))
    check_sampled(SampledMotion(**parts), plan, time_resolution_s=TIME_RESOLUTION_S, where=where)


MOVEIT = "moveit"
SCENE, GOALS, URDF, SENDER = "scene.json", "goals.json", "urdf", "send.py"
"""Ends of the files' names, in the order of `moveit_names`."""
SENDER_TEXT = '''"""Give MoveIt the scene, send one phase: python {sender} approach|insertion. Research software."""
import json, pathlib, sys, rclpy
from control_msgs.action import FollowJointTrajectory
from moveit_msgs.srv import ApplyPlanningScene
from rclpy.action import ActionClient
from rosidl_runtime_py import set_message_fields

scene, goals = (json.loads(pathlib.Path(__file__).with_name(name).read_text()) for name in ("{scene}", "{goals}"))
rclpy.init(); node = rclpy.create_node("puncture"); wait = lambda future: rclpy.spin_until_future_complete(node, future)
request, goal = ApplyPlanningScene.Request(), FollowJointTrajectory.Goal(); print(*goals["warnings"], sep="\\n")
set_message_fields(request.scene, scene); set_message_fields(goal, goals[sys.argv[1]])
apply = node.create_client(ApplyPlanningScene, "/apply_planning_scene"); apply.wait_for_service()
wait(applied := apply.call_async(request)); assert applied.result().success, "MoveIt refused the scene"
arm = ActionClient(node, FollowJointTrajectory, "/scaled_joint_trajectory_controller/follow_joint_trajectory")
arm.wait_for_server(); input("The arm stands at the first positions, and nobody is near? Enter sends. ")
wait(sent := arm.send_goal_async(goal)); assert sent.result().accepted, "the controller refused the goal"
wait(done := sent.result().get_result_async()); print(done.result().result)
'''


def moveit_names(stem: str) -> tuple[str, ...]:
    """Names of the MoveIt files of a plan."""
    return tuple(f"{stem}.{end}" for end in (SCENE, GOALS, URDF, SENDER))


def moveit_files(plan: Plan, case: Case, anatomy: Anatomy, *, source: Path) -> Mapping[str, str]:
    """Name to text of the MoveIt files. Raises InputError: a plan that contradicts itself, or a number over a limit."""
    check_geometry(plan, source)
    names = moveit_names(source.stem)
    goals = _json({**goal_messages(plan), "warnings": warning_lines(plan.warnings)})
    check_goals(json.loads(goals), plan, where=source)
    urdf = urdf_with_needle(plan.model, case_tool(case))
    if not ElementTree.fromstring(urdf).findall("link"):
        refuse("the URDF does not read back", source, "links and joints", "not_read_back")
    sender = SENDER_TEXT.format(sender=names[3], scene=names[0], goals=names[1])
    return dict(zip(names, (_json(scene_message(case, anatomy, plan)), goals, urdf, sender), strict=True))


def _json(document: object) -> str:
    return json.dumps(document, allow_nan=False, separators=(",", ":")) + "\n"


M_PER_MM = 1e-3
BOX, CYLINDER = 1, 3
"""Types of ``shape_msgs/SolidPrimitive``."""
GRAIN_M = 1e-6
"""Rounding of coordinates, m."""


class RosFrames(NamedTuple):
    """The links of an arm's URDF in which messages speak."""

    root: str  # the root, of a UR ``base_link``: the controller's base rotated by 180 deg about z
    flange: str  # the controller's flange, of a UR ``tool0``
    touching: tuple[str, ...]  # what holder and needle are bolted to
    T_root_base: Floats  # shape (4, 4), mm: the controller's base in the root's frame

    @classmethod
    def of(cls, urdf: ArmUrdf) -> RosFrames:
        """The frames of an arm's URDF."""
        last = [member.link.name for member in urdf.chain.bodies[-1]]
        touching = dict.fromkeys((last[0], "flange", urdf.chain.flange, *last[1:]))
        T_root_base = np.asarray(np.linalg.inv(urdf.T_base_root), np.float64)
        return cls(urdf.root, urdf.chain.flange, tuple(touching), T_root_base)


def pose_message(T: Floats) -> dict[str, Any]:
    """``geometry_msgs/Pose`` of a motion, shape (4, 4), mm."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"position": _named("xyz", T[:3, 3] * M_PER_MM), "orientation": _named("xyzw", quaternion)}


def box_message(box: Box, frames: RosFrames) -> dict[str, Any]:
    """``shape_msgs/SolidPrimitive`` of a box in the controller's base frame, and its pose in the root's."""
    return _primitive(BOX, [float(side) * M_PER_MM for side in box.size_mm], frames.T_root_base @ box.T_base_box)


def cylinder_message(start_mm: float, end_mm: float, diameter_mm: float) -> dict[str, Any]:
    """A cylinder along z of the flange, and its pose there: about its middle, as the definition has it."""
    T = np.eye(4)
    T[2, 3] = (start_mm + end_mm) / 2
    return _primitive(CYLINDER, [(end_mm - start_mm) * M_PER_MM, diameter_mm / 2 * M_PER_MM], T)


def _primitive(kind: int, dimensions: list[float], T: Floats) -> dict[str, Any]:
    return {"primitives": [{"type": kind, "dimensions": dimensions}], "primitive_poses": [pose_message(T)]}


def _mesh(mesh: TriangleMesh, T: Floats) -> dict[str, Any]:
    """``shape_msgs/Mesh`` of a surface in mm, and its pose."""
    triangles = [{"vertex_indices": [int(i) for i in face]} for face in mesh.faces]
    vertices = [_named("xyz", vertex) for vertex in np.round(mesh.vertices * M_PER_MM / GRAIN_M) * GRAIN_M]
    return {"meshes": [{"triangles": triangles, "vertices": vertices}], "mesh_poses": [pose_message(T)]}


def _named(names: str, values: Floats) -> dict[str, float]:
    return {name: round(float(value), 9) for name, value in zip(names, values, strict=True)}


TIP_FRAME = "needle_tip"


def urdf_with_needle(model: UrModel, tool: Tool) -> str:
    """The URDF's text; its meshes are named by absolute addresses of this installation."""
    urdf = model_urdf(model)
    robot, flange = ElementTree.fromstring(urdf.text), urdf.chain.flange
    for mesh in robot.iter("mesh"):
        file = address_file(urdf, mesh.get("filename", ""))
        mesh.set("filename", Path(file).as_uri() if Path(file).is_absolute() else file)
    start = tool.needle_length_mm - tool.shaft_mm
    cylinders = [("needle", start, tool.shaft_mm, tool.needle_diameter_mm)]
    if start > 0:
        cylinders.insert(0, ("needle_holder", 0.0, start, tool.holder_diameter_mm))
    for name, at_mm, length_mm, diameter_mm in cylinders:
        origin = {"rpy": "0 0 0", "xyz": f"0 0 {_metres(length_mm / 2)}"}
        shape = {"radius": _metres(diameter_mm / 2), "length": _metres(length_mm)}
        _add_link(robot, flange, name, at_mm, origin, "cylinder", shape)
    if tool.body is not None:  # the tool's own file, scaled to metres
        T, scale = tool.body.T_flange_file, f"{tool.body.unit_mm * M_PER_MM:.9g}"
        rpy = " ".join(f"{angle:.12g}" for angle in Rotation.from_matrix(T[:3, :3]).as_euler("xyz"))
        origin = {"rpy": rpy, "xyz": " ".join(_metres(value) for value in T[:3, 3])}
        shape = {"filename": tool.body.file.resolve().as_uri(), "scale": " ".join([scale] * 3)}
        _add_link(robot, flange, "tool", 0.0, origin, "mesh", shape)
    _add_link(robot, flange, TIP_FRAME, tool.needle_length_mm)
    ElementTree.indent(robot, " ")
    return '<?xml version="1.0"?>\n' + ElementTree.tostring(robot, encoding="unicode") + "\n"


def _add_link(robot: ElementTree.Element, flange: str, name: str, at_mm: float, *shape: Any) -> None:
    """Bolt a link to the flange: of a shape, by its origin, tag and numbers, or of none."""
    link = ElementTree.SubElement(robot, "link", name=name)
    for kind in ("visual", "collision") if shape else ():
        part, (origin, tag, numbers) = ElementTree.SubElement(link, kind), shape
        ElementTree.SubElement(part, "origin", origin)
        ElementTree.SubElement(ElementTree.SubElement(part, "geometry"), tag, numbers)
    joint = ElementTree.SubElement(robot, "joint", name=f"{flange}-{name}", type="fixed")
    ElementTree.SubElement(joint, "parent", link=flange)
    ElementTree.SubElement(joint, "child", link=name)
    ElementTree.SubElement(joint, "origin", rpy="0 0 0", xyz=f"0 0 {_metres(at_mm)}")


def _metres(mm: float) -> str:
    return f"{mm * M_PER_MM:.9f}"
