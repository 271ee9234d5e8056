"""A CT image of solids: exact partial volume, blur in the plane, noise, and the range that a scanner stores."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy import ndimage

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.volumes.volume_header import VolumeGrid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, pose
from puncture_twin.twin.plant.scanner.coverage import cut_solids

AIR_HU = -1000.0
"""By the scale's definition."""
LOWEST_HU, HIGHEST_HU = -1024, 3071
"""What 12 bits hold at an intercept of -1024: metal is clipped."""
FWHM_PER_SIGMA = 2.0 * np.sqrt(2.0 * np.log(2.0))
BLUR_ENDS = 3.0
"""Standard deviations at which the blur's kernel ends."""


@dataclass(frozen=True)
class ScanSettings:
    """Settings of a scan: noise of each voxel on its own, full width at half maximum of the blur in the plane."""

    spacing_mm: float = 2.5
    pixel_mm: float = 0.8
    noise_hu: float = 20.0
    blur_mm: float = 1.0
    seed: int = 0
    fov_mm: float | None = None
    """Side of the square image; None shows the whole body, as no ``length_mm`` along the bed does."""
    length_mm: float | None = None
    turn: float = 0.0  # by which the patient is rotated about the bed's direction, rad


@dataclass(frozen=True, eq=False)
class CtImage:
    """A scan, with its ground truth."""

    hu: NDArray[np.int16]  # shape (nx, ny, nz), int16
    labels: NDArray[Any]
    """Shape (layers, nx, ny, nz): what is labelled at each voxel's centre, in each label map, and the parts of whole
    solids that the centres miss; `thin` counts these by the solid's name."""
    grid: VolumeGrid
    thin: Mapping[str, int]


def scan_solids(solids: Sequence[Solid], grid: VolumeGrid, settings: ScanSettings, rng: np.random.Generator) -> CtImage:
    """Scan a scene in air: solids in the scanner's frame, LPS mm; later ones fill the place of earlier ones."""
    T_index_ct = np.linalg.inv(grid.T_ct_index)
    each = [apply(T_index_ct, solid.mesh.vertices)[solid.mesh.faces] for solid in solids]
    corners = np.concatenate(each)
    owners = np.repeat(np.arange(len(solids)), [len(solid.mesh.faces) for solid in solids])
    fills = np.array([solid.hu for solid in solids])
    labels = np.zeros((1 + max(solid.layer for solid in solids), len(solids)), np.uint16)  # of each, in each map
    labels[[solid.layer for solid in solids], np.arange(len(solids))] = [solid.label for solid in solids]
    labels = labels.astype(np.uint8) if labels.max() <= np.iinfo(np.uint8).max else labels
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
            later = np.zeros(int(table[solid.layer].max()) + 1, bool)
            later[table[solid.layer, number + 1 :]] = True
            later[0] = False
            missed = missed_voxels(labels[solid.layer], solid.label, corners[number], later)
            labels[solid.layer][tuple(missed.T)] = solid.label
            counts[solid.name] = len(missed)
    return {name: count for name, count in counts.items() if count}


def _stored(
    values: NDArray[np.float32], spacing_mm: Floats, settings: ScanSettings, rng: np.random.Generator
) -> NDArray[np.int16]:
    stored = np.empty(values.shape, np.int16, order="F")
    sigma = settings.blur_mm / FWHM_PER_SIGMA / spacing_mm[:2]  # in voxels
    for k in range(values.shape[2]):
        image = ndimage.gaussian_filter(values[:, :, k].T, sigma[::-1], mode="nearest", truncate=BLUR_ENDS)
        image += np.float32(settings.noise_hu) * rng.standard_normal(image.shape, dtype=np.float32)
        stored[:, :, k] = np.clip(np.rint(image), LOWEST_HU, HIGHEST_HU).T
    return stored


SAMPLE_VOXELS = 0.4
"""At most so far apart are samples of a surface."""
MOST_SAMPLES = 1_000_000
"""Samples of triangles that are taken together."""


def passed_voxels(corners: Floats, shape: tuple[int, int, int]) -> Ints:
    """The voxels that triangles (n, 3, 3) pass, shape (m, 3), each once; all in voxels, centres whole."""
    voxels = [np.empty(0, np.int64)]
    for points in _samples(corners):
        index = np.floor(points + 0.5).astype(np.int64)  # a voxel reaches half a voxel to each side
        inside = np.all((index >= 0) & (index < shape), axis=1)
        voxels.append(np.unique(np.ravel_multi_index(tuple(index[inside].T), shape)))
    return np.stack(np.unravel_index(np.unique(np.concatenate(voxels)), shape), axis=1)


def missed_voxels(labels: NDArray[Any], label: int, corners: Floats, later: Bools) -> Ints:
    """Voxels (m, 3) that triangles (n, 3, 3), in voxels, pass while neither they nor their neighbours have the label.

    Labels (nx, ny, nz) are those at the centres; ``later`` (largest label + 1,) are those that fill the place of this
    one: their voxels are not missed.
    """
    shape = (labels.shape[0], labels.shape[1], labels.shape[2])
    at = passed_voxels(corners, shape)
    if not len(at):
        return at
    low, high = np.maximum(at.min(axis=0) - 1, 0), at.max(axis=0) + 2
    box = labels[low[0] : high[0], low[1] : high[1], low[2] : high[2]]
    near_label = ndimage.binary_dilation(box == label, np.ones((3, 3, 3), bool))
    x, y, z = (at - low).T
    return at[~near_label[x, y, z] & ~later[box[x, y, z]]]


def _samples(corners: Floats) -> Iterator[Floats]:
    edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    counts = np.maximum(1, np.ceil(edges / SAMPLE_VOXELS).astype(np.int64))  # pieces of the longest edge
    for count in np.unique(counts).tolist():
        i, j = np.array([(i, j) for i in range(count + 1) for j in range(count + 1 - i)]).T / count
        weights = np.stack([1 - i - j, i, j])
        some = corners[counts == count]
        step = max(1, MOST_SAMPLES // len(i))
        for start in range(0, len(some), step):
            yield np.einsum("wp,twc->tpc", weights, some[start : start + step]).reshape(-1, 3)


SIDES = 64
"""Sides of a round body: its volume is that of the circle to 1.6e-3."""


class Solid(NamedTuple):
    """One body in the scanner, Hounsfield units; a later one fills the place of an earlier one."""

    name: str
    mesh: TriangleMesh
    hu: float
    label: int = 0  # its number in its label map (bodies that hold others have one of their own); 0 where none names it
    layer: int = 0
    whole: bool = False  # its label leaves out no part of it, however thin


def check_closed(solid: Solid, where: str) -> Solid:
    """The solid; one without an inside is refused."""
    if not solid.mesh.closed:
        refuse(f"'{solid.name}' is not a closed surface", where, "closed surfaces", "open_mesh")
    return solid


def ball(centre: Floats, diameter_mm: float) -> TriangleMesh:
    """A ball about a point (3,), mm."""
    mesh = trimesh.creation.icosphere(4, diameter_mm / 2)
    return TriangleMesh(np.asarray(mesh.vertices) + centre, np.asarray(mesh.faces))


def rod(start: Floats, end: Floats, diameter_mm: float) -> TriangleMesh:
    """A round rod between the middles of its flat ends, points (3,), mm: a needle, or a disc where it is short."""
    mesh = trimesh.creation.cylinder(diameter_mm / 2, segment=np.stack([start, end]), sections=SIDES)
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces))


def box(centre: Floats, size_mm: Floats) -> TriangleMesh:
    """A box with edges along the axes, mm."""
    mesh = trimesh.creation.box(np.asarray(size_mm, dtype=float))
    return TriangleMesh(np.asarray(mesh.vertices), np.asarray(mesh.faces)).transformed(pose(np.eye(3), centre))
