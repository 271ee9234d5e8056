"""The weight of every structure of a case that breathes: how much of the target's motion it follows; what to warn."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.beyond_image import BEYOND_IMAGE
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.breathing.lujan import fraction_within
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.surroundings import OF_CASE_FILE

SAFE_WHEN = (
    "breathing: a safe direction is safe {when}: checked at {count} positions, and clearances between them; a needle "
    "in place moves with the organ and bends"
)
PLANS = "breathing: plans and rehearsals go to the target where the CT shows it (s = {s:g}), the patient at rest there"
OPEN = "breathing: the gate is open {part:.0%} of the time, if the breath follows the curve"
OUTSIDE_GATE = "breathing: the CT shows the body at s = {s:g}, outside of the gate (s <= {gate:g})"


class MovingWeights(NamedTuple):
    """Weights of the skin, and of the k checked structures, shape (k,)."""

    skin: float
    structures: Floats


def moving_weights(case: Case, breathing: Breathing, anatomy: Anatomy) -> MovingWeights:
    """The weights that a case states for its structures.

    The target's own structure moves with the target, and obstacles and the gantry, which the case file describes, not
    at all.

    Raises:
        InputError: A structure without a weight, a pattern that matches none, or another weight for the target's own.
    """
    skin = case.skin_section.name
    stated = breathing.weights.of_pattern
    fixed = {one.name: _by_itself(case, one) for one in anatomy.checked}
    needed = [skin, *(name for name, weight in fixed.items() if weight is None)]
    others = [name for name in fixed if name not in needed]
    breathing.weights.check(needed, "breathing.weights", case.path, others=others)
    own = stated.get(case.target_structure, 1.0)
    if own != 1.0:
        message = f"breathing.weights: '{case.target_structure}' holds the target, and {own:g} is not its weight"
        raise InputError(message, where=case.path, allowed="1, or no weight for it: the amplitude is the target's")
    of = breathing.weights.of
    weights = [of(name) if weight is None else stated.get(name, weight) for name, weight in fixed.items()]
    return MovingWeights(float(of(skin) or 0.0), np.array(weights, dtype=np.float64))


def _by_itself(case: Case, structure: Structure) -> float | None:
    """The weight of what needs no statement; None of all else."""
    if structure.name in {case.target_structure, BEYOND_IMAGE}:  # which the breath has widened already
        return 1.0
    return 0.0 if structure.source == OF_CASE_FILE else None


def breath_warnings(case: Case, anatomy: Anatomy) -> tuple[str, ...]:
    """The warnings of a case; none where it declares no breathing.

    Raises:
        InputError: See `moving_weights`.
    """
    breathing = case.breathing
    if breathing is None:
        return ()
    moving_weights(case, breathing, anatomy)
    count = int(breathing.in_window.sum())
    said = [SAFE_WHEN.format(when=breathing.window_text, count=count)]
    if breathing.gate is not None:
        said.append(OPEN.format(part=fraction_within(breathing.gate, breathing.exponent)))
    said.append(PLANS.format(s=breathing.scanned_at))
    if breathing.gate is not None and breathing.scanned_at > breathing.gate:
        said.append(OUTSIDE_GATE.format(s=breathing.scanned_at, gate=breathing.gate))
    return tuple(said)
