"""Limbs that are pressed against the trunk: one body in the CT, but no way for a needle to go from one into the other.

Between an arm and the trunk that it touches there is skin, which a CT does not show. What tells them apart is the neck:
a ball that fits into either does not fit through where they touch. Where there is no neck, because the arm is thin or
pressed flat, or lies across the trunk, it is known by its bone, and what is as near to it as the arm may be thick
belongs to it.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.detached_parts import BONE_HU, MIN_BONE_ML
from puncture_twin.planning.anatomy.body.exposed_bones import Exposed, exposed_bones
from puncture_twin.planning.anatomy.body.limb_bones import LimbBone, limb_bones
from puncture_twin.planning.base.arrays import Bools, Floats

NECK_MM = 30.0
"""Radius of a ball that fits into an adult's upper arm (35 to 50 mm) and thigh, and not through the place where an arm
is pressed against the trunk, some 50 mm wide."""
FLAT, SLACK_MM = 1.5, 5.0
"""From its bone a limb that is pressed flat reaches so many times as far as the air is away, and so much farther."""
WHOLE_FRACTION = 0.9
"""Of a bone's slices: where less of it is known by a neck, such as one end of an arm, the bone tells the rest."""
BEYOND_ENDS_MM = 50.0
"""So far beyond the end of its bone a limb goes on, to a joint and the next bone."""
SAMPLING_MM = 4.0
"""Spacing at which necks are looked for."""


def attached_limbs(hu: NDArray[np.float32], body: Bools, spacing_mm: Floats, target_index: Floats) -> Bools:
    """Voxels of the body that belong to another part than the target, with bone, joined to it by a narrow neck.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units.
        body: Same shape.
        spacing_mm: Shape (3,).
        target_index: Shape (3,), voxels, in the image.

    Returns:
        Shape of ``body``; all False where the body is one part.
    """
    stride = np.maximum(1, (SAMPLING_MM / spacing_mm).astype(int))
    coarse = body[:: stride[0], :: stride[1], :: stride[2]]
    at = tuple(np.clip(np.round(target_index / stride).astype(int), 0, np.array(coarse.shape) - 1))
    trunk = _component_at(coarse, at)
    owner = _nearest_core(trunk, spacing_mm * stride)
    voxel_ml = float(np.prod(spacing_mm)) / 1000.0
    parts = _spread(owner, stride, body.shape) * body
    limbs = np.zeros(body.shape, bool)
    for number in range(1, int(owner.max(initial=0)) + 1):
        if number != owner[at]:
            part = parts == number
            if np.count_nonzero(hu[part] > BONE_HU) * voxel_ml >= MIN_BONE_ML:
                limbs |= part
    component = _component_at(body, tuple(np.clip(np.round(target_index).astype(int), 0, np.array(body.shape) - 1)))
    for bone in limb_bones(hu, component, spacing_mm):
        if not _is_whole(limbs, bone) and not _about(bone, target_index, spacing_mm):
            limbs |= _surroundings(bone, body.shape, spacing_mm) & component
    across = _across(_blocks(component & (hu > BONE_HU), stride), trunk, spacing_mm * stride, at)
    return limbs | ((_spread(across.astype(np.int32), stride, body.shape) > 0) & component)


def _across(bone: Bools, component: Bools, spacing_mm: Floats, at: tuple[int, ...]) -> Bools:
    """Voxels of limbs that lie across the part that holds a voxel, known by air on many sides of their bones."""
    across = np.zeros(component.shape, bool)
    for limb in exposed_bones(bone, component, spacing_mm):
        about = _about_exposed(limb, component.shape, spacing_mm)
        if not about.own[at]:
            across |= about.reach
    return across


class _About(NamedTuple):
    """What lies about the bones of one limb: nearer to them than they to the air, and as far as the limb may reach."""

    own: Bools
    reach: Bools


def _about_exposed(limb: Exposed, shape: tuple[int, ...], spacing_mm: Floats) -> _About:
    """What may belong to the limb about some bones, also some way beyond their ends."""
    depth = np.full(shape, -1.0)
    depth[tuple(limb.voxels.T)] = limb.depth_mm
    gap, nearest = scipy.ndimage.distance_transform_edt(depth < 0.0, sampling=spacing_mm, return_indices=True)
    radius = depth[tuple(nearest)]
    reach = gap <= FLAT * radius + SLACK_MM
    points = limb.voxels * spacing_mm
    along = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0] / spacing_mm
    steps = np.arange(-BEYOND_ENDS_MM, BEYOND_ENDS_MM + 1e-9, 0.5 * float(spacing_mm.min()))
    beyond = np.zeros(shape, bool)
    for shift in np.unique(np.rint(steps[:, None] * along).astype(int), axis=0):
        beyond |= _shifted(reach, shift)
    return _About(gap < radius, beyond)


def _shifted(mask: Bools, by: NDArray[np.int_]) -> Bools:
    """The mask moved by whole voxels; False comes in."""
    moved = np.zeros_like(mask)
    into = tuple(slice(max(0, k), n + min(0, k)) for k, n in zip(by, mask.shape, strict=True))
    out_of = tuple(slice(max(0, -k), n + min(0, -k)) for k, n in zip(by, mask.shape, strict=True))
    moved[into] = mask[out_of]
    return moved


def _blocks(mask: Bools, stride: NDArray[np.int_]) -> Bools:
    """A mask sampled: True where an eighth of a block is, which noise is not."""
    fraction = mask.astype(np.float32)
    for axis, times in enumerate(stride):
        fraction = np.add.reduceat(fraction, np.arange(0, mask.shape[axis], times), axis=axis)
    return np.asarray(fraction >= np.prod(stride) / 8.0)


def _is_whole(limbs: Bools, bone: LimbBone) -> bool:
    """Whether a bone lies in limbs that are known by their necks, in all slices but a few at its ends."""
    x, y = np.round(bone.middle).astype(int).T
    return bool(limbs[x, y, bone.slices].mean() > WHOLE_FRACTION)


def _about(bone: LimbBone, at: Floats, spacing_mm: Floats) -> bool:
    """Whether a point (3,), voxels, lies in the limb about a bone."""
    nearest = bone.middle[np.argmin(np.abs(bone.slices - at[2]))]
    return bool(np.linalg.norm((at[:2] - nearest) * spacing_mm[:2]) < bone.radius_mm)


def _surroundings(bone: LimbBone, shape: tuple[int, ...], spacing_mm: Floats) -> Bools:
    """Voxels about a bone that may belong to its limb, also some way beyond its ends."""
    reach_mm, beyond = FLAT * bone.radius_mm + SLACK_MM, int(BEYOND_ENDS_MM / spacing_mm[2])
    x, y = np.ogrid[: shape[0], : shape[1]]
    about = np.zeros(shape, bool)
    for k in range(max(0, bone.slices[0] - beyond), min(shape[2], bone.slices[-1] + beyond + 1)):
        middle = bone.middle[np.argmin(np.abs(bone.slices - k))]
        across_mm = np.hypot((x - middle[0]) * spacing_mm[0], (y - middle[1]) * spacing_mm[1])
        about[:, :, k] = across_mm <= reach_mm
    return about


def _component_at(body: Bools, at: tuple[int, ...]) -> Bools:
    """The connected part of the body that holds a voxel; the others are limbs with a skin of their own."""
    labels, _ = scipy.ndimage.label(body)
    return np.asarray(labels == labels[at]) & body


def _nearest_core(body: Bools, spacing_mm: Floats) -> NDArray[np.int32]:
    """For every voxel of a body, the number of the nearest place into which the ball fits; 0 outside."""
    reach = np.ceil(NECK_MM / spacing_mm).astype(int)
    padded = np.pad(body, [(r, r) for r in reach], mode="edge")
    cores, count = scipy.ndimage.label(scipy.ndimage.distance_transform_edt(padded, sampling=spacing_mm) > NECK_MM)
    if count < 2:
        return body.astype(np.int32)
    nearest = scipy.ndimage.distance_transform_edt(
        cores == 0, sampling=spacing_mm, return_distances=False, return_indices=True
    )
    owner = cores[tuple(nearest)][tuple(slice(r, -r) for r in reach)]
    return np.asarray(np.where(body, owner, 0), dtype=np.int32)


def _spread(owner: NDArray[np.int32], stride: NDArray[np.int_], shape: tuple[int, ...]) -> NDArray[np.int32]:
    """A sampled array at the full image's voxels."""
    for axis, times in enumerate(stride):
        owner = np.repeat(owner, times, axis=axis)
    return owner[tuple(slice(0, n) for n in shape)]
