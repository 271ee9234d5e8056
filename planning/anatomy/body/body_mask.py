"""Which voxels of a CT are the patient: trunk and limbs without table and sheets, solid, lungs and gas included."""

from __future__ import annotations

import itertools
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.cut_ends import Box, Content, content_of, shifted, spacing_of
from puncture_twin.planning.anatomy.body.detached_parts import detached_limbs, limb_warnings, thick_parts
from puncture_twin.planning.anatomy.body.tables import PATIENT, Shown, TableSide, touching_tables
from puncture_twin.planning.anatomy.body.unscanned import Unscanned, find_unscanned, measured_hu
from puncture_twin.planning.base.arrays import Bools, Floats, grown
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.orientation import canonical
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.parts import largest_part, parts_of

BODY_HU = -500.0
"""Half way between air (-1000) and water (0): where a voxel is half skin, half air."""
OUTSIDE_AIR_HU = -940.0
"""Ambient air has -1000, inflated lung rarely less than -920: an air region that the border cuts is the room only
if its median is below this."""
MIN_OUTSIDE_ML = 50.0
"""A smaller air region at the border may be bowel gas that the field of view cuts."""
MIN_BODY_ML = 100.0
"""Less than a tenth of a newborn's head: something else was found."""
PADDED = (
    "where nothing was scanned the image is filled up with one value, and that cuts the body; no skin is known there, "
    "no body that the arm could meet, and what is filled up is unknown_region (outside_body)"
)
CIRCLE = (
    "the scanner's field of view (a circle in the image) cuts the body; no skin is known there, "
    "and no body that the arm could meet"
)


@dataclass(frozen=True, eq=False)
class BodyMask:
    """What was found.

    Attributes:
        body: Shape (nx, ny, nz), the solid body: the trunk, and parts of the patient that do not touch it.
        unscanned: Same shape, voxels that the scanner did not measure.
        warnings: What the user should know.
        tables: Where the body ends as a table, cradle or board does that touches it.
    """

    body: Bools
    unscanned: Bools
    warnings: tuple[str, ...]
    tables: tuple[TableSide, ...] = ()


@dataclass(frozen=True, eq=False)
class CtImage:
    """A CT, and the body that it shows by itself.

    Attributes:
        hu: Shape (nx, ny, nz), Hounsfield units of `measured_hu`, axes running to the left, back and head.
        T_ct_index: Shape (4, 4), voxel index to LPS mm.
        where: The file.
        shown: What a person says that it shows.
        as_stored: Shape of ``hu``, as the file has them, where that differs.
    """

    hu: NDArray[np.float32]
    T_ct_index: Floats
    where: Path
    shown: Shown = PATIENT
    as_stored: NDArray[np.float32] | None = None

    @property
    def stored(self) -> NDArray[np.float32]:
        """Hounsfield units as the file has them."""
        return self.hu if self.as_stored is None else self.as_stored

    @property
    def spacing_mm(self) -> Floats:
        """Voxel size along each axis, shape (3,)."""
        return spacing_of(self.T_ct_index)

    @cached_property
    def found(self) -> BodyMask:
        """The body.

        Raises:
            InputError: See `body_mask`.
        """
        return body_mask(self.hu, self.spacing_mm, where=self.where, shown=self.shown, measured=self.unscanned)

    @cached_property
    def unscanned(self) -> Unscanned:
        """What was not measured."""
        return find_unscanned(self.hu)

    @property
    def content(self) -> Content:
        """Where what is as dense as a body ends."""
        return content_of(self.hu > BODY_HU, self.T_ct_index)

    def within(self, box: Box, shown: Shown = PATIENT) -> CtImage:
        """The part of it in a box, and what a person says that it shows."""
        part = tuple(slice(*ends) for ends in box)
        T_ct_index = shifted(self.T_ct_index, box)
        return CtImage(self.hu[part], T_ct_index, self.where, shown, self.stored[part])


def ct_image(volume: Volume) -> CtImage:
    """A CT in Hounsfield units, whichever way its file runs."""
    oriented = canonical(volume.values, volume.T_ct_index)
    stored = oriented.values.astype(np.float32, order="C")  # every mask that is made of it runs so too
    return CtImage(measured_hu(stored), oriented.T_ct_index, volume.path, as_stored=stored)


def body_mask(
    hu: NDArray[np.float32],
    spacing_mm: NDArray[np.float64],
    *,
    where: str | Path,
    shown: Shown = PATIENT,
    measured: Unscanned | None = None,
) -> BodyMask:
    """Finds the patient, or the phantom, in a CT.

    Threshold, opening, largest component without the table that touches it, and every other component that looks like a
    limb; then air that each of them encloses in an axial slice is filled, and so is air at the border of the volume
    that does not look like the room's. Filling too much is the safe side: it turns "air" at the border into "unknown".

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the patient; of `measured_hu`.
        spacing_mm: Shape (3,).
        where: For messages.
        shown: What a person says of the image.
        measured: What was not, where that is known.

    Raises:
        InputError: No body, an implausibly small one, or no air around it.
    """
    body, tables, warnings = _found(hu, spacing_mm, where, shown)
    unscanned, padded = measured or find_unscanned(hu)
    if unscanned.any():
        ends = grown(body) & unscanned & ~body
        if (ends & padded).any():
            warnings.append(PADDED)
        if (ends & ~padded).any():
            warnings.append(CIRCLE)
    return BodyMask(body, unscanned, tuple(warnings), tables)


def _found(
    hu: NDArray[np.float32], spacing_mm: Floats, where: str | Path, shown: Shown
) -> tuple[Bools, tuple[TableSide, ...], list[str]]:
    """The body with all that was filled, the tables that touch it, and what the user should know."""
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    dense = hu > BODY_HU
    trunk, parts = np.zeros(hu.shape, bool), thick_parts(dense, spacing_mm)
    for first in itertools.islice(parts, 1):
        trunk[first.box] = largest_part(first.mask)
    if np.count_nonzero(trunk) * voxel_ml < MIN_BODY_ML:
        what = f"no body found: {np.count_nonzero(trunk) * voxel_ml:.3g} ml above {BODY_HU:g} HU hold together"
        allowed = f"a CT in Hounsfield units with at least {MIN_BODY_ML:g} ml of body"
        raise InputError(what, where=where, allowed=allowed)
    warnings: list[str] = []
    tables: tuple[TableSide, ...] = ()
    if shown.tables:
        touching = touching_tables(hu, trunk, spacing_mm, shown, level=BODY_HU)
        tables, warnings = touching.sides, list(touching.warnings)
        if touching.cut_off.any():
            dense &= ~touching.cut_off  # what is left of parts is still drawn from it
            trunk = largest_part(trunk & dense)
    limbs = detached_limbs(hu, parts if shown.limbs else (), spacing_mm)
    warnings += limb_warnings(limbs, trunk, voxel_ml)
    filled = filled_slices(trunk)
    for box, limb in limbs:
        filled[box] |= filled_slices(limb)
    _fill_cut_lungs(filled, hu, voxel_ml, warnings)
    if filled.all():
        raise InputError("no air around the body", where=where, allowed="a CT that shows the skin somewhere")
    return filled, tables, warnings


def filled_slices(mask: Bools) -> Bools:
    """The mask with every hole filled that it encloses in a slice across axis 2: what no way within it leads out of."""
    air = np.packbits(~mask, axis=2)  # eight slices at a time
    outside = np.zeros_like(air)
    ways = [(outside.swapaxes(0, axis)[::step], air.swapaxes(0, axis)[::step]) for axis in (0, 1) for step in (1, -1)]
    for reached, free in ways:
        reached[0] = free[0]
    before = None
    while before is None or not np.array_equal(before, outside):
        before = outside.copy()
        for reached, free in ways:
            for k in range(1, len(free)):
                reached[k] |= reached[k - 1] & free[k]
    return ~np.unpackbits(outside, axis=2, count=mask.shape[2]).view(bool)


def _fill_cut_lungs(body: Bools, hu: NDArray[np.float32], voxel_ml: float, warnings: list[str]) -> None:
    """Fills air regions that are not the room: small ones, and those with the density of lung."""
    air = parts_of(~body)
    denser = air.counts(hu > OUTSIDE_AIR_HU)
    inside = (air.sizes * voxel_ml < MIN_OUTSIDE_ML) | (2 * denser > air.sizes)
    numbers = np.arange(len(inside))
    for number in np.flatnonzero(~inside & (2 * denser == air.sizes)):  # the median lies between two values
        inside[number] = np.median(hu[air.painted(numbers == number)]) > OUTSIDE_AIR_HU
    if inside.any():
        body |= air.painted(inside)
        total = (air.sizes * voxel_ml)[inside].sum()
        warnings.append(f"{total:.1f} ml of air at the border of the volume were taken as lung or gas inside the body")
