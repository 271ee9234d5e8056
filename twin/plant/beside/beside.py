"""What lies beside a patient in a scanner, as asked for."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.twin.plant.beside.arms import Arms, arms
from puncture_twin.twin.plant.beside.bed import Bed, bed
from puncture_twin.twin.plant.beside.lines import lines
from puncture_twin.twin.plant.beside.outline import Outline
from puncture_twin.twin.plant.beside.tubes import Part


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
