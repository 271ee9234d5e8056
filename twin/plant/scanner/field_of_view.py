"""Which voxels a scan has: the whole body, or as much of it as the field of view shows."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.twin.plant.scanner.case_scene import CaseScene
from puncture_twin.twin.plant.scanner.image import ScanSettings

AIR_MM = 15.0
"""Air around the body, and about arms and lines: a needle's entry is not at the image's edge."""
TABLE_MM = 100.0
"""Beside and behind the body, so much of a table is shown: where the image cuts it, what is beyond is not known."""
MOST_VOXELS = 200_000_000
"""A whole trunk at 0.8 x 0.8 x 0.6 mm; each voxel takes some ten bytes while it is made."""
DECIMALS = 4
"""Of positions in mm, so that DICOM's decimal strings hold them whole."""


def scan_grid(scene: CaseScene, settings: ScanSettings, rng: np.random.Generator) -> VolumeGrid:
    """The voxels of a scan, axes along LPS.

    Where the first of them falls is drawn within one voxel: a patient lies anywhere between two slices.

    Args:
        scene: What lies in the scanner; where the body goes on beyond its surface, the scan ends within it.
        settings: Spacing, pixel and field of view.
        rng: Draws where the grid falls.

    Raises:
        InputError: No slice, or more voxels than a machine holds.
    """
    low, high = _shown(scene, settings)
    spacing = np.array([settings.pixel_mm, settings.pixel_mm, settings.spacing_mm])
    first = np.round(low + (0.5 + rng.uniform(0.0, 1.0, 3)) * spacing, DECIMALS)
    counts = np.floor((high - first) / spacing + 0.5).astype(int)
    if counts.min() < 2 or np.prod(counts, dtype=float) > MOST_VOXELS:
        shown = " x ".join(map(str, counts))
        allowed = f"2 voxels or more along each axis, {MOST_VOXELS:,} at most: larger pixels, or --fov and --length"
        raise InputError(f"a scan of {shown} voxels", where="scan", allowed=allowed)
    T = np.diag([*spacing, 1.0])
    T[:3, 3] = first
    return VolumeGrid((int(counts[0]), int(counts[1]), int(counts[2])), T, {})


def _shown(scene: CaseScene, settings: ScanSettings) -> tuple[Floats, Floats]:
    """Lowest and highest corner of the image."""
    low, high = scene.skin.bounds
    low = low - np.where(scene.cut[:, 0], 0.0, AIR_MM)
    high = high + np.where(scene.cut[:, 1], 0.0, AIR_MM)
    for one in scene.beside:
        if one.place == "upon":
            low[:2] = np.minimum(low[:2], one.mesh.bounds[0, :2] - AIR_MM)
            high[:2] = np.maximum(high[:2], one.mesh.bounds[1, :2] + AIR_MM)
    for axis in (0, 1):
        low[axis] = min(low[axis], max(scene.tables[0, axis] - AIR_MM, low[axis] - TABLE_MM))
        high[axis] = max(high[axis], min(scene.tables[1, axis] + AIR_MM, high[axis] + TABLE_MM))
    if settings.fov_mm is not None:
        middle = (low + high) / 2
        low[:2], high[:2] = middle[:2] - settings.fov_mm / 2, middle[:2] + settings.fov_mm / 2
    if settings.length_mm is not None:
        low[2] = max(low[2], scene.target[2] - settings.length_mm / 2)
        high[2] = min(high[2], scene.target[2] + settings.length_mm / 2)
    return low, high
