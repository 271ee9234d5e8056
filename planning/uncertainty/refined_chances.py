"""The chances of needles, refined from first order by line sampling, and whether they keep the case's limits."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.chances import Chances
from puncture_twin.planning.uncertainty.lines.refined_touch import Surroundings, refined
from puncture_twin.planning.uncertainty.touch import touching_any


def refined_chances(
    model: ChanceModel, outward_ct: Floats, q: Floats, first: Chances, wanted: Bools | None = None
) -> Chances:
    """Chances to touch, to break a margin and to touch any, by line sampling; the others as they are.

    Args:
        model: Of the case.
        outward_ct: Shape (n, 3), as in `ChanceModel.chances`.
        q: Shape (n, 6).
        first: Of these needles, to first order.
        wanted: Shape (n, k), which chances to touch are refined, those of margins not; None refines all of both.
    """
    every = np.ones(first.touch.shape, bool)
    blocks = model.engine.blocks
    around = Surroundings(tuple(blocks[column] for column in model.columns), model.lengths, model.case.target_ct)
    needles = model.needles(outward_ct, q)
    touch = refined(around, needles, model.touching, first.touch, every if wanted is None else wanted)
    margin = first.margin if wanted is not None else refined(around, needles, model.breaking, first.margin, every)
    whole = np.full(len(q), wanted is None)
    return replace(first, touch=touch, margin=margin, touch_any=touching_any(touch), refined=whole)


def keeps_limits(model: ChanceModel, outward_ct: Floats, q: Floats) -> Bools:
    """Whether needles keep the case's limits, shape (n,), in any configurations that reach the target.

    Args:
        model: Of the case.
        outward_ct: Shape (n, 3), unit.
        q: Shape (n, 6), rad, the tip on the target.
    """
    kept, least, limits = np.ones(len(q), bool), model.case.search.min_hit, model.limits
    if least is not None:
        kept &= model.hit_chance(model.error.covariance_ct(q)) >= least
    if not np.isfinite(limits).any():
        return kept
    first = model.chances(outward_ct, q)
    touch = refined_chances(model, outward_ct, q, first, np.broadcast_to(np.isfinite(limits), first.touch.shape)).touch
    return np.asarray(kept & (np.where(np.isnan(touch), np.inf, touch) <= limits).all(axis=1))
