"""Which voxels of a CT are the patient: trunk and limbs without table and sheets, solid, lungs and gas included."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.cut_ends import Box, Content, content_of, shifted, spacing_of
from puncture_twin.planning.anatomy.body.detached_parts import (
    detached_limbs,
    largest_component,
    limb_warnings,
    thick_parts,
)
from puncture_twin.planning.anatomy.body.tables import PATIENT, Shown, TableSide, touching_tables
from puncture_twin.planning.anatomy.body.unscanned import find_unscanned, measured_hu
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.orientation import canonical
from puncture_twin.planning.formats.volumes.volume_files import Volume

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
    """

    hu: NDArray[np.float32]
    T_ct_index: Floats
    where: Path
    shown: Shown = PATIENT

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
        return body_mask(self.hu, self.spacing_mm, where=self.where, shown=self.shown)

    @property
    def content(self) -> Content:
        """Where what is as dense as a body ends."""
        return content_of(self.hu > BODY_HU, self.T_ct_index)

    def within(self, box: Box, shown: Shown = PATIENT) -> CtImage:
        """The part of it in a box, and what a person says that it shows."""
        part = self.hu[tuple(slice(*ends) for ends in box)]
        return CtImage(part, shifted(self.T_ct_index, box), self.where, shown)


def ct_image(volume: Volume) -> CtImage:
    """A CT in Hounsfield units, whichever way its file runs."""
    oriented = canonical(volume.values, volume.T_ct_index)
    return CtImage(measured_hu(oriented.values.astype(np.float32)), oriented.T_ct_index, volume.path)


def body_mask(
    hu: NDArray[np.float32], spacing_mm: NDArray[np.float64], *, where: str | Path, shown: Shown = PATIENT
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

    Raises:
        InputError: No body, an implausibly small one, or no air around it.
    """
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    solids = thick_parts(hu > BODY_HU, spacing_mm)
    trunk = largest_component(solids == 1)
    if np.count_nonzero(trunk) * voxel_ml < MIN_BODY_ML:
        what = f"no body found: {np.count_nonzero(trunk) * voxel_ml:.3g} ml above {BODY_HU:g} HU hold together"
        raise InputError(
            what, where=where, allowed=f"a CT in Hounsfield units with at least {MIN_BODY_ML:g} ml of body"
        )
    warnings: list[str] = []
    tables: tuple[TableSide, ...] = ()
    if shown.tables:
        touching = touching_tables(hu - BODY_HU, trunk, spacing_mm, shown)
        tables, warnings = touching.sides, list(touching.warnings)
        if touching.cut_off.any():
            solids = np.where(touching.cut_off, 0, solids)
            trunk = largest_component(trunk & ~touching.cut_off)
    limbs = detached_limbs(hu, solids, spacing_mm) if shown.limbs else ()
    warnings += limb_warnings(limbs, trunk, voxel_ml)
    filled = filled_slices(trunk)
    for limb in limbs:
        filled |= filled_slices(limb)
    body = _with_cut_lungs(filled, hu, voxel_ml, warnings)
    if body.all():
        raise InputError("no air around the body", where=where, allowed="a CT that shows the skin somewhere")
    unscanned, padded = find_unscanned(hu)
    ends = scipy.ndimage.binary_dilation(body) & unscanned & ~body
    if (ends & padded).any():
        warnings.append(PADDED)
    if (ends & ~padded).any():
        warnings.append(CIRCLE)
    return BodyMask(body, unscanned, tuple(warnings), tables)


def filled_slices(mask: Bools) -> Bools:
    """The mask with every hole filled that it encloses in a slice across axis 2."""
    return np.stack([scipy.ndimage.binary_fill_holes(mask[:, :, k]) for k in range(mask.shape[2])], axis=2)


def _with_cut_lungs(body: Bools, hu: NDArray[np.float32], voxel_ml: float, warnings: list[str]) -> Bools:
    """Fills air regions that are not the room: small ones, and those with the density of lung."""
    labels, count = scipy.ndimage.label(~body)
    if count == 0:
        return body
    numbers = np.arange(1, count + 1)
    sizes_ml = np.bincount(labels.ravel())[1:] * voxel_ml
    medians = np.asarray(scipy.ndimage.median(hu, labels, numbers))
    inside = (sizes_ml < MIN_OUTSIDE_ML) | (medians > OUTSIDE_AIR_HU)
    if inside.any():
        total = sizes_ml[inside].sum()
        warnings.append(f"{total:.1f} ml of air at the border of the volume were taken as lung or gas inside the body")
    return np.asarray(body | np.isin(labels, numbers[inside]))
