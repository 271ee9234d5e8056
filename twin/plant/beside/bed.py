"""What a patient lies on: a flat table with a mattress, a curved table, or a pad as dense as the body."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Literal

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.plant.beside.outline import Outline
from puncture_twin.twin.plant.beside.tubes import Part, drawn

Bed = Literal["none", "flat", "curved", "pad"]
Ends = tuple[float, float]
BEYOND_MM = 400.0
"""So far a bed goes on beyond the skin at head and feet."""
SHELL_HU, FOAM_HU, COVER_HU, MATTRESS_HU, PAD_HU = 60.0, -930.0, -120.0, -960.0, 20.0
"""Of a table's shell and core, a mattress's cover and foam, and a pad of gel; ours."""
COVER_MM, CURVED_MM = 2.0, 30.0
"""How thick a mattress's cover and a curved table are; ours."""


def bed(outline: Outline, kind: Bed, rng: np.random.Generator) -> Iterator[Part]:
    """The bed beneath a patient.

    Args:
        outline: Of the trunk; its back sinks into mattress and pad by some millimetres.
        kind: ``flat``: a mattress of foam on a table; ``curved``: a shell about foam, bent; ``pad``: gel on a table.
        rng: Draws sizes.
    """
    low, high = outline.skin.bounds[:, 2] + np.array([-BEYOND_MM, BEYOND_MM])
    middle = float(outline.skin.bounds[:, 0].mean()) + rng.uniform(-10.0, 10.0)
    top = outline.back(low, high) - rng.uniform(0.0, 8.0)
    half, shell = rng.uniform(200.0, 270.0), rng.uniform(2.5, 5.0)
    if kind == "curved":
        yield from _curved((middle, top), rng.uniform(260.0, 420.0), 0.8 * half, shell, (low, high))
    elif kind != "none":
        thick = rng.uniform(15.0, 45.0)
        table = top + thick
        cover = _box(middle, half, top, table)
        if kind == "pad":
            yield Part("pad", drawn(cover, low, high), PAD_HU, "beneath")
        else:
            core = _box(middle, half - COVER_MM, top + COVER_MM, table - COVER_MM)
            yield Part("mattress", drawn(cover, low, high), COVER_HU, "beneath")
            yield Part("mattress_foam", drawn(core, low + COVER_MM, high - COVER_MM), MATTRESS_HU, "beneath")
        deep = table + rng.uniform(25.0, 60.0)
        yield Part("table", drawn(_box(middle, half, table, deep), low, high), SHELL_HU, "beneath")
        inner = _box(middle, half - shell, table + shell, deep - shell)
        yield Part("table_foam", drawn(inner, low + shell, high - shell), FOAM_HU, "beneath")


def _box(middle: float, half: float, top: float, bottom: float) -> Floats:
    """Corners of an upright box, shape (4, 2)."""
    return np.array([[middle - half, top], [middle + half, top], [middle + half, bottom], [middle - half, bottom]])


def _curved(at: tuple[float, float], radius: float, half: float, shell: float, ends: Ends) -> Iterator[Part]:
    """A bent table whose upper side has its lowest place at a point; it rises to both edges."""
    for name, inset, hu in (("table", 0.0, SHELL_HU), ("table_foam", shell, FOAM_HU)):
        turn = np.linspace(-1.0, 1.0, 25) * (np.arcsin(half / radius) - inset / radius)
        rim = np.stack([np.sin(turn), np.cos(turn)], axis=1)
        upper, lower = (radius + inset) * rim, (radius + CURVED_MM - inset) * rim[::-1]
        section = np.concatenate([upper, lower]) + np.array([at[0], at[1] - radius])
        yield Part(name, drawn(section, ends[0] + inset, ends[1] - inset), hu, "beneath")
