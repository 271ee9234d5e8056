"""Whether touches can be of one place at all: before a tip is fitted to touches of several."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import combinations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError

MOST_OFF_MM = 50.0
"""By which a stated tip may be wrong: more is another needle."""

SLACK_MM = 5.0
"""By which an arm that nobody calibrated may miss one place."""


def check_one_place(names: Sequence[str], tips_base: Floats, axes_base: Floats, *, where: str) -> None:
    """Refuse touches that no tip near the stated one brings to one place.

    A tip that is wrong by d parts two touches of one place by 2 sin(angle / 2) d at most, with the angle between the
    two needles, and by twice d where the flange turns about them.

    Args:
        names: Of the n touches.
        tips_base: Shape (n, 3), mm: where the stated tip was.
        axes_base: Shape (n, 3, 3): the flange's axes as columns.
        where: What the error names.

    Raises:
        InputError: Two of them are farther apart.
    """
    worst, two = 0.0, (0, 0)
    for i, j in combinations(range(len(names)), 2):
        cosine = (np.trace(axes_base[i].T @ axes_base[j]) - 1) / 2
        turned = float(np.sqrt(max(2 - 2 * min(cosine, 1.0), 0.0)))  # 2 sin(angle / 2)
        beyond = float(np.linalg.norm(tips_base[i] - tips_base[j])) - turned * MOST_OFF_MM - SLACK_MM
        if beyond > worst:
            worst, two = beyond, (i, j)
    if worst > 0:
        i, j = two
        apart = float(np.linalg.norm(tips_base[i] - tips_base[j]))
        what = (
            f"touches of different places: {names[i]} and {names[j]} are {apart:.0f} mm apart, more than a tip "
            f"{MOST_OFF_MM:g} mm off explains"
        )
        raise InputError(what, where=where, allowed="touches of one place, the needle tilted to several sides")
