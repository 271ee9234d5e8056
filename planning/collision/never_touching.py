"""Pieces two joints apart that never touch, at no angle: proven once for an arm, and not tested again."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.collision.check import Check
from puncture_twin.planning.collision.packed.hulls import made_from
from puncture_twin.planning.collision.proofs import Proofs

Touches = Callable[[int, Floats], bool]

JOINTS_BETWEEN = 2
"""Such pairs see two angles alone, whose square can be searched in full; a cube of three would take too long."""

HALVINGS = 9
"""Of the square of a whole turn each way: down to 0.7 deg, where a UR3's pieces move by about 2 mm."""

QUARTERS = np.array([[-0.5, -0.5], [-0.5, 0.5], [0.5, -0.5], [0.5, 0.5]])
"""Where the middles of a square's quarters lie, in half sides of the square."""


def without_neighbours(model: UrModel, checks: Sequence[Check], proofs: Proofs, cache: Cache) -> tuple[Check, ...]:
    """The checks that may find a contact at some angle; the proofs are made to ask the same ones.

    Args:
        model: The arm.
        checks: Of a cell.
        proofs: The same checks, packed.
        cache: Where the answer is kept: it depends on arm and tool alone.
    """
    between = proofs.joint_spans[:, 0] > 0
    pairs = [check.hulls or () for check, pair in zip(checks, between, strict=True) if pair]
    pieces = [hull for pair in pairs for hull in pair if hull is not None]

    def touches(check: int, frames: Floats) -> bool:
        return checks[check].contact_at(frames) is not None

    stored = cache.arrays(
        made_from("never touching", [model.lengths, proofs.joint_spans[between], *pieces]),
        lambda: {"never": never_touching(model, proofs, touches)[between]},
        by=__name__,
    )
    never = between.copy()
    never[between] = stored["never"]
    proofs.drop(never)
    return tuple(check for check, gone in zip(checks, never.tolist(), strict=True) if not gone)


def never_touching(model: UrModel, proofs: Proofs, touches: Touches) -> Bools:
    """Which checks of a cell (k,) are proven clear at every angle: squares of angles, quartered until each is proven.

    Args:
        model: The arm.
        proofs: Its checks, packed.
        touches: Called where enclosures overlap: whether a check's bodies do, at frames (7, 4, 4).
    """
    never = np.zeros(len(proofs), np.bool_)
    spans = proofs.joint_spans
    apart = np.where(spans[:, 0] > 0, spans[:, 2] - spans[:, 1], 0)
    for first in range(6):
        tested = (apart == JOINTS_BETWEEN) & (spans[:, 1] == first)
        if tested.any():
            never |= _clear_all_over(model, proofs, touches, first, tested)
    return never


def _clear_all_over(model: UrModel, proofs: Proofs, touches: Touches, joint: int, tested: Bools) -> Bools:
    """Which of the tested checks (k,) are clear at all angles of two neighbouring joints."""
    middles, half = np.zeros((1, 2)), np.pi
    unproven, touching = tested[None], np.zeros_like(tested)
    for _ in range(HALVINGS):
        q, turns = np.zeros((len(middles), 6)), np.zeros(6)
        q[:, joint : joint + 2], turns[joint : joint + 2] = middles, half
        frames = link_poses(model, q)
        left = proofs.clear_about(frames, turns, unproven)
        for square, check in np.argwhere(left.touching).tolist():
            touching[check] = touching[check] or touches(check, frames[square])
        still = left.unproven & ~touching
        kept = still.any(axis=1)
        if not kept.any():
            break
        middles = (middles[kept, None] + half * QUARTERS).reshape(-1, 2)
        unproven, half = np.repeat(still[kept], len(QUARTERS), axis=0), half / 2.0
    else:
        touching |= unproven.any(axis=0)
    return tested & ~touching
