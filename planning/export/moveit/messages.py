"""Messages of ROS 2 as plain values, in metres: what both the scene and the goals are made of."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.urdf.arm_urdf import ArmUrdf
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

M_PER_MM = 1e-3

BOX, CYLINDER = 1, 3
"""Of ``shape_msgs/SolidPrimitive``."""

GRAIN_M = 1e-6
"""To what coordinates are rounded."""


class RosFrames(NamedTuple):
    """The links of an arm's URDF in which messages speak."""

    root: str
    """The root, of a UR ``base_link``: the controller's base turned by 180 deg about z."""
    flange: str
    """The controller's flange, of a UR ``tool0``."""
    touching: tuple[str, ...]
    """What holder and needle are bolted to."""
    T_root_base: Floats
    """Shape (4, 4), mm: the controller's base in the root's frame."""

    @classmethod
    def of(cls, urdf: ArmUrdf) -> RosFrames:
        """Those of an arm."""
        last = [member.link.name for member in urdf.chain.bodies[-1]]
        touching = dict.fromkeys((last[0], "flange", urdf.chain.flange, *last[1:]))
        return cls(
            urdf.root, urdf.chain.flange, tuple(touching), np.asarray(np.linalg.inv(urdf.T_base_root), np.float64)
        )


def pose_message(T: Floats) -> dict[str, Any]:
    """``geometry_msgs/Pose`` of a motion, shape (4, 4), mm."""
    quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
    return {"position": _named("xyz", T[:3, 3] * M_PER_MM), "orientation": _named("xyzw", quaternion)}


def box_message(box: Box, frames: RosFrames) -> tuple[dict[str, Any], dict[str, Any]]:
    """``shape_msgs/SolidPrimitive`` of a box in the controller's base frame, and its pose in the root's."""
    sides = [float(side) * M_PER_MM for side in box.size_mm]
    return {"type": BOX, "dimensions": sides}, pose_message(frames.T_root_base @ box.T_base_box)


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
