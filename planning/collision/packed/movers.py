"""What moves: how far a turn of each joint moves a body, and the sphere about it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.sphere_tree import enclosing_sphere
from puncture_twin.planning.collision.check import Check
from puncture_twin.planning.collision.kernels.proofs import Movers
from puncture_twin.planning.collision.packed.hulls import in_frame
from puncture_twin.planning.geometry.rigid import apply


def joint_levers(model: UrModel, check: Check) -> Floats:
    """How far a turn of each joint (6,) may move the second body against the first, mm/rad.

    A body's point is no farther from a joint's axis than the links between reach, end to end, and the body itself.
    Only the joints between the two bodies move them against one another.
    """
    levers = np.zeros(6)
    if check.hulls is None or check.first_body is None:
        return levers
    body = check.second_body
    own = np.linalg.norm(apply(body.T_frame_body, check.hulls[1]), axis=1).max()
    lengths = np.hypot(model.a, model.d)
    for joint in range(check.first_body.frame, body.frame):
        levers[joint] = abs(model.a[joint]) + lengths[joint + 1 : body.frame].sum() + own
    return levers


def packed_movers(checks: Sequence[Check]) -> Movers:
    """The piece that each check is about, or all of a body for the skin."""
    rows: dict[int, int] = {}
    frames, spheres, mover = [], [], []
    for check in checks:
        body = check.second_body
        key = id(body) if check.hulls is None else id(check.hulls[1])
        if key not in rows:
            rows[key] = len(rows)
            corners = np.concatenate(body.full.hulls) if check.hulls is None else check.hulls[1]
            frames.append(body.frame)
            spheres.append(enclosing_sphere(in_frame(corners, body)))
        mover.append(rows[key])
    centres, radii = np.array([sphere.centre for sphere in spheres]), np.array([sphere.radius for sphere in spheres])
    return Movers(np.array(mover, dtype=np.int64), np.array(frames, dtype=np.int64), centres, radii)
