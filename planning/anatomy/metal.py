"""Metal in a CT: its connected pieces, how much of each voxel is metal, and the middle by these parts."""

import itertools
from collections.abc import Iterator
from typing import Literal, NamedTuple

import numpy as np
from scipy import ndimage
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply

METAL_HU = 1500.0
"""Cortical bone and teeth end about here; half a voxel of steel has more."""
AROUND_MM, BLUR_MM, EDGE_MM = 3.0, 1.5, 1.5
"""So far about metal its surroundings are looked at; so far from its voxels a piece of it still blurs into others (what
is beyond shows what it lies in); so far the edges of wide metal protrude from the balls that fit into it."""
SOLID_HU = 8000.0
"""Assumed of a voxel that is wholly metal, whose value the range of the image clips. It only decides at which part of
metal a voxel in air and one in tissue count as full: alike, so that a marker on the skin is not drawn to one side."""
LEAST_PART = 0.02
"""Below this a voxel's noise, not metal, is weighed."""
Box = tuple[slice, slice, slice]


class Metal(NamedTuple):
    """One connected piece of metal: its voxels in their box with `AROUND_MM` about it, and their middle (3,), LPS mm.

    ``size_mm`` is the longest side of the voxels' box.
    """

    box: Box
    voxels: Bools
    middle_ct: Floats  # shape (3,), of its voxels, LPS mm
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
    for at in connected(metal):  # boxes: metal is a small part of an image
        ends = zip(np.maximum(at.min(axis=0) - reach, 0), at.max(axis=0) + 1 + reach, strict=True)
        box = tuple(slice(low, high) for low, high in ends)
        core = ndimage.distance_transform_edt(np.pad(metal[box], 1), spacing)[1:-1, 1:-1, 1:-1] > radius  # erosion
        if core.any():
            wide[box] |= ndimage.distance_transform_edt(~core, spacing) <= radius + EDGE_MM + BLUR_MM
    return wide


def metal_pieces(volume: Volume, level_hu: float = METAL_HU, without: Bools | None = None) -> Iterator[Metal]:
    """Every connected piece of metal, diagonal neighbours included, from a level on, but for some voxels."""
    metal = volume.values > level_hu
    spacing, shape = spacing_mm(volume), np.array(metal.shape)
    around = np.ceil(AROUND_MM / spacing).astype(int)
    for at in connected(metal if without is None else metal & ~without):
        low, high = at.min(axis=0), at.max(axis=0) + 1
        begin, end = np.maximum(low - around, 0), np.minimum(high + around, shape)
        box = (slice(begin[0], end[0]), slice(begin[1], end[1]), slice(begin[2], end[2]))
        voxels = np.zeros(end - begin, np.bool_)
        voxels[tuple((at - begin).T)] = True
        yield Metal(box, voxels, apply(volume.T_ct_index, at.mean(axis=0)), float(((high - low) * spacing).max()))


def where_set(mask: Bools) -> Ints:
    """Indices (n, 3) of the voxels that are set, in the order of memory: `np.argwhere` crosses a large image."""
    order: Literal["F", "C"] = "F" if mask.flags.f_contiguous else "C"
    return np.stack(np.unravel_index(np.flatnonzero(mask.ravel(order)), mask.shape, order), axis=1)


def connected(mask: Bools) -> list[Ints]:
    """The voxels (n, 3) of each connected piece of a mask, diagonal neighbours included, in the order of their first.

    By the few voxels that are set: labelling a whole image takes as long as it is large.
    """
    ny, nz = mask.shape[1] + 2, mask.shape[2] + 2  # a border, over which no neighbour is reached
    i, j, k = where_set(mask).T
    key = (i * ny + j) * nz + k
    first = np.argsort(key)
    i, j, k, key = i[first], j[first], k[first], key[first]
    pairs = []
    for step in (d for d in itertools.product((-1, 0, 1), repeat=3) if d > (0, 0, 0)):
        other = key + (step[0] * ny + step[1]) * nz + step[2]
        place = np.minimum(np.searchsorted(key, other), max(len(key) - 1, 0))
        pairs.append(np.stack([np.flatnonzero(key[place] == other), place[key[place] == other]]))
    one, two = np.concatenate(pairs, axis=1)
    graph = coo_array((np.ones(len(one), np.bool_), (one, two)), shape=(len(key), len(key)))
    _, number = connected_components(graph, directed=False)
    rows = np.argsort(number, kind="stable")
    parts = np.split(np.stack([i, j, k], axis=1)[rows], np.flatnonzero(np.diff(number[rows])) + 1)
    return sorted(parts, key=lambda at: tuple(at[0])) if len(key) else []


def metal_parts(
    volume: Volume,
    metal: Metal,
    *,
    level_hu: float = METAL_HU,
    solid_hu: float = SOLID_HU,
    reach_mm: Floats | float = BLUR_MM,
    least: float = LEAST_PART,
) -> Floats:
    """Part of each voxel of a piece's box that is metal, 0 to 1; none below ``least``.

    What a voxel would show without metal is what the nearest voxel shows that is too far away to be blurred by it: air
    on one side of a marker and skin on the other. Without that, air would hide the outer edge of a marker. Other voxels
    are metal from ``level_hu`` on, wholly at ``solid_hu``; ``reach_mm`` (one number, or one an axis) is how far metal
    blurs.
    """
    values = volume.values[metal.box].astype(np.float64)
    every, outside = _sides(values, volume, metal, level_hu, reach_mm)
    if not outside.any():
        return np.asarray(metal.voxels, dtype=np.float64)
    spacing = spacing_mm(volume)
    nearest = ndimage.distance_transform_edt(~outside, spacing, return_distances=False, return_indices=True)
    near = ndimage.gaussian_filter(outside.astype(np.float64), 1.0)  # the mean about each voxel of those outside
    smooth = ndimage.gaussian_filter(np.where(outside, values, 0.0), 1.0) / np.maximum(near, 1e-3)
    background = smooth[tuple(nearest)]
    parts = (values - background) / (solid_hu - background)  # linear partial volume
    others = every & ~metal.voxels
    mine = ndimage.distance_transform_edt(~metal.voxels, spacing)
    strange = others.any() and mine >= ndimage.distance_transform_edt(~others, spacing)  # nearer to another piece
    return np.where(outside | strange | (parts < least), 0.0, parts)


def clear_of_metal(volume: Volume, metal: Metal, level_hu: float, reach_mm: Floats | float) -> Bools:
    """The voxels of a piece's box that no metal reaches."""
    return _sides(volume.values[metal.box], volume, metal, level_hu, reach_mm)[1]


def _sides(
    values: Floats, volume: Volume, metal: Metal, level_hu: float, reach_mm: Floats | float
) -> tuple[Bools, Bools]:
    """Of a piece's box: every voxel of metal, its own and others', and those that none reaches."""
    every = metal.voxels | (values > level_hu)
    return every, np.asarray(ndimage.distance_transform_edt(~every, spacing_mm(volume) / reach_mm) > 1.0)


def full_part(volume: Volume) -> float:
    """Part of metal from which a voxel is clipped, in soft tissue."""
    return float(volume.values.max()) / SOLID_HU


def metal_weights(volume: Volume, metal: Metal) -> Floats:
    """Weights of metal, counted as full from where a voxel may be clipped: in air and in tissue alike."""
    full = full_part(volume)
    return np.asarray(np.minimum(metal_parts(volume, metal), full) / full)


def centroid(weights: Floats, box: Box, T_ct_index: Floats) -> Floats:
    """The weights' middle, shape (3,), LPS mm."""
    sums = (weights.sum(axis=others) for others in ((1, 2), (0, 2), (0, 1)))
    index = [np.tensordot(np.arange(len(one)), one, 1) for one in sums]
    return apply(T_ct_index, np.array(index) / weights.sum() + [axis.start for axis in box])
