"""The weight of every structure of a case that breathes: how much of the target's motion it follows."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy, Structure
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.breathing.breathing import Breathing
from puncture_twin.planning.case.case import Case
from puncture_twin.planning.collision.surroundings import OF_CASE_FILE


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
    if structure.name == case.target_structure:
        return 1.0
    return 0.0 if structure.source == OF_CASE_FILE else None
