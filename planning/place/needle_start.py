"""Where the needle itself cannot stand before the insertion, whatever holds it."""

from __future__ import annotations

from functools import partial

import fcl
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.insertion import flange_poses
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.collision.patient import FclSkin
from puncture_twin.planning.collision.state_checker import PATIENT
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.place.directions import WantedDirections


def needle_can_start(
    tool: Tool, skin: TriangleMesh, target_ct: Floats, wanted: WantedDirections, padding_mm: float
) -> NDArray[np.bool_]:
    """Whether the padded needle, at standoff, is clear of the skin: no placement can reach a direction where it is not.

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
    radius, length = tool.needle_diameter_mm / 2 + padding_mm, end - start + 2 * padding_mm
    needle, half = Solid(partial(fcl.Cylinder, radius, length)), np.array([radius, radius, length / 2])
    patient = FclSkin(skin, PATIENT)
    # From the tip, at the standoff from the target, the needle's middle is half its body farther out.
    poses = flange_poses(target_ct, wanted.outward_ct, wanted.standoff_mm + (end - start) / 2)
    clear = np.empty(len(wanted), np.bool_)
    for row, T in enumerate(poses):
        needle.place(fcl.Transform(T[:3, :3], T[:3, 3]))
        clear[row] = not patient.touches(needle, np.array([-half, half]))
    return clear
