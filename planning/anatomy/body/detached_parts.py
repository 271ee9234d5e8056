"""What a CT shows that is thick enough for a part of a patient, and which of it is one: arms and legs beside the trunk.

A limb that does not touch the trunk is of soft tissue and holds bone, or changes its section along the bed. A table
does neither: it is one section, drawn along the bed. What is taken for neither stays outside of the body, where
nothing dense counts as air (`puncture_twin.planning.anatomy.body.outside_body`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Bools, Floats, Ints32, counts_of

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


def thick_parts(mask: Bools, spacing_mm: Floats) -> Ints32:
    """Number the parts of a mask into which a ball of ``OPENING_MM`` fits, with what lies near each.

    The border counts as mask. Fine images are sampled: where a table ends and an arm begins is a coarse question.

    Args:
        mask: Shape (nx, ny, nz).
        spacing_mm: Shape (3,).

    Returns:
        Shape of ``mask``: 0 outside and in thin parts, 1 in the largest part, 2 in the next, and so on.
    """
    stride = np.maximum(1, (SAMPLING_MM / spacing_mm).astype(int))
    coarse = mask[:: stride[0], :: stride[1], :: stride[2]]
    coarse_mm = spacing_mm * stride
    reach = np.ceil(OPENING_MM / coarse_mm).astype(int)
    padded = np.pad(coarse, [(r, r) for r in reach], mode="edge")
    cores = _by_size(scipy.ndimage.distance_transform_edt(padded, sampling=coarse_mm) > OPENING_MM)
    if not cores.any():
        return np.zeros(mask.shape, np.int32)
    gap, nearest = scipy.ndimage.distance_transform_edt(cores == 0, sampling=coarse_mm, return_indices=True)
    parts = np.where(gap <= CORNER * OPENING_MM + coarse_mm.max(), cores[tuple(nearest)], 0)
    parts = parts[tuple(slice(r, -r) for r in reach)]
    whole = np.zeros(mask.shape, np.int32)
    for i, plane in enumerate(whole):
        spread = parts[i // stride[0]].repeat(stride[1], axis=0).repeat(stride[2], axis=1)
        np.multiply(spread[: mask.shape[1], : mask.shape[2]], mask[i], out=plane)
    return whole


def largest_component(mask: Bools) -> Bools:
    """The largest part of a mask whose voxels share faces; the mask itself where it is empty."""
    labels, count = scipy.ndimage.label(mask)
    if count == 0:
        return mask
    return np.asarray(labels == 1 + int(np.argmax(counts_of(labels, count)[1:])))


def detached_limbs(hu: NDArray[np.float32], parts: Ints32, spacing_mm: Floats) -> tuple[Bools, ...]:
    """The parts, beside the first, that are of the patient.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units, axis 2 along the bed.
        parts: Same shape, as `thick_parts` numbers them.
        spacing_mm: Shape (3,).

    Returns:
        A mask for each.
    """
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    sizes = counts_of(parts, int(parts.max())) * voxel_ml
    limbs = []
    for number in np.flatnonzero(sizes >= MIN_LIMB_ML):
        if number < 2:
            continue
        part = parts == number
        low, high = SOFT_TISSUE_HU
        soft = low <= float(np.median(hu[part])) <= high
        bone_ml = np.count_nonzero(hu[part] > BONE_HU) * voxel_ml
        if soft and (bone_ml >= MIN_BONE_ML or not _one_section(part)):
            limbs.append(part)
    return tuple(limbs)


def limb_warnings(limbs: Sequence[Bools], trunk: Bools, voxel_ml: float) -> Iterator[str]:
    """One sentence that names every detached part, where there is one."""
    if limbs:
        middle = scipy.ndimage.center_of_mass(trunk)
        named = [f"{_side(limb, middle)} ({np.count_nonzero(limb) * voxel_ml:.0f} ml)" for limb in limbs]
        yield f"parts that do not touch the trunk (arms, legs?) count as body: {', '.join(named)}"


def _side(limb: Bools, middle: Sequence[float]) -> str:
    """Where a part lies, seen from the trunk; axes run to the left and to the back."""
    away = np.array(scipy.ndimage.center_of_mass(limb)) - np.array(middle)
    if abs(away[0]) >= abs(away[1]):
        return "left of it" if away[0] > 0 else "right of it"
    return "behind it" if away[1] > 0 else "in front of it"


def _by_size(mask: Bools) -> Ints32:
    """Components of a mask, 1 the largest; 0 elsewhere."""
    labels, count = scipy.ndimage.label(mask)
    sizes = np.bincount(labels.ravel(), minlength=count + 1)
    sizes[0] = 0
    rank = np.zeros(count + 1, np.int32)
    rank[np.argsort(-sizes, kind="stable")[:count]] = np.arange(1, count + 1)
    return rank[labels]


def _one_section(part: Bools) -> bool:
    """Whether the part is the same in nearly every slice of the image, as a table is."""
    present = part.any(axis=(0, 1))
    if present.mean() < ALIKE:
        return False
    section = part[:, :, present].mean(axis=2) > 0.5
    both = (part & section[:, :, None]).sum(axis=(0, 1))
    either = (part | section[:, :, None]).sum(axis=(0, 1))
    return bool(np.mean(both / np.maximum(either, 1)) > ALIKE)
