"""Chances refined by line sampling: of some rows, and of the best until no new one is among them."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Ints
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.chances.limited import limited
from puncture_twin.planning.search.ranking import ranked
from puncture_twin.planning.uncertainty.chance_model import ChanceModel
from puncture_twin.planning.uncertainty.chances import Chances
from puncture_twin.planning.uncertainty.refined_chances import refined_chances

BEST = 200
"""Of the ranked candidates: how many get the dearer chances."""


def with_refined(found: Candidates, model: ChanceModel, rows: Ints, wanted: Bools | None = None) -> Candidates:
    """Refine some rows; ``wanted`` as in `refined_chances`."""
    chances = found.chances
    assert chances is not None
    better = refined_chances(
        model, found.outward_ct[rows], found.arm.q_insertion[rows], _of_rows(chances, rows), wanted
    )
    return replace(found, chances=chances.put(rows, better))


def _of_rows(chances: Chances, rows: Ints) -> Chances:
    """Of some candidates."""
    names = [field.name for field in fields(chances) if field.name != "structures"]
    return Chances(chances.structures, **{name: getattr(chances, name)[rows] for name in names})


def with_best_refined(found: Candidates, model: ChanceModel | None) -> Candidates:
    """Refine the best candidates, reject those that break a limit then, and rank again until no new one is among them.

    Args:
        found: Ranked, with chances.
        model: As in `with_chances`.
    """
    if model is None or found.chances is None:
        return found
    done, case = np.zeros(len(found), bool), model.case
    while len(rows := (best := found.ranked[:BEST])[~done[best]]):
        found = ranked(case, limited(case, with_refined(found, model, rows)))
        done[rows] = True
    return found
