"""``moveit_msgs/PlanningScene``: patient, table and gantry in the world, holder and needle attached to the flange."""

from __future__ import annotations

from typing import Any

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.arm.model_urdf import model_urdf
from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.surroundings import case_boxes
from puncture_twin.planning.collision.workcell import case_tool, patient_surface
from puncture_twin.planning.export.moveit.messages import (
    RosFrames,
    box_message,
    cylinder_message,
    mesh_message,
    pose_message,
)
from puncture_twin.planning.plan.plan import Plan

PATIENT, NEEDLE, HOLDER = "patient", "needle", "needle_holder"


def scene_message(case: Case, anatomy: Anatomy, plan: Plan) -> dict[str, Any]:
    """The scene as a difference to what MoveIt knows: all that the plan was checked against, and its first state.

    Args:
        case: The plan's case.
        anatomy: Its structures and skin.
        plan: The plan; its registration places the patient.
    """
    frames = RosFrames.of(model_urdf(plan.model))
    solids = [_solid(box, frames) for box in case_boxes(case, plan.T_base_ct)]
    start = {"name": list(plan.model.joint_names), "position": [float(angle) for angle in plan.approach.q[0]]}
    carried = _attached(case_tool(case), frames)
    return {
        "name": "puncture",
        "is_diff": True,
        "robot_state": {
            "is_diff": True,
            "joint_state": start,
            "attached_collision_objects": carried,
        },
        "world": {"collision_objects": [_patient(anatomy, plan, frames), *solids]},
    }


def _patient(anatomy: Anatomy, plan: Plan, frames: RosFrames) -> dict[str, Any]:
    """The skin with all that the CT shows outside of it, in its own frame; the pose says where it lies."""
    pose = pose_message(frames.T_root_base @ plan.T_base_ct)
    return _object(PATIENT, frames.root) | {"meshes": [mesh_message(patient_surface(anatomy))], "mesh_poses": [pose]}


def _solid(box: Box, frames: RosFrames) -> dict[str, Any]:
    primitive, pose = box_message(box, frames)
    return _object(box.name, frames.root) | {"primitives": [primitive], "primitive_poses": [pose]}


def _attached(tool: Tool, frames: RosFrames) -> list[dict[str, Any]]:
    ends = tool.needle_length_mm - tool.shaft_mm, tool.needle_length_mm
    parts = [(NEEDLE, *ends, tool.needle_diameter_mm)]
    if ends[0] > 0:
        parts.insert(0, (HOLDER, 0.0, ends[0], tool.holder_diameter_mm))
    made = []
    for name, start, end, diameter in parts:
        primitive, pose = cylinder_message(start, end, diameter)
        body = _object(name, frames.flange) | {"primitives": [primitive], "primitive_poses": [pose]}
        made.append({"link_name": frames.flange, "object": body, "touch_links": list(frames.touching)})
    if tool.body is not None:
        body = _object("tool", frames.flange) | {
            "meshes": [mesh_message(tool.body.mesh)],
            "mesh_poses": [pose_message(np.eye(4))],
        }
        made.append({"link_name": frames.flange, "object": body, "touch_links": list(frames.touching)})
    return made


def _object(name: str, frame: str) -> dict[str, Any]:
    """``moveit_msgs/CollisionObject``; its own pose is the frame's, those of its shapes say the rest."""
    return {"header": {"frame_id": frame}, "id": name, "pose": {"orientation": {"w": 1.0}}}
