"""Which voxels of a CT are the patient: trunk and limbs without table and sheets, solid, lungs and gas included.

What the scanner did not measure is neither body nor air. One value stands there (-3024, that of air, or 0): beyond the
circle of reconstruction, beside the slab of a tilted gantry, in slices that fill a volume up. Measured air has noise.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.cut_ends import Box, Content, content_of, shifted, spacing_of
from puncture_twin.planning.anatomy.body.tables import PATIENT, Shown, TableSide, touching_tables
from puncture_twin.planning.base.arrays import Bools, Floats, Ints, Ints32, grown, widened
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.formats.volumes.volume_files import Volume, canonical, in_order
from puncture_twin.planning.geometry.parts import largest_part, middle_of, parts_of
from puncture_twin.planning.geometry.rigid import apply

UNSCANNED_HU, BLANK_HU, NEARLY_AIR_HU = -1500.0, -2000.0, -900.0
"""Nothing real is less dense than air; what is written in the place of paddings that are denser, such as 0; and below
this a voxel is air, with its noise."""
MEASURED_AIR, ALIKE_PAIRS = 0.02, 0.5
"""So much of what may be air is measured, or nothing tells: of a blanked background only the skin's seam is left. And
so many of its neighbours have one value at most: noise of 2 HU leaves less than a fifth."""
BODY_HU = -500.0
"""Half way between air (-1000) and water (0): where a voxel is half skin, half air."""
OUTSIDE_AIR_HU, MIN_OUTSIDE_ML = -940.0, 50.0
"""Air at the border is the room's if its median is below this (lung has -920), and no less than bowel holds."""
MIN_BODY_ML = 100.0
"""Less than a tenth of a newborn's head: something else was found."""
OPENING_MM, SAMPLING_MM = 6.0, 3.0
"""Parts thinner than twice this are no trunk, head or limb; asked on a grid of half of it."""
CORNER = 3.0**0.5
"""So many times as far from where the ball fits a box's corner lies: it belongs to the box."""
MIN_LIMB_ML, MIN_BONE_ML = 20.0, 1.0
"""A newborn's forearm has 25 ml; 10 mm of an adult's radius have 1."""
SOFT_TISSUE_HU, BONE_HU = (-150.0, 150.0), 200.0
"""The median of a limb lies between (not foam's, wood's or metal's); bone is denser than vessels with contrast."""
UNSCANNED = (
    "the edge of the scanned region (the scanner's field of view, or a constant fill value) cuts the body; the skin "
    "is not known there, nor is a body for the arm to avoid; the space near it is unknown_region (outside_body)"
)


def measured_hu(hu: NDArray[Any]) -> tuple[NDArray[Any], Bools]:
    """An image (nx, ny, nz), HU, in which no padding counts as body: itself if none is dense; what was not measured."""
    unscanned = find_unscanned(hu)
    dense = unscanned & (hu >= NEARLY_AIR_HU)
    return (np.where(dense, hu.dtype.type(BLANK_HU), hu) if dense.any() else hu), unscanned


def find_unscanned(hu: NDArray[Any]) -> Bools:
    """Voxels that the scanner did not measure, shape of the image (nx, ny, nz), HU, axis 2 along the patient.

    It is far below air; or a slice of one value; or what holds together with a corner of the image by cubes of one
    value. In an image without noise nothing tells such a value from that of air: then it is air.
    """
    unscanned = np.asarray(hu < UNSCANNED_HU)
    corners = tuple(slice(None, None, max(1, n - 1)) for n in hu.shape)
    cubes = [hu[cube] for cube in itertools.product((slice(0, 2), slice(-2, None)), repeat=3)]
    for value in {cube.flat[0] for cube in cubes if cube.min() == cube.max() >= UNSCANNED_HU}:
        same, at_corners = hu == value, np.zeros(hu.shape, bool)
        # Cubes of 3 voxels of one value are no noise, also where a scanner clips at -1024; beyond the faces it goes on.
        blocks = widened(~widened(~same, (1, 1, 1)), (2, 2, 2)) & same
        at_corners[corners] = True
        if (blocks & at_corners).any() and _measured_air_has_noise(hu, value):
            parts = parts_of(blocks)
            unscanned |= parts.painted(parts.counts(at_corners) > 0)
            unscanned |= (unscanned | same).all(axis=2)[:, :, None]  # where a circle touches the image's sides
    for z in np.flatnonzero(np.ptp(hu[corners[:2]], axis=(0, 1)) == 0):
        value = hu[0, 0, z]
        if not unscanned[:, :, z].all() and (hu[:, :, z] == value).all() and _measured_air_has_noise(hu, value):
            unscanned[:, :, z] = True
    return unscanned


def _measured_air_has_noise(hu: NDArray[Any], value: Any) -> bool:
    """Whether the image shows air of other values than one, and neighbours in it differ."""
    air = (hu < NEARLY_AIR_HU) & (hu > UNSCANNED_HU) & (hu != value)
    if np.count_nonzero(air) < MEASURED_AIR * np.count_nonzero(air | (hu == value)):
        return False
    pairs = air[1:] & air[:-1]
    return bool(np.mean((hu[1:] == hu[:-1])[pairs]) < ALIKE_PAIRS) if pairs.any() else False


@dataclass(frozen=True, eq=False)
class BodyMask:
    """The solid body (nx, ny, nz): the trunk, and parts that do not touch it; and what the scanner did not measure.

    ``tables``: where the body ends as a table, cradle or board does that touches it.
    """

    body: Bools
    unscanned: Bools
    warnings: tuple[str, ...]
    tables: tuple[TableSide, ...] = ()


@dataclass(frozen=True, eq=False)
class CtImage:
    """A CT, and the body that it shows by itself."""

    hu: NDArray[Any]
    """Shape (nx, ny, nz), Hounsfield units of `measured_hu`, axes running to the left, back and head; of 16 bits where
    the file has such, else of single precision."""
    T_ct_index: Floats  # shape (4, 4), voxel index to LPS mm
    where: Path
    shown: Shown = PATIENT
    as_stored: NDArray[Any] | None = None  # as the file has them, where that differs
    not_measured: Bools | None = None  # what was not, where that is known

    @property
    def stored(self) -> NDArray[Any]:
        """Hounsfield units as the file has them."""
        return self.hu if self.as_stored is None else self.as_stored

    @property
    def spacing_mm(self) -> Floats:
        """Voxel size along each axis, shape (3,)."""
        return spacing_of(self.T_ct_index)

    @cached_property
    def found(self) -> BodyMask:
        """The body's voxels, found in the image."""
        about = self.shown.about
        at = None if about is None else np.rint(apply(np.linalg.inv(self.T_ct_index), np.array(about))).astype(int)
        return body_mask(self.hu, self.spacing_mm, where=self.where, shown=self.shown, unscanned=self.unscanned, at=at)

    @cached_property
    def unscanned(self) -> Bools:
        """Voxels that were not measured, shape of the image."""
        return find_unscanned(self.hu) if self.not_measured is None else self.not_measured

    @property
    def content(self) -> Content:
        """The ends of all that is as dense as a body."""
        return content_of(self.hu > BODY_HU, self.T_ct_index)

    def within(self, box: Box, shown: Shown = PATIENT) -> CtImage:
        """The part of it in a box, and what a person says that it shows."""
        part = tuple(slice(*ends) for ends in box)
        if self.hu[part].shape == self.hu.shape:
            return replace(self, shown=shown)
        return CtImage(self.hu[part], shifted(self.T_ct_index, box), self.where, shown, self.stored[part])


def ct_image(volume: Volume) -> CtImage:
    """A CT in Hounsfield units, whichever way its file runs."""
    oriented = canonical(volume.values, volume.T_ct_index)
    stored = in_order(oriented.values, np.int16 if np.can_cast(oriented.values.dtype, np.int16) else np.float32)
    hu, not_measured = measured_hu(stored)
    return CtImage(hu, oriented.T_ct_index, volume.path, as_stored=stored, not_measured=not_measured)


def body_mask(
    hu: NDArray[Any],
    spacing_mm: Floats,
    *,
    where: str | Path,
    shown: Shown = PATIENT,
    unscanned: Bools | None = None,
    at: Ints | None = None,
) -> BodyMask:
    """The patient, or the phantom, in a CT (nx, ny, nz), HU of `measured_hu`, axis 2 along the patient.

    Threshold, opening, largest part (or that of a voxel (3,)) without the table that touches it, and all others that
    look like a limb; then air that each encloses in an axial slice is filled, and air at the border that does not look
    like the room's.

    Raises InputError: No body, an implausibly small one, or no air around it.
    """
    voxel_ml, dense = float(np.prod(spacing_mm)) / 1000.0, hu > BODY_HU
    trunk, parts = np.zeros(hu.shape, bool), thick_parts(dense, spacing_mm, at)
    for first in itertools.islice(parts, 1):
        trunk[first.box] = largest_part(first.mask)
    if np.count_nonzero(trunk) * voxel_ml < MIN_BODY_ML:
        what = f"no body found: {np.count_nonzero(trunk) * voxel_ml:.3g} ml above {BODY_HU:g} HU are connected"
        refuse(what, where, f"a CT in Hounsfield units with at least {MIN_BODY_ML:g} ml of body", "no_body")
    tables, warnings = tuple[TableSide, ...](), list[str]()
    if shown.tables:
        cut_off, tables, said = touching_tables(hu, trunk, spacing_mm, shown, level=BODY_HU)
        warnings += said
        if cut_off.any():
            dense &= ~cut_off  # what is left of parts is still drawn from it
            trunk = largest_part(trunk & dense)
    limbs = [part for part in (parts if shown.limbs else ()) if _is_limb(part.mask, hu[part.box], spacing_mm)]
    if limbs:
        named = ", ".join(_where(limb, middle_of(trunk), voxel_ml) for limb in limbs)
        warnings.append(f"parts not connected to the trunk (arms, legs?) count as body: {named}")
    filled = filled_slices(trunk)
    for box, limb in limbs:
        filled[box] |= filled_slices(limb)
    _fill_cut_lungs(filled, hu, voxel_ml, warnings)
    if filled.all():
        refuse("no air around the body", where, f"a CT that shows skin, in air below {OUTSIDE_AIR_HU:g} HU", "no_air")
    unscanned = find_unscanned(hu) if unscanned is None else unscanned
    if unscanned.any() and (grown(filled) & unscanned & ~filled).any():
        warnings.append(UNSCANNED)
    return BodyMask(filled, unscanned, tuple(warnings), tables)


def filled_slices(mask: Bools) -> Bools:
    """The mask with every hole filled that it encloses in a slice across axis 2."""
    filled = mask.copy()
    for k in range(mask.shape[2]):
        air = parts_of(np.pad(~mask[:, :, k], 1, constant_values=True)[None])
        outside = air.painted(np.arange(len(air.sizes)) == 0)  # the part of the corner is the first
        filled[:, :, k] = ~outside[0, 1:-1, 1:-1]
    return filled


def _fill_cut_lungs(body: Bools, hu: NDArray[Any], voxel_ml: float, warnings: list[str]) -> None:
    """Fill air that is not the room's: small, or as dense as lung. Too much is safe: it makes "air" "unknown"."""
    air = parts_of(~body)
    denser, solid = air.counts(hu > OUTSIDE_AIR_HU), air.counts(hu > BODY_HU)  # a table lies in the room's air
    inside = (air.sizes * voxel_ml < MIN_OUTSIDE_ML) | (2 * (denser - solid) >= air.sizes - solid)
    if inside.any():
        body |= air.painted(inside)
        total = (air.sizes * voxel_ml)[inside].sum()
        warnings.append(f"{total:.1f} ml of air at the border of the volume count as lung or gas inside the body")


class Piece(NamedTuple):
    """A part of what a CT shows: the box of the image in which it lies, and its mask there."""

    box: tuple[slice, ...]
    mask: Bools


def thick_parts(mask: Bools, spacing_mm: Floats, at: Ints | None = None) -> Iterator[Piece]:
    """The parts of a mask (nx, ny, nz) into which a ball of ``OPENING_MM`` fits, with what lies near.

    The border counts as mask. First the one that holds a voxel (3,), or the largest; then those as large as a limb.
    """
    stride = np.maximum(1, (SAMPLING_MM / spacing_mm).astype(int))
    coarse_mm = spacing_mm * stride
    near_mm = CORNER * OPENING_MM + coarse_mm.max()
    parts = nearest_parts(mask[:: stride[0], :: stride[1], :: stride[2]], OPENING_MM, coarse_mm, near_mm)
    most_ml = np.bincount(parts.ravel()) * float(np.prod(coarse_mm)) / 1000.0
    boxes, first = scipy.ndimage.find_objects(parts), 1
    if at is not None:
        first = int(parts[tuple(np.clip(at // stride, 0, np.array(parts.shape) - 1))]) or first
    for number in sorted(range(1, len(boxes) + 1), key=lambda number: number != first):
        if number == first or most_ml[number] >= MIN_LIMB_ML:
            ends = zip(boxes[number - 1], stride, mask.shape, strict=True)
            box = tuple(slice(one.start * step, min(one.stop * step, size)) for one, step, size in ends)
            whole = parts[boxes[number - 1]] == number
            for axis in (2, 1, 0):
                whole = whole.repeat(stride[axis], axis=axis)
            yield Piece(box, mask[box] & whole[tuple(map(slice, mask[box].shape))])


def nearest_parts(mask: Bools, radius_mm: float, spacing_mm: Floats, most_mm: float = np.inf) -> Ints32:
    """Number the parts of a mask (nx, ny, nz) into which a ball fits, 1 the largest, and what lies nearest to each.

    0 elsewhere, and farther from where the ball's middle may lie than a limit. Beyond its border the mask goes on.
    """
    reach = np.ceil(radius_mm / spacing_mm).astype(int)
    padded = np.pad(mask, [(r, r) for r in reach], mode="edge")
    cores = parts_of(scipy.ndimage.distance_transform_edt(padded, sampling=spacing_mm) > radius_mm)
    if not len(cores.sizes):
        return np.zeros(mask.shape, np.int32)
    if len(cores.sizes) == 1 and np.isinf(most_mm):
        return np.ones(mask.shape, np.int32)
    numbers = cores.painted(np.argsort(np.argsort(-cores.sizes, kind="stable"), kind="stable").astype(np.int32) + 1)
    gap_mm, nearest = scipy.ndimage.distance_transform_edt(numbers == 0, sampling=spacing_mm, return_indices=True)
    parts = np.where(gap_mm <= most_mm, numbers[tuple(nearest)], 0)
    return np.asarray(parts[tuple(slice(r, -r) for r in reach)])


def _is_limb(part: Bools, hu: NDArray[Any], spacing_mm: Floats) -> bool:
    """Whether a part beside the trunk is the patient's: of soft tissue, with a bone in it.

    A bone holds together, which noise does not, and lies deeper than a table's hard cover.
    """
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    small = np.count_nonzero(part) * voxel_ml < MIN_LIMB_ML
    if small or not SOFT_TISSUE_HU[0] <= np.median(hu[part]) <= SOFT_TISSUE_HU[1]:
        return False
    cover = widened(np.pad(~part, 1, constant_values=True), np.ceil(OPENING_MM / spacing_mm).astype(int))
    bone = parts_of(~cover[1:-1, 1:-1, 1:-1] & (hu > BONE_HU))
    return bool(bone.sizes.max(initial=0) * voxel_ml >= MIN_BONE_ML)


def _where(limb: Piece, middle: Floats, voxel_ml: float) -> str:
    """Where a part lies, seen from the trunk's middle, and how much it is; axes run to the left and to the back."""
    away = middle_of(limb.mask) + [one.start for one in limb.box] - middle
    axis = int(abs(away[1]) > abs(away[0]))
    side = (("right of it", "left of it"), ("in front of it", "behind it"))[axis][int(away[axis] > 0)]
    return f"{side} ({np.count_nonzero(limb.mask) * voxel_ml:.0f} ml)"
