"""A scan of a scene: exact partial volume, blur in the plane, noise, and the range that a scanner stores."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.plant.scanner.coverage import cut_solids
from puncture_twin.twin.plant.scanner.solids import Solid
from puncture_twin.twin.plant.scanner.thin_parts import missed_voxels

AIR_HU = -1000.0
"""By the scale's definition."""
LOWEST_HU, HIGHEST_HU = -1024, 3071
"""What 12 bits hold at an intercept of -1024: metal is clipped."""
FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
BLUR_ENDS = 3.0
"""Standard deviations at which the blur's kernel ends."""


@dataclass(frozen=True)
class ScanSettings:
    """How a scan is made.

    Attributes:
        spacing_mm: Of the slices, which are as thick.
        pixel_mm: In the plane, square.
        noise_hu: Standard deviation of a voxel, each on its own (in a real scan neighbours are correlated).
        blur_mm: Full width at half maximum of the Gaussian blur in the plane.
        seed: Of the noise and of where the grid falls.
        fov_mm: Side of the square image; None shows the whole body.
        length_mm: Along the bed; None scans the whole body.
        turn: By which the patient is turned about the bed's direction, rad.
    """

    spacing_mm: float = 2.5
    pixel_mm: float = 0.8
    noise_hu: float = 20.0
    blur_mm: float = 1.0
    seed: int = 0
    fov_mm: float | None = None
    length_mm: float | None = None
    turn: float = 0.0


@dataclass(frozen=True, eq=False)
class CtImage:
    """A scan, and the truth beside it.

    Attributes:
        hu: Shape (nx, ny, nz), int16.
        labels: Shape (layers, nx, ny, nz): what is labelled at each voxel's centre, in each label map, and the parts of
            whole solids that the centres miss.
        grid: Where the voxels lie, LPS mm.
        thin: Name of a solid to the number of voxels whose label its thin parts got.
    """

    hu: NDArray[np.int16]
    labels: NDArray[Any]
    grid: VolumeGrid
    thin: Mapping[str, int]


def scan_solids(solids: Sequence[Solid], grid: VolumeGrid, settings: ScanSettings, rng: np.random.Generator) -> CtImage:
    """Scan a scene in air.

    Args:
        solids: The scene in the scanner's frame, LPS mm; later ones fill the place of earlier ones.
        grid: The voxels; axis k runs across the slices.
        settings: Blur and noise.
        rng: Draws the noise.
    """
    T_index_ct = np.linalg.inv(grid.T_ct_index)
    each = [apply(T_index_ct, solid.mesh.vertices)[solid.mesh.faces] for solid in solids]
    corners = np.concatenate(each)
    owners = np.repeat(np.arange(len(solids)), [len(solid.mesh.faces) for solid in solids])
    fills = np.array([solid.hu for solid in solids])
    labels = _label_table(solids)
    cut = cut_solids(corners, owners, fills, labels, grid.shape, spacing_mm=grid.spacing_mm, empty=AIR_HU)
    thin = _label_thin_parts(solids, each, labels, cut.labels)
    return CtImage(_stored(cut.values, grid.spacing_mm, settings, rng), cut.labels, grid, thin)


def _label_thin_parts(
    solids: Sequence[Solid], corners: Sequence[Floats], table: NDArray[Any], labels: NDArray[Any]
) -> dict[str, int]:
    """Label what the centres of voxels miss of whole solids, in place; which, and how many voxels."""
    counts: dict[str, int] = {}
    for number, solid in enumerate(solids):
        if solid.whole and solid.label:
            layer = labels[solid.layer]
            later = np.zeros(int(table[solid.layer].max()) + 1, bool)
            later[table[solid.layer, number + 1 :]] = True
            later[0] = False
            missed = missed_voxels(layer, solid.label, corners[number], later)
            layer[tuple(missed.T)] = solid.label
            if len(missed):
                counts[solid.name] = len(missed)
    return counts


def _label_table(solids: Sequence[Solid]) -> NDArray[Any]:
    """Label of each solid in each map, shape (layers, n)."""
    table = np.zeros((1 + max(solid.layer for solid in solids), len(solids)), np.uint16)
    for number, solid in enumerate(solids):
        table[solid.layer, number] = solid.label
    return table.astype(np.uint8) if table.max() <= np.iinfo(np.uint8).max else table


def _stored(
    values: NDArray[np.float32], spacing_mm: Floats, settings: ScanSettings, rng: np.random.Generator
) -> NDArray[np.int16]:
    """Blurred slice by slice, with noise, rounded and clipped, shape as ``values``."""
    stored = np.empty(values.shape, np.int16, order="F")
    sigma = settings.blur_mm / FWHM_PER_SIGMA / spacing_mm[:2]
    for k in range(values.shape[2]):
        image = ndimage.gaussian_filter(values[:, :, k].T, sigma[::-1], mode="nearest", truncate=BLUR_ENDS)
        image += np.float32(settings.noise_hu) * rng.standard_normal(image.shape, dtype=np.float32)
        stored[:, :, k] = np.clip(np.rint(image), LOWEST_HU, HIGHEST_HU).T
    return stored
