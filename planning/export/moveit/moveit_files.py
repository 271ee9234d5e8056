"""The files of a plan for MoveIt: each read back before any is published."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from xml.etree import ElementTree

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.workcell import case_tool
from puncture_twin.planning.export.moveit.goal_messages import check_goals, goal_messages
from puncture_twin.planning.export.moveit.scene_message import scene_message
from puncture_twin.planning.export.moveit.urdf import urdf_with_needle
from puncture_twin.planning.export.text import warning_lines
from puncture_twin.planning.plan.plan import Plan
from puncture_twin.planning.plan.plan_check import check_geometry

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
    """The files' names for a plan's."""
    return tuple(f"{stem}.{end}" for end in (SCENE, GOALS, URDF, SENDER))


def moveit_files(plan: Plan, case: Case, anatomy: Anatomy, *, source: Path) -> Mapping[str, str]:
    """Name to text.

    Args:
        plan: A plan that was checked against its case.
        case: The plan's.
        anatomy: The case's.
        source: The plan's file, for the names and for errors.

    Raises:
        InputError: A plan that contradicts itself, or a number beyond the arm's limits.
    """
    check_geometry(plan, source)
    names = moveit_names(source.stem)
    goals = _json({**goal_messages(plan), "warnings": warning_lines(plan.warnings)})
    check_goals(json.loads(goals), plan, where=source)
    urdf = urdf_with_needle(plan.model, case_tool(case))
    if not ElementTree.fromstring(urdf).findall("link"):
        raise InputError("the URDF does not read back", where=source, allowed="links and joints")
    sender = SENDER_TEXT.format(sender=names[3], scene=names[0], goals=names[1])
    return dict(zip(names, (_json(scene_message(case, anatomy, plan)), goals, urdf, sender), strict=True))


def _json(document: object) -> str:
    return json.dumps(document, allow_nan=False, separators=(",", ":")) + "\n"
