"""The chance to touch anything, of the best candidates."""

from __future__ import annotations

from dataclasses import replace

from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.best_refined import BEST
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.joint_touch import joint_touch_chance


def with_joint_chances(found: Candidates, model: ChanceModel | None) -> Candidates:
    """Add, for the best candidates, the chance to touch anything, all structures linearised together.

    The candidates are ranked; ``model`` as in `with_chances`.
    """
    rows = found.ranked[:BEST]
    if model is None or found.chances is None or not len(rows):
        return found
    needles = model.needles(found.outward_ct[rows], found.arm.q_insertion[rows])
    joint = found.chances.touch_joint.copy()
    joint[rows] = joint_touch_chance(needles.near, needles.cov_ct, model.case.needle.radius_mm, needles.freedom)
    return replace(found, chances=replace(found.chances, touch_joint=joint))
