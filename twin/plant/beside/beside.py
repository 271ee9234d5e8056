"""What lies beside a patient in a scanner, as asked for; lines and cables on and before the skin."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.plant.beside.arms import Arms, arms
from puncture_twin.twin.plant.beside.bed import Bed, bed
from puncture_twin.twin.plant.beside.outline import Outline
from puncture_twin.twin.plant.beside.tubes import Part, tube

SHEATH_HU, WATER_HU, CORE_HU = 100.0, 0.0, 3000.0
"""Of plastic, of what flows in it, and of thin wires of copper with the plastic between; ours."""


class Beside(NamedTuple):
    """What shall lie beside the patient.

    Attributes:
        arms: Where both arms lie; ``none``: over the head, outside of the image.
        bed: What the patient lies on.
        lines: How many lines lie on the skin.
    """

    arms: Arms = "none"
    bed: Bed = "none"
    lines: int = 0


def lay_beside(skin: TriangleMesh, at_mm: float, wanted: Beside, rng: np.random.Generator) -> tuple[Part, ...]:
    """Draw it about a skin: the bed first, then arms, then lines.

    Args:
        skin: In the scanner's frame, LPS mm: y to the back, z to the head.
        at_mm: The height along the bed that the image is about.
        wanted: What to draw.
        rng: Draws it.
    """
    outline = Outline(skin)
    found = [*bed(outline, wanted.bed, rng), *arms(outline, wanted.arms, at_mm, rng)]
    return (*found, *lines(outline, wanted.lines, at_mm, rng))


def lines(outline: Outline, count: int, at_mm: float, rng: np.random.Generator) -> Iterator[Part]:
    """So many lines, tubes and cables in turn, each over front or flank.

    Args:
        outline: Of the trunk.
        count: How many.
        at_mm: The height along the bed near which they lie.
        rng: Draws course, thickness, and how far each stands off the skin.
    """
    for number in range(1, count + 1):
        cable = number % 2 == 0
        radius = rng.uniform(2.0, 3.5)
        start = rng.uniform(0.0, 180.0)
        turn = np.radians(np.linspace(start, start + rng.uniform(-120.0, 120.0), 40))
        height = at_mm + np.linspace(rng.uniform(-70.0, 70.0), rng.uniform(-70.0, 70.0), 40)
        lift = rng.uniform(0.0, 25.0) * np.sin(np.linspace(0.0, np.pi, 40)) if number % 3 else np.zeros(40)
        points = np.empty((40, 3))
        for k, (a, z) in enumerate(zip(turn, height, strict=True)):
            spoke = np.array([np.cos(a), -np.sin(a)])
            points[k] = *(outline.middle(z) + (outline.reach(z, spoke) + radius + lift[k]) * spoke), z
        name = f"{'cable' if cable else 'line'}_{number}"
        yield Part(name, tube(points, np.full(40, radius)), SHEATH_HU)
        inner = 0.3 if cable else 0.55
        core = CORE_HU if cable else WATER_HU
        yield Part(f"{name}_core", tube(points[1:-1], np.full(38, inner * radius)), core)
