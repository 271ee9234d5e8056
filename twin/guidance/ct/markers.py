"""Markers and a lesion found in a CT: by a voxel, as a person reads them, and by less than a voxel.

The rule of Chen 2019, section 3.1, is a voxel's: the number of the slice that shows a marker best, times the spacing,
and its place in that slice to 1 mm. The finer place is the middle of the metal, by weights.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import linear_sum_assignment

from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.points import NamedPoints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.planning.geometry.spaces import Space

METAL_HU = 1500.0
"""Cortical bone and teeth end about here; half a voxel of steel has more."""
AROUND_MM = 3.0
"""So far about metal its surroundings are looked at."""
BLUR_MM = 1.5
"""So far from its voxels a piece of metal still blurs into others; beyond, they show what it lies in."""

EDGE_MM = 1.5
"""mm by which the edges of wide metal protrude from the balls that fit into it."""

SOLID_HU = 8000.0
"""Assumed of a voxel that is wholly metal, whose value the range of the image clips. It only decides at which part of
metal a voxel in air and one in tissue count as full: alike, so that a marker on the skin is not drawn to one side."""
LEAST_PART = 0.02
"""Below this a voxel's noise, not metal, is weighed."""

Box = tuple[slice, slice, slice]


class Metal(NamedTuple):
    """One connected piece of metal.

    Attributes:
        box: Its voxels' box with `AROUND_MM` about it.
        voxels: Of the box: which belong to the piece.
        middle_ct: Shape (3,), of its voxels, LPS mm.
        size_mm: The longest side of its box.
    """

    box: Box
    voxels: Bools
    middle_ct: Floats
    size_mm: float


def spacing_mm(volume: Volume) -> Floats:
    """Distance of neighbouring voxels along i, j and k, shape (3,)."""
    return np.asarray(np.linalg.norm(volume.T_ct_index[:3, :3], axis=0))


def wide_metal(volume: Volume, diameter_mm: float) -> Bools:
    """Voxels of metal that is wider than a rod, and those into which it blurs; shape of the image.

    Wide is what a ball fits into that is wider than the rod's own image.
    """
    metal, spacing = volume.values > METAL_HU, spacing_mm(volume)
    radius, wide = diameter_mm / 2 + BLUR_MM, np.zeros(metal.shape, np.bool_)
    reach = np.ceil((radius + EDGE_MM + BLUR_MM) / spacing).astype(int) + 1
    for found in ndimage.find_objects(ndimage.label(metal)[0]):  # boxes: metal is a small part of an image
        box = tuple(slice(max(one.start - more, 0), one.stop + more) for one, more in zip(found, reach, strict=True))
        core = ndimage.distance_transform_edt(np.pad(metal[box], 1), spacing)[1:-1, 1:-1, 1:-1] > radius  # erosion
        if core.any():
            wide[box] |= ndimage.distance_transform_edt(~core, spacing) <= radius + EDGE_MM + BLUR_MM
    return wide


def metal_pieces(volume: Volume, level_hu: float = METAL_HU, without: Bools | None = None) -> Iterator[Metal]:
    """Every connected piece of metal, diagonal neighbours included, from a level on, but for some voxels."""
    metal = volume.values > level_hu
    labels, _ = ndimage.label(metal if without is None else metal & ~without, structure=np.ones((3, 3, 3)))
    spacing = spacing_mm(volume)
    around = np.ceil(AROUND_MM / spacing).astype(int)
    for number, found in enumerate(ndimage.find_objects(labels), start=1):
        low, high = np.array([(one.start, one.stop) for one in found]).T
        begin, end = np.maximum(low - around, 0), np.minimum(high + around, volume.values.shape)
        box = (slice(begin[0], end[0]), slice(begin[1], end[1]), slice(begin[2], end[2]))
        voxels = labels[box] == number
        middle = apply(volume.T_ct_index, np.argwhere(voxels).mean(axis=0) + begin)
        yield Metal(box, voxels, middle, float(((high - low) * spacing).max()))


def metal_parts(volume: Volume, metal: Metal) -> Floats:
    """Part of each voxel of a piece's box that is metal, 0 to 1, as far as a clipped range allows.

    What a voxel would show without metal is what the nearest voxel shows that is too far away to be blurred by it:
    air on one side of a marker and skin on the other. Without that, air would hide the outer edge of a marker.
    """
    values = volume.values[metal.box].astype(np.float64)
    spacing = spacing_mm(volume)
    every = metal.voxels | (values > METAL_HU)
    outside = ndimage.distance_transform_edt(~every, spacing) > BLUR_MM
    if not outside.any():
        return np.asarray(metal.voxels, dtype=np.float64)
    nearest = ndimage.distance_transform_edt(~outside, spacing, return_distances=False, return_indices=True)
    background = _smooth(values, outside)[tuple(nearest)]
    parts = (values - background) / (SOLID_HU - background)  # linear partial volume
    others = every & ~metal.voxels
    mine = ndimage.distance_transform_edt(~metal.voxels, spacing)
    strange = others.any() and mine >= ndimage.distance_transform_edt(~others, spacing)  # nearer to another piece
    return np.where(outside | strange | (parts < LEAST_PART), 0.0, parts)


def full_part(volume: Volume) -> float:
    """Part of metal from which a voxel is clipped, in soft tissue."""
    return float(volume.values.max()) / SOLID_HU


def metal_weights(volume: Volume, metal: Metal) -> Floats:
    """Weights of metal, counted as full from where a voxel may be clipped: in air and in tissue alike."""
    full = full_part(volume)
    return np.asarray(np.minimum(metal_parts(volume, metal), full) / full)


def _smooth(values: Floats, some: Bools) -> Floats:
    """The mean about each voxel of those that count."""
    near = ndimage.gaussian_filter(some.astype(np.float64), 1.0)
    return np.asarray(ndimage.gaussian_filter(np.where(some, values, 0.0), 1.0) / np.maximum(near, 1e-3))


def centroid(weights: Floats, box: Box, T_ct_index: Floats) -> Floats:
    """The weights' middle, shape (3,), LPS mm."""
    starts = [axis.start for axis in box]
    index = [np.tensordot(np.arange(n), weights.sum(axis=_others(axis)), 1) for axis, n in enumerate(weights.shape)]
    return apply(T_ct_index, np.array(index) / weights.sum() + starts)


def _others(axis: int) -> tuple[int, int]:
    a, b = itertools.compress(range(3), [one != axis for one in range(3)])
    return a, b


READING_MM = 1.0
"""mm to which a person reads a place in a slice."""
FARTHEST_MM = 15.0
"""A marker lies no farther from where it is expected."""
LARGEST_MM = 25.0
"""A larger piece of metal is no marker."""


class Markers(NamedTuple):
    """Markers that were found, in the order of those expected.

    Attributes:
        fine: By the middle of the metal.
        rule: By slice number and millimetre.
    """

    fine: NamedPoints
    rule: NamedPoints


def find_markers(volume: Volume, expected: NamedPoints) -> Markers:
    """Find markers of metal near where they are expected.

    Args:
        volume: The CT, LPS; its third axis runs across the slices.
        expected: Roughly where each is, LPS mm: names the pieces of metal.

    Raises:
        InputError: A marker that no piece of metal is near to.
    """
    pieces = [piece for piece in metal_pieces(volume) if piece.size_mm <= LARGEST_MM]
    chosen = _named(pieces, expected, volume)
    weights = [metal_weights(volume, piece) for piece in chosen]
    fine = [centroid(some, piece.box, volume.T_ct_index) for some, piece in zip(weights, chosen, strict=True)]
    rule = [_by_rule(some, piece, volume) for some, piece in zip(weights, chosen, strict=True)]
    return Markers(*(NamedPoints(expected.names, np.array(points), Space.LPS) for points in (fine, rule)))


def _named(pieces: list[Metal], expected: NamedPoints, volume: Volume) -> list[Metal]:
    """A piece for each name, such that all distances together are least."""
    middles = np.array([piece.middle_ct for piece in pieces]).reshape(-1, 3)
    distance = np.linalg.norm(expected.points[:, None] - middles, axis=2)
    rows, columns = linear_sum_assignment(np.where(distance < FARTHEST_MM, distance, 1e6))
    found = {int(row): int(column) for row, column in zip(rows, columns, strict=True)}
    for row, name in enumerate(expected.names):
        if row not in found or distance[row, found[row]] >= FARTHEST_MM:
            voxels = " x ".join(f"{size:g}" for size in spacing_mm(volume))
            allowed = (
                f"metal within {FARTHEST_MM:g} mm of the expected position, and voxels far smaller than the marker"
            )
            what = f"marker {name} is not seen in the image (voxels of {voxels} mm)"
            refuse(what, volume.path, allowed, "marker_not_seen")
    return [pieces[found[row]] for row in range(len(expected.names))]


def _by_rule(weights: Floats, piece: Metal, volume: Volume) -> Floats:
    """The place by the paper's rule: the slice with most of the metal, and there its middle to a millimetre."""
    k = int(np.argmax(weights.sum(axis=(0, 1))))
    i, j = (float(line @ np.arange(len(line)) / line.sum()) for line in _sides(weights[:, :, k]))
    spacing = spacing_mm(volume)
    index = np.array([i, j, k]) + [axis.start for axis in piece.box]
    index[:2] = np.round(index[:2] * spacing[:2] / READING_MM) * READING_MM / spacing[:2]
    return apply(volume.T_ct_index, index)


def _sides(slice_weights: Floats) -> tuple[Floats, Floats]:
    return slice_weights.sum(axis=1), slice_weights.sum(axis=0)


RIM_MM = 4.0
"""Beyond a segmentation, so far the surroundings are looked at."""


def read_lesion(volume: Volume, mask: NDArray[np.bool_]) -> Floats:
    """The middle of what a segmentation outlines, by the values in and around it, shape (3,), LPS mm.

    Args:
        volume: The CT.
        mask: Shape of the CT: the lesion's voxels.

    Raises:
        InputError: An empty mask.
    """
    found = ndimage.find_objects(mask.astype(np.uint8))
    if not found:
        refuse("no voxel belongs to the lesion", volume.path, "a lesion larger than a voxel", "lesion_not_seen")
    spacing = spacing_mm(volume)
    around = np.ceil(RIM_MM / spacing).astype(int) + 1
    low = np.maximum(np.array([one.start for one in found[0]]) - around, 0)
    high = np.minimum(np.array([one.stop for one in found[0]]) + around, mask.shape)
    box = (slice(low[0], high[0]), slice(low[1], high[1]), slice(low[2], high[2]))
    values, inside = volume.values[box].astype(np.float64), mask[box]
    distance = ndimage.distance_transform_edt(~inside, spacing)
    core = ndimage.distance_transform_edt(inside, spacing) > spacing.max()
    own = np.median(values[core if core.any() else inside])
    other = np.median(values[(distance > spacing.max()) & (distance <= RIM_MM + spacing.max())])
    if own == other:
        return centroid(inside.astype(np.float64), box, volume.T_ct_index)
    weights = np.where(core, 1.0, np.clip((values - other) / (own - other), 0.0, 1.0))
    return centroid(np.where(distance <= spacing.max(), weights, 0.0), box, volume.T_ct_index)
