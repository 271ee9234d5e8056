"""The chances of a search's candidates to hit the target, and to touch each structure or its margin; their limits."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.structure import Structure
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.near_names import did_you_mean
from puncture_twin.planning.case.case import Case


@dataclass(frozen=True, eq=False)
class Chances:
    """Of n candidates and k structures that demand a margin; NaN where nothing was computed.

    Attributes:
        structures: The k names.
        hit: Shape (n,), that the tip is in the target's mesh, or within its radius.
        touch: Shape (n, k), that the needle touches each structure.
        margin: Shape (n, k), that it breaks each structure's margin.
        touch_any: Shape (n,), min(1, sum of touch): never below the truth of what `touch` says.
        touch_joint: Shape (n,), that it touches any, all linearised together; of the best candidates alone.
        lateral_mm: Shape (n,), expected (rms) error of the tip across the needle, target reading included.
        depth_mm: Shape (n,), along it.
        refined: Shape (n,), whether touch and margin are line-sampled, as `check` has them; else they are of first
            order.
    """

    structures: tuple[str, ...]
    hit: Floats
    touch: Floats
    margin: Floats
    touch_any: Floats
    touch_joint: Floats
    lateral_mm: Floats
    depth_mm: Floats
    refined: Bools

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @classmethod
    def unknown(cls, structures: tuple[str, ...], count: int) -> Chances:
        """Of candidates for which nothing was computed."""
        shapes = {"touch": (count, len(structures)), "margin": (count, len(structures))}
        names = {field.name for field in fields(cls)} - {"structures", "refined"}
        blank = {name: np.full(shapes.get(name, (count,)), np.nan) for name in names}
        return cls(structures, refined=np.zeros(count, bool), **blank)

    def put(self, rows: Ints, known: Chances) -> Chances:
        """With those of some candidates replaced."""
        values = {field.name: getattr(self, field.name).copy() for field in fields(self) if field.name != "structures"}
        for name, value in values.items():
            value[rows] = getattr(known, name)
        return Chances(self.structures, **values)


def demanding(structures: tuple[Structure, ...]) -> Ints:
    """Columns of the structures that must not be touched."""
    return np.flatnonzero([s.demands_margin for s in structures])


def check_limits(case: Case, anatomy: Anatomy, error_known: bool) -> None:
    """Refuse limits that no candidate can be tested against: every one would pass untested.

    Args:
        case: States the limits.
        anatomy: Its structures.
        error_known: Whether markers and arm give the error of the needle's pose.

    Raises:
        InputError: Limits without a pose error, or of a structure that has no chance to be touched.
    """
    settings = case.search
    limited = settings.min_hit is not None or settings.max_touch is not None or bool(settings.max_touch_of)
    if limited and not error_known:
        message = "search.min_hit and max_touch cannot be checked: only markers and the arm give the needle's error"
        allowed = "[registration] with markers, and a search with the arm; or no such limit"
        raise InputError(message, where=case.path, allowed=allowed)
    names = [anatomy.checked[column].name for column in demanding(anatomy.checked)]
    unknown = sorted(set(settings.max_touch_of) - set(names))
    if unknown:
        message = f"search.max_touch_of '{unknown[0]}' is no structure that must not be touched"
        message += did_you_mean(unknown[0], names)
        raise InputError(message, where=case.path, allowed=", ".join(names))


def touch_limit(case: Case, name: str) -> float:
    """The greatest chance to touch a structure that a case allows."""
    allowed = case.search.max_touch_of.get(name, case.search.max_touch)
    return np.inf if allowed is None else allowed
