"""The whole workcell: the arm with its needle, the patient at their true place, and the boxes around them.

The world frame is the controller's base frame.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from puncture_twin.planning.arm.tool import Box, Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.state_checker import PATIENT
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.world.arm import Arm, load_arm
from puncture_twin.twin.world.bodies import let_pass, load_box, load_surface
from puncture_twin.twin.world.client import physics_client


@dataclass(frozen=True)
class SimulatedWorkcell:
    """A room that is open.

    Attributes:
        client: Physics client id.
        arm: The arm; its base frame is the world frame.
        bodies: Body id to name, the arm not among them.
    """

    client: int
    arm: Arm
    bodies: MappingProxyType[int, str]


@contextmanager
def open_workcell(
    model: UrModel,
    tool: Tool,
    skin: TriangleMesh,
    T_base_ct: Floats,
    boxes: Sequence[Box] = (),
    *,
    down_ct: Floats,
) -> Iterator[SimulatedWorkcell]:
    """Build the room, yield it, and take it down.

    The needle's shaft passes the skin without resistance; its holder and the arm collide with it.

    Args:
        model: A UR3, UR5 or UR10.
        tool: Holder and needle.
        skin: The patient's surface, CT frame, mm.
        T_base_ct: Where the patient lies, shape (4, 4), mm.
        boxes: Table and the like.
        down_ct: Unit vector of gravity in the CT frame, shape (3,).

    Raises:
        InputError: There is no body of that arm.
    """
    with physics_client(down=T_base_ct[:3, :3] @ down_ct) as client:
        arm = load_arm(client, model, tool)
        patient = load_surface(client, skin, T_base_ct, solid=True)
        let_pass(client, arm.body, arm.links["needle"], patient)
        names = {patient: PATIENT}
        for box in boxes:
            names[load_box(client, np.asarray(box.size_mm), box.T_base_box)] = box.name
        yield SimulatedWorkcell(client, arm, MappingProxyType(names))
