"""Which version of TotalSegmentator numbered a label map, inferred from whether its organs lie where organs lie.

Versions 1 and 2 give the same numbers to other organs. Under the wrong one, left organs lie on the right, or vertebrae
lie in no order.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
import scipy

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.labels.labelmaps import LabelMap
from puncture_twin.planning.formats.labels.naming import BUILT_IN
from puncture_twin.planning.geometry.rigid import apply

LEAST_RULES = 3
"""With fewer that can be checked, chance decides."""
MOST_BROKEN, LEAST_BROKEN = 0.1, 0.15
"""Fractions of the rules: so few may be broken in the right naming (curved spines, moved organs), so many are in the
wrong."""

LEAST_WRONG = 2
"""One rule alone may be broken by a patient."""

_SPINE = [f"vertebrae_{part}{n}" for part, last in (("C", 7), ("T", 12), ("L", 5)) for n in range(1, last + 1)]
_RIBS = [[f"rib_{side}_{n}" for n in range(1, 13)] for side in ("left", "right")]
FROM_HEAD = (
    [*_SPINE, "sacrum"], *_RIBS,
    ["brain", "heart", "liver", "urinary_bladder"], ["brain", "trachea", "aorta", "sacrum", "femur_left"],
    ["heart_myocardium", "pancreas", "hip_left"], ["lung_lower_lobe_left", "stomach", "colon", "gluteus_maximus_left"],
    ["esophagus", "duodenum", "urinary_bladder"], ["brain", "kidney_left", "prostate"], ["skull", "spleen", "prostate"],
)  # fmt: skip
"""Chains of structures, each farther from the head than the one before."""
FROM_RIGHT = (["liver", "aorta", "spleen"], ["gallbladder", "stomach"], ["inferior_vena_cava", "aorta"])
"""Chains of structures from the patient's right to the left."""


BESIDE_SPINE = (
    "kidney", "adrenal", "rib", "hip", "femur", "lung", "gluteus", "iliopsoas", "autochthon",
    "scapula", "humerus", "clavicula",
)  # fmt: skip
"""How names of structures begin of which each lies on its own side of the spine."""


class Plausibility(NamedTuple):
    """Agreement of a naming with the places of organs in a label map.

    Attributes:
        rules: How many could be checked.
        broken: How many of them do not hold.
        nameless: Labels present that the naming does not know.
    """

    rules: int
    broken: int
    nameless: int

    @property
    def fits(self) -> bool:
        """Whether organs lie in the order of a body."""
        return self.nameless == 0 and self.rules >= LEAST_RULES and self.broken <= MOST_BROKEN * self.rules

    @property
    def fails(self) -> bool:
        """Whether organs certainly lie in another order."""
        return self.nameless > 0 or self.broken >= max(LEAST_WRONG, LEAST_BROKEN * self.rules)


def likely_numbering(labelmap: LabelMap) -> str | None:
    """The built-in naming in which the organs of a map lie where they do in a body; None where that is not sure."""
    centres = label_centres(labelmap)
    found = {name: plausibility(table, centres) for name, table in BUILT_IN.items()}
    fitting = [name for name, one in found.items() if one.fits]
    others_fail = all(one.fails for name, one in found.items() if name not in fitting)
    return fitting[0] if len(fitting) == 1 and others_fail else None


def label_centres(labelmap: LabelMap) -> dict[int, Floats]:
    """The middle of each label present, shape (3,), LPS mm."""
    middles = {}
    for label, box in labelmap.boxes.items():
        index = np.array(scipy.ndimage.center_of_mass(labelmap.labels[box] == label)) + [axis.start for axis in box]
        middles[label] = apply(labelmap.T_ct_index, index[None])[0]
    return middles


def plausibility(table: Mapping[int, str], centres: Mapping[int, Floats]) -> Plausibility:
    """Check the order of organs from right to left and from head to feet.

    Args:
        table: Label to name.
        centres: Label to its middle, LPS mm.
    """
    at = {table[label]: centre for label, centre in centres.items() if label in table}
    kept = list(_rules(at))
    return Plausibility(len(kept), kept.count(False), sum(label not in table for label in centres))


def _rules(at: Mapping[str, Floats]) -> Iterator[bool]:
    for name in at:
        other = re.sub("left", "right", name)
        if other != name and other in at:
            yield bool(at[name][0] > at[other][0])
    spine = [centre[0] for name, centre in at.items() if name.startswith("vertebrae")]
    if spine:
        middle = float(np.mean(spine))
        lateral = {name: at[name][0] - middle for name in at if name.startswith(BESIDE_SPINE)}
        yield from (bool(x > 0) for name, x in lateral.items() if "left" in name)
        yield from (bool(x < 0) for name, x in lateral.items() if "right" in name)
    for chains, axis, sign in ((FROM_RIGHT, 0, 1.0), (FROM_HEAD, 2, -1.0)):
        for chain in chains:
            known = [at[name] for name in chain if name in at]
            yield from (bool(sign * (b[axis] - a[axis]) > 0) for a, b in itertools.pairwise(known))
