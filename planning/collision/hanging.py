"""Whether a tool of the user's own hangs on the arm: one that floats could lie wholly in the patient, unseen."""

from __future__ import annotations

from collections.abc import Sequence

import fcl

from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.collision.bodies.shapes import convex, padded, touch

APART_MM = 1.0
"""What a mesh may leave between its parts, or to the flange: less than a gap through which a surface could pass."""

CARRIERS = ("wrist_3", "holder", "needle")
"""What a tool is bolted to."""


def check_hanging(tool: ToolBody, bodies: Sequence[Body]) -> None:
    """Refuse a tool of which a part touches neither wrist, holder nor needle, nor a part that does.

    Args:
        tool: The tool.
        bodies: Of the arm; those of the flange all move with one frame.

    Raises:
        InputError: Says how large the tool is and where it lies.
    """
    free = [fcl.CollisionObject(convex(padded(piece, APART_MM))) for piece in tool.pieces]
    carriers = [body for body in bodies if body.name in CARRIERS]
    hanging: list[fcl.CollisionObject] = []
    for body in carriers:
        for solid in body.bare.solids:
            solid.place(fcl.Transform(body.T_frame_body[:3, :3], body.T_frame_body[:3, 3]))
            hanging.append(solid.made)
    while hanging and free:
        one = hanging.pop()
        hanging += [piece for piece in free if touch(one, piece)]
        free = [piece for piece in free if piece not in hanging]
    if free:
        low, high = tool.mesh.bounds
        span = " by ".join(f"{a:.4g}..{b:.4g}" for a, b in zip(low, high, strict=True))
        what = f"the tool ({span} mm in the flange's frame) does not hang on wrist, holder or needle"
        raise InputError(what, where=tool.key, allowed="a body that touches them: see unit, position_mm, rotation_deg")
