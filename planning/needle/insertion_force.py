"""The axial force of an insertion by capsules, cutting and friction, and the arm's work by each.

After Okamura, Simone and O'Leary (IEEE Trans. Biomed. Eng. 51, 2004): before a surface ruptures it is a nonlinear
spring; behind it a constant cutting force and friction along the shaft. The spring's form is ours, F = P (x / d)^2 up
to the rupture at P and d, and so is every number of a case: those of the paper are of bovine liver, and none is copied
here. At the steady speed of an insertion the paper's friction (Karnopp's) is Coulomb's. A surface that ruptured goes
back to its place: the tip is then in by d, without further work.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.needle.deflection import Layer, Tissue

SAMPLE_MM = 0.1
"""Between two samples of the force."""


ROUNDING_MM = 1e-9
"""A sample this near behind a rupture is the rupture."""


class Push(NamedTuple):
    """A capsule that is pushed in from one depth, and ruptures at another at a force."""

    start_mm: float
    end_mm: float
    force_n: float
    reach_mm: float  # of the capsule, also where the target ends the push before its rupture


@dataclass(frozen=True, eq=False)
class InsertionForce:
    """The force over depth; N and mm."""

    depth_mm: Floats  # shape (n,), of the tip from the skin
    capsule_n: Floats  # shape (n,)
    cutting_n: Floats  # shape (n,)
    friction_n: Floats  # shape (n,)

    @property
    def total_n(self) -> Floats:
        """Total force at each depth, shape (n,), N."""
        return np.asarray(self.capsule_n + self.cutting_n + self.friction_n)

    @property
    def peak_n(self) -> float:
        """The greatest force, N."""
        return float(self.total_n.max(initial=0.0))


def insertion_force(layers: Sequence[Layer], step_mm: float = SAMPLE_MM) -> InsertionForce:
    """The force of a needle that goes at a steady speed through layers, from the skin on without gaps."""
    end = layers[-1].end_mm if layers else 0.0
    depth = np.linspace(0.0, end, round(end / step_mm) + 1) if end > 0 else np.zeros(1)
    pushes = _pushes(layers, end)
    depth = np.union1d(depth, [push.end_mm for push in pushes])  # the peaks themselves
    capsule, cutting, inside = np.zeros(len(depth)), np.zeros(len(depth)), depth.copy()
    for layer in layers:
        cutting[(depth >= layer.start_mm) & (depth <= layer.end_mm)] = layer.tissue.cutting_n
    for push in pushes:
        pushing = (depth >= push.start_mm) & (depth <= push.end_mm + ROUNDING_MM)
        capsule[pushing] = push.force_n * ((depth[pushing] - push.start_mm) / push.reach_mm) ** 2
        cutting[pushing], inside[pushing] = 0.0, push.start_mm  # while it is pushed in nothing is cut
    friction = np.zeros(len(depth))
    for layer in layers:  # over the shaft's length inside each
        friction += layer.tissue.friction_n_mm * (np.clip(inside, layer.start_mm, layer.end_mm) - layer.start_mm)
    return InsertionForce(depth, capsule, cutting, friction)


class Pushed(NamedTuple):
    """Displacement of the tissue about the target along the needle."""

    depth_mm: Floats  # shape (n,), of the tip from the skin
    shift_mm: Floats  # shape (n,)
    target_mm: float  # depth of the target as planned

    def at(self, depth_mm: Floats) -> Floats:
        """The shift at depths, mm."""
        return np.interp(depth_mm, self.depth_mm, self.shift_mm)


def pushed(layers: Sequence[Layer], target_mm: float) -> Pushed | None:
    """The shift of the tissue at a depth, where it says by what the body holds it: F / K.

    F, N, is what the needle does to that tissue alone: capsule, cutting and friction.
    """
    own = next(layer.tissue for layer in layers if target_mm <= layer.end_mm + ROUNDING_MM)
    if own.held_n_mm is None:
        return None
    # what it does to that tissue alone, whether or not its surface is passed there: other layers move others
    same = [replace(one.tissue, capsule_n=own.capsule_n, capsule_mm=own.capsule_mm) == own for one in layers]
    alone = [one if its else one._replace(tissue=Tissue(0.0)) for one, its in zip(layers, same, strict=True)]
    force = insertion_force(alone)
    return Pushed(force.depth_mm, force.total_n / own.held_n_mm, target_mm)


def _pushes(layers: Sequence[Layer], end: float) -> list[Push]:
    """Capsules in order; what lies within the reach of one that ruptures goes with it. The target ends the last."""
    pushes: list[Push] = []
    for layer in layers:
        tissue, inside = layer.tissue, pushes[-1].end_mm if pushes else 0.0
        if tissue.capsule_n > 0 and tissue.capsule_mm > 0 and layer.start_mm >= inside:
            reach = tissue.capsule_mm
            pushes.append(Push(layer.start_mm, min(layer.start_mm + reach, end), tissue.capsule_n, reach))
    return pushes
