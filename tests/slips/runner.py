"""Draws of every kind, and what came of them."""

import tempfile
import zlib
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np

from slips import devices, files, placements
from slips.kinds import REFUSED, RIGHT, SILENT, TOLD, WARNED, Kind

KINDS: tuple[Kind, ...] = (*files.KINDS, *devices.KINDS, *placements.KINDS)


class Found(NamedTuple):
    """What came of the draws of one kind."""

    name: str
    slips: Counter[str]
    true: Counter[str]
    said: Counter[str]
    """Codes of the warnings of true ones."""
    wrong: tuple[str, ...]
    """Each draw that passed in silence, or was refused and true."""


def run(kind: Kind, draws: int, seed: int) -> Found:
    """Its share of so many draws, at least one; each with a generator of its own, told by kind, seed and number."""
    slips, true, said, wrong = Counter(), Counter(), Counter(), []
    for number in range(max(1, round(draws * kind.share / sum(one.share for one in KINDS)))):
        for slip, counted in ((True, slips), (False, true)):
            rng = np.random.default_rng([seed, zlib.crc32(kind.name.encode()), number])
            with tempfile.TemporaryDirectory() as folder:
                came = kind.draw(rng, Path(folder), slip)
            counted[came.how] += 1
            said[came.code] += came.how == WARNED and not slip
            if came.how == (SILENT if slip else REFUSED):
                wrong.append(f"{kind.name}, {number}, {'slip' if slip else 'true'}: {came.how} {came.code}")
    return Found(kind.name, slips, true, +said, tuple(wrong))


ANSWERS = (REFUSED, WARNED, TOLD, RIGHT, SILENT)
HEAD = f"| kind | draws | {' | '.join(ANSWERS)} | true: refused | true: warned |\n|---|{8 * '---|'}\n"


def row(one: Found) -> str:
    cells = [one.slips.total(), *(one.slips[how] for how in ANSWERS), one.true[REFUSED], one.true[WARNED]]
    cells[-1] = f"{cells[-1]} ({', '.join(one.said)})" if one.said else 0
    return f"| {one.name} | {' | '.join(map(str, cells))} |\n"
