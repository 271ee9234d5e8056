"""Organs that a lesion was carved out of: a label map has one label a voxel, so such an organ does not hold its lesion.

Nothing tells that a path to the lesion must cross the organ then; with its usual role every such path is rejected.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.init.outlines import fraction_near
from puncture_twin.planning.init.segmentation import Assigned, Segmentation

BORDER_MM = 2.0
"""The surfaces of two labels that border on each other are this near: both lie between the same voxels."""

MOST_OF_BORDER = 0.5
"""Of the target's surface, which an organ about it borders on; one below the organ's surface has more."""


def carved_notes(sources: Sequence[tuple[Segmentation, Sequence[Assigned]]]) -> Iterator[str]:
    """That an avoided structure goes round the target's, one sentence each.

    Args:
        sources: Each segmentation with what the case says of its structures.
    """
    rows = [(segmentation, row) for segmentation, some in sources for row in some]
    targets = [(one.surface(row.label), row.name) for one, row in rows if row.kind == "target"]
    for target, name in targets:
        for segmentation, row in rows:
            if row.kind == "avoid" and _goes_round(segmentation.surface(row.label), target):
                yield (
                    f"'{row.name}' goes round '{name}' without holding it, as if that was carved out of it, and is "
                    f"avoided by {row.margin_mm:g} mm, so no path through it is safe: if a path may cross it, make it "
                    "traverse in the case"
                )


def _goes_round(mesh: TriangleMesh, target: TriangleMesh) -> bool:
    low, high = mesh.bounds
    below, above = target.bounds
    if (above < low - BORDER_MM).any() or (below > high + BORDER_MM).any():
        return False
    return fraction_near(target, mesh, BORDER_MM) >= MOST_OF_BORDER
