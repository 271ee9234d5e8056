"""A part of a cohort: ``i/n``, as stated or as SLURM's array says it."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import NamedTuple, TypeVar

from puncture_twin.planning.base.errors import InputError

Item = TypeVar("Item")

ALLOWED = "i/n with 1 <= i <= n, such as 3/8"
TASK, COUNT, FIRST, STEP = (f"SLURM_ARRAY_TASK_{name}" for name in ("ID", "COUNT", "MIN", "STEP"))
"""What SLURM tells each task of an array: https://slurm.schedmd.com/job_array.html."""


class Part(NamedTuple):
    """Part ``number`` of ``parts``, from 1 on."""

    number: int
    parts: int

    @property
    def text(self) -> str:
        """As it is typed."""
        return f"{self.number}/{self.parts}"

    def of(self, items: Sequence[Item]) -> Sequence[Item]:
        """This part's items: neighbours stay together, and every item is in one part."""
        size = len(items)
        return items[(self.number - 1) * size // self.parts : self.number * size // self.parts]


WHOLE = Part(1, 1)


def parse_part(text: str) -> Part:
    """A part as it is typed.

    Raises:
        InputError: Something else.
    """
    found = re.fullmatch(r"([0-9]{1,7})/([0-9]{1,7})", text)
    if found is None or not 1 <= int(found[1]) <= int(found[2]):
        raise InputError(f"'{text[:40]}' is no part", where="--part", allowed=ALLOWED)
    return Part(int(found[1]), int(found[2]))


def slurm_part(environment: Mapping[str, str]) -> Part | None:
    """The part of this task of a SLURM array; None outside of one.

    Raises:
        InputError: An array from whose numbers the part cannot be told.
    """
    if TASK not in environment:
        return None
    stated = {name: environment.get(name, "1" if name == STEP else "") for name in (TASK, COUNT, FIRST, STEP)}
    if not all(re.fullmatch(r"[0-9]{1,9}", value) for value in stated.values()):
        raise InputError(f"{stated} are no numbers", where="SLURM's array", allowed=f"--part {ALLOWED}")
    task, count, first, step = (int(stated[name]) for name in (TASK, COUNT, FIRST, STEP))
    place, odd = divmod(task - first, max(step, 1))
    if odd or not 0 <= place < count:
        what = f"task {task} of an array of {count} from {first} in steps of {step}"
        raise InputError(what, where="SLURM's array", allowed=f"an array without gaps, or --part {ALLOWED}")
    return Part(place + 1, count)
