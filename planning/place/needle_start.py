"""Where the needle itself cannot stand before the insertion, whatever holds it."""

from __future__ import annotations

import fcl
import numpy as np
from numpy.typing import NDArray

from planning.mesh import TriangleMesh
from planning.place.directions import WantedDirections
from planning.robot.insertion import flange_poses
from planning.robot.shapes import skin_surface, touch
from planning.robot.state_checker import PATIENT
from planning.robot.tool import Tool

Floats = NDArray[np.float64]


def needle_can_start(
    tool: Tool, skin: TriangleMesh, target_ct: Floats, wanted: WantedDirections, padding_mm: float
) -> NDArray[np.bool_]:
    """Whether the padded needle, at standoff, is clear of the skin: no placement can hold a direction where it is not.

    Args:
        tool: With the needle.
        skin: CT frame.
        target_ct: Shape (3,), mm.
        wanted: n directions.
        padding_mm: What the arm's checker keeps from the patient.

    Returns:
        Shape (n,).
    """
    start, end = tool.needle_span_mm
    needle = fcl.CollisionObject(fcl.Cylinder(tool.needle_diameter_mm / 2 + padding_mm, end - start + 2 * padding_mm))
    patient = skin_surface(skin, PATIENT)
    # From the tip, at the standoff from the target, the needle's middle is half its body farther out.
    poses = flange_poses(target_ct, wanted.outward_ct, wanted.standoff_mm + (end - start) / 2)
    clear = np.empty(len(wanted), np.bool_)
    for row, T in enumerate(poses):
        needle.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))
        clear[row] = not touch(patient, needle)
    return clear
