"""Messages of ROS 2 as plain values, in metres: what both the scene and the goals are made of."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.links import T_BASE_URDFBASE
from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

M_PER_MM = 1e-3

BASE_FRAME, FLANGE_FRAME = "base_link", "tool0"
"""ROS's base is the controller's turned by 180 deg about z; ``tool0`` is the controller's flange."""

BOX, CYLINDER = 1, 3
"""Of ``shape_msgs/SolidPrimitive``."""

GRAIN_M = 1e-6
"""To what coordinates are rounded."""

T_ROSBASE_BASE = np.linalg.inv(T_BASE_URDFBASE)


def pose_message(T: Floats) -> dict[str, Any]:
    """``geometry_msgs/Pose`` of a motion, shape (4, 4), mm."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"position": _named("xyz", T[:3, 3] * M_PER_MM), "orientation": _named("xyzw", quaternion)}


def box_message(box: Box) -> tuple[dict[str, Any], dict[str, Any]]:
    """``shape_msgs/SolidPrimitive`` of a box in the controller's base frame, and its pose in ROS's."""
    sides = [float(side) * M_PER_MM for side in box.size_mm]
    return {"type": BOX, "dimensions": sides}, pose_message(T_ROSBASE_BASE @ box.T_base_box)


def cylinder_message(start_mm: float, end_mm: float, diameter_mm: float) -> tuple[dict[str, Any], dict[str, Any]]:
    """A cylinder along z of the flange, and its pose there: about its middle, as the definition has it."""
    T = np.eye(4)
    T[2, 3] = (start_mm + end_mm) / 2
    size = [(end_mm - start_mm) * M_PER_MM, diameter_mm / 2 * M_PER_MM]
    return {"type": CYLINDER, "dimensions": size}, pose_message(T)


def mesh_message(mesh: TriangleMesh) -> dict[str, Any]:
    """``shape_msgs/Mesh`` of a surface in mm."""
    vertices = np.round(mesh.vertices * M_PER_MM / GRAIN_M) * GRAIN_M
    return {
        "triangles": [{"vertex_indices": [int(i) for i in face]} for face in mesh.faces],
        "vertices": [_named("xyz", vertex) for vertex in vertices],
    }


def _named(names: str, values: Floats) -> dict[str, float]:
    return {name: round(float(value), 9) for name, value in zip(names, values, strict=True)}
