"""The chance to touch anything, all structures linearised together, of the best candidates."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.refined import BEST
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.touch import Proximity

NORMALS = 4096
"""Fixed draws of the jointly linearised chance: its own error is .008 at most."""

DRAWN_WITH = 20191104
"""Seed of those draws, the same in every run: the table must not depend on chance."""


def joint_touch_chance(
    near: Proximity,
    cov_ct: Floats,
    threshold_mm: Floats | float,
    freedom: int | None = None,
    surface_mm: Floats | float = 0.0,
) -> Floats:
    """P that a needle comes nearer to any structure than its threshold, all linearised together, shape (n,).

    Args:
        near: Of needles and structures.
        cov_ct: Shape (n, 6, 6), Sigma6, as there.
        threshold_mm: One number or shape (k,).
        freedom: As in `touch_chance`.
        surface_mm: As in `proximity`: every structure's surface lies off by a normal number of its own.
    """
    rng = np.random.default_rng(DRAWN_WITH)
    draws = rng.normal(size=(NORMALS, 6))
    sizes = np.ones(NORMALS) if freedom is None else np.sqrt(freedom / rng.chisquare(freedom, NORMALS))
    surfaces = np.nan_to_num(np.broadcast_to(surface_mm, near.distance.shape))
    off = rng.normal(size=(NORMALS, near.distance.shape[1])) if surfaces.any() else np.zeros((1, 1))
    chances = np.empty(len(cov_ct))
    for row, cov in enumerate(cov_ct):
        values, axes = np.linalg.eigh(cov)
        root = axes * np.sqrt(np.maximum(values, 0.0))
        change = sizes[:, None] * (draws @ (near.gradient[row] @ root).T + off * surfaces[row])
        chances[row] = np.mean(np.any(change < threshold_mm - near.distance[row], axis=1))
    return chances


def with_joint_chances(found: Candidates, model: ChanceModel | None) -> Candidates:
    """Add, for the best candidates, the chance to touch anything, all structures linearised together.

    The candidates are ranked; ``model`` as in `with_chances`.
    """
    rows = found.ranked[:BEST]
    if model is None or found.chances is None or not len(rows):
        return found
    needles = model.needles(found.outward_ct[rows], found.arm.q_insertion[rows])
    joint = found.chances.touch_joint.copy()
    joint[rows] = joint_touch_chance(
        needles.near, needles.cov_ct, model.case.needle.radius_mm, needles.freedom, needles.surface_mm
    )
    return replace(found, chances=replace(found.chances, touch_joint=joint))
