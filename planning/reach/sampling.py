"""A straight insertion as states so close to one another that what holds at them holds between them."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.insertion import NeedleLine
from puncture_twin.planning.arm.kinematics import link_frames
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.collision.sweep import SweptBodies, motion_bounds
from puncture_twin.planning.reach.branch_paths import fill_branch_path


class Sampled(NamedTuple):
    """A motion's states and where they are."""

    q: Floats
    """Shape (m, 6), rad; NaN from where the branch first does not exist."""
    depths_mm: Floats
    """Shape (m,), from the standoff, evenly spaced."""


def sampled(
    swept: SweptBodies,
    line: NeedleLine,
    branch: int,
    turn: Floats,
    lengths_mm: tuple[float, float],
    samples: int,
    most_mm: float,
) -> Sampled:
    """The motion of one branch along a needle, sampled so that no body moves more than so far from state to state.

    Args:
        swept: The arm's bodies.
        line: The needle's line.
        branch: Index among the eight of ``inverse``.
        turn: Shape (6,), rad: added to every state.
        lengths_mm: Flange to tip, and tip to target at the standoff.
        samples: To begin with, 2 or more.
        most_mm: What no body's motion exceeds; see :meth:`SweptBodies.bounds_mm`.
    """
    bodies = swept.corners, swept.longest_lever_mm
    return Sampled(*_sampled(swept.model.lengths, *line, branch, turn, lengths_mm, samples, bodies, most_mm))


@nb.njit(cache=True)
def _sampled(  # type: ignore[no-untyped-def]  # numba infers
    lengths, R, target, outward, branch, turn, lengths_mm, samples, bodies, most_mm
):
    """As :func:`sampled`: with as many more samples as the largest motion asks for, until it asks for none."""
    needle, standoff = lengths_mm
    while True:
        step = standoff / (samples - 1)
        depths, distances = np.empty(samples), np.empty(samples)
        for k in range(samples):
            depths[k] = k * step if k < samples - 1 else standoff
            distances[k] = needle + standoff - depths[k]
        q, frames, bounds = np.empty((samples, 6)), np.empty((samples, 7, 4, 4)), np.empty((samples - 1, 6))
        fill_branch_path(lengths, R, target, outward, distances, branch, turn, q)
        link_frames(lengths, q, frames)
        motion_bounds(frames, q, bodies[0], bodies[1], bounds)
        worst = bounds.max()
        if not worst > most_mm:  # NaN: the branch ends on the way
            return q, depths
        samples = math.ceil((samples - 1) * worst / most_mm) + 1
