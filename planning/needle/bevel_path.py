"""The path that a bevel cuts, and the needle in it.

A bevel cuts at an angle alpha to the shaft behind it. A lateral force at the tip of a bent beam alone gives a path that
depends on the step; the path is kinematic (Webster et al., Int. J. Robotics Research 25, 2006):

    dy/ds = w'(tip) + alpha,   w(tip) = y(s)

with w the shaft in the foundation of the path that was cut (mechanics: Misra et al., Int. J. Robotics Research 29,
2010). Explicit in s, by the two-step formula of Adams and Bashforth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.needle.beam import Beam, Shape
from puncture_twin.planning.needle.shaft import Shaft

STEP_MM = 1.0
"""Of an insertion, at most. Where `step_for` asks for less it is shorter."""

OF_BENDING, OF_LENGTH = 1 / 16, 1 / 64
"""Of a step over the length 1/rate within which a shaft bends in the stiffest tissue, and over the shaft's own. Halving
it then changes a path by less than 1.5 % from the sixteenth step on, and by less than 3 % before: `tests/needle`
samples what a case may declare. With steps of 1 mm alone it was 11 % in thin needles."""


def step_for(shaft: Shaft, stiffest: float) -> float:
    """The step in which an insertion is followed, mm.

    Args:
        shaft: The needle's.
        stiffest: The largest k that it meets, N/mm^2; rate = (k / 4 EI)^(1/4).
    """
    rate = (stiffest / (4 * shaft.bending_stiffness)) ** 0.25
    return float(min(STEP_MM, OF_LENGTH * shaft.length_mm, OF_BENDING / max(rate, OF_BENDING / STEP_MM)))


@dataclass(frozen=True, eq=False)
class BevelPath:
    """A path of m steps, in the plane of the bevel.

    Attributes:
        depth_mm: Shape (m + 1,), how far the tip is in.
        cut_mm: Shape (m + 1,), how far the path is off the straight line there.
        needle_mm: Shape (m + 1,), how far the shaft is off at those depths, once it is all in.
        tip_force_n: Shape (m + 1,), the lateral force between tip and tissue as each depth was reached.
        largest_mm: Shape (m + 1,), the greatest deflection anywhere along the shaft, up to each depth.
        holder_n: Shape (m + 1,), the lateral force of the tissue that the holder bears at each depth.
        holder_n_mm: Shape (m + 1,), its moment about where the shaft is held.
    """

    depth_mm: Floats
    cut_mm: Floats
    needle_mm: Floats
    tip_force_n: Floats
    largest_mm: Floats
    holder_n: Floats
    holder_n_mm: Floats


def bevel_path(shaft: Shaft, stiffness: Floats, alpha: Floats, step_mm: float) -> BevelPath:
    """Insert a needle step by step.

    Args:
        shaft: Its length is rounded to whole steps.
        stiffness: k of the tissue in each step of depth, shape (m,), N/mm^2.
        alpha: The bevel's angle in each, shape (m,), rad; its sign is the side to which the bevel points.
        step_mm: Length of a step: see `step_for`.
    """
    count = len(stiffness)
    elements = max(round(shaft.length_mm / step_mm), count)
    beam = Beam(shaft.bending_stiffness, step_mm, elements)
    cut, force, largest, holder, moment = np.zeros((5, count + 1))
    before, slope, shape = 0.0, 0.0, None
    for done in range(count):
        ahead = 1.5 * slope - 0.5 * before
        cut[done + 1] = cut[done] + step_mm * (ahead + alpha[done])
        shape = _inserted(beam, stiffness[: done + 1], cut[: done + 2])
        before, slope, force[done + 1] = slope, float(shape.slope[-1]), shape.tip_force
        holder[done + 1], moment[done + 1] = shape.clamp_force, shape.clamp_moment
        largest[done + 1] = max(largest[done], float(np.abs(shape.deflection).max()), abs(cut[done + 1]))
    needle: Floats = cut if shape is None else np.asarray(shape.deflection[elements - count :])
    depth = step_mm * np.arange(count + 1, dtype=np.float64)
    return BevelPath(depth, cut, needle, force, largest, holder, moment)


def _inserted(beam: Beam, stiffness: Floats, cut: Floats) -> Shape:
    """The shaft with its last part in the tissue, and its tip on the end of the path."""
    foundation, rest = np.zeros(beam.elements), np.zeros(beam.elements + 1)
    foundation[beam.elements - len(stiffness) :] = stiffness
    rest[beam.elements - len(stiffness) :] = cut
    return beam.bent(foundation, rest, tip_mm=float(cut[-1]))
