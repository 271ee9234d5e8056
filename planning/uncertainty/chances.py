"""The chances of a search's candidates: to hit the target, and to touch each structure or its margin."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from puncture_twin.planning.base.arrays import Bools, Floats, Ints


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
