"""Whether the shapes of an own arm hang together: a gap at a joint would let a surface pass through the arm unseen."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise, product

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.model_urdf import model_urdf
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies import Body
from puncture_twin.planning.collision.shapes import touch

ANGLES = 72
"""At which a joint is looked at, evenly over the turn: every 5 degrees."""


def check_neighbours(model: UrModel, links: Sequence[Body]) -> None:
    """Refuse an arm of which two neighbouring links do not touch, at whatever angle of the joint between them.

    Args:
        model: The arm.
        links: Its seven bodies, from the base on.

    Raises:
        InputError: Names the links and the angle.
    """
    for joint, (link, following) in enumerate(pairwise(links)):
        for angle in 2.0 * np.pi * np.arange(ANGLES) / ANGLES:
            q = np.zeros(len(links) - 1)
            q[joint] = angle
            poses = link_poses(model, q)
            link.place(poses)
            following.place(poses)
            if not any(touch(a, b) for a, b in product(link.bare.solids, following.bare.solids)):
                at = f"at {np.degrees(angle):g} degrees of their joint"
                what = f"the shapes of {link.name} and {following.name} do not meet {at}"
                allowed = "links that hang together: see the unit, scale and origin of their meshes"
                raise InputError(what, where=model_urdf(model).where, allowed=allowed)
