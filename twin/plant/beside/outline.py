"""Where a skin is, seen from beside it: sections across the bed, and how far the body reaches in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh

END_MM = 20.0
"""Nearer to its ends along the bed a skin is rounded or cut: what lies beyond is as at so far from them."""
PER_SEGMENT = np.linspace(0.0, 1.0, 5)


@dataclass(frozen=True, eq=False)
class Outline:
    """A patient's skin in the scanner: x to the left, y to the back, z to the head.

    Attributes:
        skin: Closed, mm.
    """

    skin: TriangleMesh

    def section(self, z: float) -> Floats:
        """Where a plane across the bed cuts it: segments, shape (m, 2, 2), x and y, mm."""
        low, high = self.skin.bounds[:, 2]
        at = float(np.clip(z, min(low + END_MM, (low + high) / 2), max(high - END_MM, (low + high) / 2)))
        corners = self.skin.triangles
        above = corners[:, :, 2] > at
        cut = corners[above.any(axis=1) & ~above.all(axis=1)]
        above = cut[:, :, 2] > at
        alone = np.argmax(above == (above.sum(axis=1) == 1)[:, None], axis=1)
        rows = np.arange(len(cut))
        tip, first, second = (cut[rows, (alone + step) % 3] for step in range(3))
        return np.stack([_crossing(tip, first, at), _crossing(tip, second, at)], axis=1)

    def middle(self, z: float) -> Floats:
        """Of the section's box, shape (2,), mm."""
        points = self.section(z).reshape(-1, 2)
        return np.asarray((points.min(axis=0) + points.max(axis=0)) / 2)

    def reach(self, z: float, direction: Floats) -> float:
        """From the section's middle to its farthest point along a unit direction (2,), mm."""
        segments = self.section(z) - self.middle(z)
        across = np.array([-direction[1], direction[0]])
        off, along = segments @ across, segments @ direction
        crossed = (off[:, 0] > 0) != (off[:, 1] > 0)
        off, along = off[crossed], along[crossed]
        ahead = along[:, 0] - off[:, 0] * (along[:, 1] - along[:, 0]) / (off[:, 1] - off[:, 0])
        return float(ahead.max(initial=0.0))

    def aside(self, z: float, side: float, y: tuple[float, float]) -> float:
        """The outermost x to a side (1 or -1), times the side, where y lies within a range, mm."""
        segments = self.section(z)
        points = segments[:, :1] + PER_SEGMENT[:, None] * (segments[:, 1:] - segments[:, :1])
        points = points.reshape(-1, 2)
        within = points[(points[:, 1] >= y[0]) & (points[:, 1] <= y[1])]
        return float((side * (within if len(within) else points)[:, 0]).max())

    def back(self, low_mm: float, high_mm: float) -> float:
        """The rearmost y between two heights, mm."""
        z, y = self.skin.vertices[:, 2], self.skin.vertices[:, 1]
        within = (z >= low_mm) & (z <= high_mm)
        return float(y[within].max() if within.any() else y.max())


def _crossing(a: Floats, b: Floats, z: float) -> Floats:
    part = ((z - a[:, 2]) / (b[:, 2] - a[:, 2]))[:, None]
    return np.asarray((a + part * (b - a))[:, :2])
