"""The tissue on a needle's way, as the arm feels it: it presses along the shaft, and to the side of the bevel.

Along the shaft: capsules, cutting and friction over depth (`planning.needle.insertion_force`). A capsule pushes out
whatever the tip does; friction and cutting work against the motion. At rest friction holds what it is pulled with:
Dahl's solid friction, elastic up to a shift (Dahl 1968, "A solid friction model"), in place of a sign of the speed.

Across it: the beam in its foundation says what its holder bears, a force and a moment (`planning.needle.beam`). The
simulated needle is rigid, so both act on it as two forces, at the tip and where the shaft is held.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.search.bending.insertion import Insertion
from puncture_twin.twin.plant.felt import Felt
from puncture_twin.twin.world.control.run import Push
from puncture_twin.twin.world.control.tip import Tip
from puncture_twin.twin.world.units import to_m, to_mm

SHIFT_MM = 0.1
"""By which friction gives way elastically before it slides: the samples of the force are as far apart."""


class StraightPath(NamedTuple):
    """Along which a needle is pushed in: its entry (3,), mm, and its unit direction inward (3,), base frame."""

    entry_base: Floats
    into_base: Floats


class TrueTissue:
    """Presses on a needle while it goes in; it keeps how deep the tip has been, and where friction holds it.

    Args:
        insertion: What the needle passes, from the skin on.
        path: Where.
        side: Whereto the bevel points about the needle's z, rad.
        shaft_mm: From the holder to the tip.
    """

    def __init__(self, insertion: Insertion, path: StraightPath, side: float, shaft_mm: float) -> None:
        self._force, self._bent = insertion.force, insertion.path
        self._path, self._side, self._shaft_mm = path, np.array([np.cos(side), np.sin(side), 0.0]), shaft_mm
        self._deepest, self._held, self._felt = 0.0, 0.0, Felt(0.0, 0.0)

    @property
    def felt(self) -> Felt:
        """The greatest so far."""
        return self._felt

    def __call__(self, tip: Tip) -> tuple[Push, ...]:
        """What presses on the needle now."""
        R, at_m = tip.R_base_tip[0], tip.position_m[0]
        depth = float((to_mm(at_m) - self._path.entry_base) @ self._path.into_base)
        along = self._along(depth)
        at_tip, at_holder = self._across(depth)
        self._felt = Felt(max(self._felt.along_n, along), max(self._felt.across_n, abs(at_tip + at_holder)))
        holder_m = at_m - to_m(self._shaft_mm) * R[:, 2]
        side = R @ self._side
        return Push(at_tip * side - along * self._path.into_base, at_m), Push(at_holder * side, holder_m)

    def _along(self, depth: float) -> float:
        """N, against the way in."""
        if depth <= 0.0:
            self._held = 0.0
            return 0.0
        self._deepest = max(self._deepest, depth)
        stretch = float(np.clip(depth - self._held, -SHIFT_MM, SHIFT_MM))
        self._held = depth - stretch
        capsule, cutting, friction = (
            float(np.interp(self._deepest, self._force.depth_mm, term))
            for term in (self._force.capsule_n, self._force.cutting_n, self._force.friction_n)
        )
        return capsule + friction * stretch / SHIFT_MM + cutting * max(stretch, 0.0) / SHIFT_MM

    def _across(self, depth: float) -> tuple[float, float]:
        """N, to the bevel's side, at the tip and at the holder: together the force and the moment of the beam."""
        force, moment = (
            float(np.interp(max(depth, 0.0), self._bent.depth_mm, term))
            for term in (self._bent.holder_n, self._bent.holder_n_mm)
        )
        at_tip = moment / self._shaft_mm
        return at_tip, force - at_tip
