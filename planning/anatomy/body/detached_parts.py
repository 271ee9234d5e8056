"""What a CT shows that is thick enough for a part of a patient, and which of it is one: arms and legs beside the trunk.

A limb that does not touch the trunk is of soft tissue and holds bone, or changes its section along the bed. A table
does neither: it is one section, drawn along the bed. What is taken for neither stays outside of the body, where
nothing dense counts as air (`puncture_twin.planning.anatomy.body.outside_body`).
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints32
from puncture_twin.planning.geometry.parts import middle_of, parts_of

OPENING_MM = 6.0
"""Parts thinner than twice this are no trunk, head or limb: table tops, sheets, tubes."""
CORNER = 3.0**0.5
"""So many times as far from where the ball fits a box's corner lies: it belongs to the box."""
SAMPLING_MM = 3.0
"""Spacing at which the opening is done: half its radius."""
MIN_LIMB_ML = 20.0
"""Smaller than a newborn's forearm (some 25 ml): hands of adults, cushions and lines are left to the outside."""
SOFT_TISSUE_HU = (-150.0, 150.0)
"""Fat at -100, muscle at 50, both with noise: the median of a limb lies between. Foam, wood and metal do not."""
BONE_HU = 200.0
"""Above soft tissue with contrast in its vessels; cortical bone has 500 and more."""
MIN_BONE_ML = 1.0
"""Some 10 mm of an adult's radius."""
ALIKE = 0.9
"""Overlap (intersection over union) of sections with the median one, from which on a part is one section drawn along
the bed."""


class Piece(NamedTuple):
    """A part of what a CT shows.

    Attributes:
        box: Of the image, in which it lies.
        mask: Shape of the box.
    """

    box: tuple[slice, ...]
    mask: Bools


def thick_parts(mask: Bools, spacing_mm: Floats) -> Iterator[Piece]:
    """The parts of a mask into which a ball of ``OPENING_MM`` fits, with what lies near each, the largest first.

    The border counts as mask. Fine images are sampled: where a table ends and an arm begins is a coarse question. Of
    others than the first only those that may be as large as a limb.

    Args:
        mask: Shape (nx, ny, nz).
        spacing_mm: Shape (3,).
    """
    stride = np.maximum(1, (SAMPLING_MM / spacing_mm).astype(int))
    parts = _coarse_parts(mask[:: stride[0], :: stride[1], :: stride[2]], spacing_mm * stride)
    most_ml = np.bincount(parts.ravel()) * float(np.prod(stride * spacing_mm)) / 1000.0
    for number, coarse in enumerate(scipy.ndimage.find_objects(parts), start=1):
        if number > 1 and most_ml[number] < MIN_LIMB_ML:
            continue
        ends = zip(coarse, stride, mask.shape, strict=True)
        box = tuple(slice(one.start * step, min(one.stop * step, size)) for one, step, size in ends)
        whole = parts[coarse] == number
        for axis in (2, 1, 0):
            whole = whole.repeat(stride[axis], axis=axis)
        inside = mask[box]
        yield Piece(box, inside & whole[tuple(map(slice, inside.shape))])


def _coarse_parts(mask: Bools, spacing_mm: Floats) -> Ints32:
    """Number the parts into which the ball fits, 1 the largest, and what lies near each; 0 elsewhere."""
    reach = np.ceil(OPENING_MM / spacing_mm).astype(int)
    cores = parts_of(_eroded(np.pad(mask, [(r, r) for r in reach], mode="edge"), spacing_mm))
    rank = np.argsort(np.argsort(-cores.sizes, kind="stable"), kind="stable").astype(np.int32)
    numbers = cores.painted(rank + 1)
    if not len(rank):
        return np.zeros(mask.shape, np.int32)
    nearest = scipy.ndimage.distance_transform_edt(
        numbers == 0, sampling=spacing_mm, return_distances=False, return_indices=True
    )
    gap = np.zeros(numbers.shape, np.float32)
    for axis, at in enumerate(nearest):
        along = np.moveaxis(at, axis, -1) - np.arange(numbers.shape[axis], dtype=np.int32)
        gap += np.moveaxis(np.square(along * np.float32(spacing_mm[axis])), -1, axis)
    parts = np.where(gap <= (CORNER * OPENING_MM + spacing_mm.max()) ** 2, numbers[tuple(nearest)], 0)
    return np.asarray(parts[tuple(slice(r, -r) for r in reach)])


def _eroded(mask: Bools, spacing_mm: Floats) -> Bools:
    """Where the ball fits."""
    fits, size = mask.copy(), mask.shape
    reach = np.floor(OPENING_MM / spacing_mm).astype(int)
    for by in itertools.product(*(range(-r, r + 1) for r in reach)):
        if np.linalg.norm(by * spacing_mm) <= OPENING_MM:
            into = tuple(slice(max(0, -k), n - max(0, k)) for k, n in zip(by, size, strict=True))
            out_of = tuple(slice(max(0, k), n - max(0, -k)) for k, n in zip(by, size, strict=True))
            fits[into] &= mask[out_of]
    return fits


def detached_limbs(hu: NDArray[np.float32], parts: Iterable[Piece], spacing_mm: Floats) -> tuple[Piece, ...]:
    """Those of some parts beside the trunk that are of the patient.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the bed.
        parts: As `thick_parts` finds them.
        spacing_mm: Shape (3,).
    """
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    limbs = []
    for part in parts:
        values = hu[part.box][part.mask]
        if len(values) * voxel_ml < MIN_LIMB_ML:
            continue
        low, high = SOFT_TISSUE_HU
        soft = low <= float(np.median(values)) <= high
        bone_ml = np.count_nonzero(values > BONE_HU) * voxel_ml
        if soft and (bone_ml >= MIN_BONE_ML or not _one_section(part.mask, hu.shape[2])):
            limbs.append(part)
    return tuple(limbs)


def limb_warnings(limbs: Sequence[Piece], trunk: Bools, voxel_ml: float) -> Iterator[str]:
    """One sentence that names every detached part, where there is one."""
    if limbs:
        middle = middle_of(trunk)
        named = [f"{_side(limb, middle)} ({np.count_nonzero(limb.mask) * voxel_ml:.0f} ml)" for limb in limbs]
        yield f"parts that do not touch the trunk (arms, legs?) count as body: {', '.join(named)}"


def _side(limb: Piece, middle: Floats) -> str:
    """Where a part lies, seen from the trunk; axes run to the left and to the back."""
    away = middle_of(limb.mask) + [one.start for one in limb.box] - middle
    if abs(away[0]) >= abs(away[1]):
        return "left of it" if away[0] > 0 else "right of it"
    return "behind it" if away[1] > 0 else "in front of it"


def _one_section(part: Bools, slices: int) -> bool:
    """Whether the part is the same in nearly every slice of the image, as a table is."""
    present = part.any(axis=(0, 1))
    if np.count_nonzero(present) < ALIKE * slices:
        return False
    section = part[:, :, present].mean(axis=2) > 0.5
    both = (part & section[:, :, None]).sum(axis=(0, 1))
    either = (part | section[:, :, None]).sum(axis=(0, 1))
    alike = np.zeros(slices)
    alike[: len(both)] = both / np.maximum(either, 1)
    return bool(np.mean(alike) > ALIKE)
