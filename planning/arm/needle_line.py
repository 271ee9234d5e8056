"""The line that a needle is inserted along, and where the flange stands on it."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats


class NeedleLine(NamedTuple):
    """A line to insert along, base frame."""

    R_base_flange: Floats
    """Shape (3, 3): the flange's axes at roll 0."""
    target: Floats
    """Shape (3,), mm."""
    outward: Floats
    """Shape (3,), unit."""


def needle_lines(targets_base: Floats, outwards_base: Floats) -> list[NeedleLine]:
    """Lines through targets (n, 3), mm, outward along unit vectors (n, 3)."""
    rotations = np.ascontiguousarray(flange_poses(targets_base, outwards_base, 0.0)[:, :3, :3])
    return [NeedleLine(*row) for row in zip(rotations, targets_base, outwards_base, strict=True)]


def flange_poses(
    target_base: Floats, outward_base: Floats, distance_mm: Floats | float, roll: Floats | float = 0.0
) -> Floats:
    """Flange poses that point the needle at the target from a distance.

    At roll 0 the flange's x axis is, of the three base axes, the one farthest from the needle, made square to it.

    Args:
        target_base: Shape (3,) or (n, 3), mm.
        outward_base: Shape (3,) or (n, 3), unit. The flange's z axis is its opposite.
        distance_mm: Target to flange; a number or (n,).
        roll: Turn of the flange about its z axis, rad; a number or (n,).

    Returns:
        T_base_flange, shape (n, 4, 4), mm.
    """
    outward, target, distance, turn = np.broadcast_arrays(
        *(np.atleast_2d(a) for a in (outward_base, target_base)),
        *(np.atleast_1d(a)[:, None] for a in (distance_mm, roll)),
    )
    z = -outward
    reference = np.eye(3)[np.argmin(np.abs(z), axis=1)]
    x = reference - np.sum(reference * z, axis=1, keepdims=True) * z
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    y = np.cross(z, x)
    T = np.zeros((len(z), 4, 4))
    T[:, :3, 0] = np.cos(turn) * x + np.sin(turn) * y
    T[:, :3, 1] = np.cos(turn) * y - np.sin(turn) * x
    T[:, :3, 2] = z
    T[:, :3, 3] = target + distance * outward
    T[:, 3, 3] = 1.0
    return T
