"""A CT rendered from implicit bodies: every voxel a mixture of what fills it, with noise; the truth stays known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from tools.phantoms.implicit import Field

AIR_HU = -1000.0


class ScannedPart(NamedTuple):
    """One material in a scene; a later part fills the place of an earlier one."""

    name: str
    field: Field
    hu: float


@dataclass(frozen=True)
class Grid:
    """Voxels of a scan, axes along LPS; the first one's centre, their spacing and count along each axis."""

    low_mm: tuple[float, float, float]
    spacing_mm: tuple[float, float, float]
    shape: tuple[int, int, int]

    @property
    def affine(self) -> Floats:
        """T_ct_index, shape (4, 4): voxel index to LPS mm."""
        T = np.diag([*self.spacing_mm, 1.0])
        T[:3, 3] = self.low_mm
        return T

    def centres(self) -> Floats:
        """Of all voxels, shape (n, 3), LPS mm, the last index first."""
        index = np.indices(self.shape).reshape(3, -1).T
        return np.asarray(index * self.spacing_mm + self.low_mm)


def rendered(parts: Sequence[ScannedPart], grid: Grid, *, noise_hu: float, rng: np.random.Generator) -> Floats:
    """Hounsfield units of a scene, shape ``grid.shape``.

    A body's field grows by about 1 per mm, so a voxel as wide as w whose centre has the value d is filled by about
    1/2 - d/w of it. Around the parts is air.
    """
    points = grid.centres()
    width = float(np.prod(grid.spacing_mm)) ** (1 / 3)
    hu = np.full(len(points), AIR_HU)
    for part in parts:
        filled = np.clip(0.5 - part.field(points) / width, 0.0, 1.0)
        hu += filled * (part.hu - hu)
    return np.asarray(hu + rng.normal(0.0, noise_hu, len(hu))).reshape(grid.shape)
