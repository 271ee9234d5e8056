"""Which voxels lie inside a surface, and what of a mask holds together: held against numbers in a grid."""

from pathlib import Path

import numpy as np
import pytest
import scipy

from puncture_twin.planning.formats.labels.labelmaps import frame, framed_surface, mask_surface
from puncture_twin.planning.geometry.parts import (
    ends_of,
    in_blocks,
    largest_part,
    mark_inside,
    middle_of,
    parts_of,
    voxels_inside,
)

MASKS = [
    np.random.default_rng(seed).random(shape) < dense
    for seed, (shape, dense) in enumerate(
        [((9, 8, 17), 0.3), ((9, 8, 17), 0.6), ((1, 5, 9), 0.5), ((6, 1, 1), 0.5), ((4, 4, 4), 0.0), ((4, 4, 4), 1.1)]
    )
]


@pytest.mark.parametrize("corners", [False, True])
@pytest.mark.parametrize("mask", [*MASKS, MASKS[0][::-1, :, ::-1], np.asfortranarray(MASKS[0] & MASKS[1])])
def test_parts_are_those_that_share_faces_or_corners(mask, corners):
    """The same as by numbering every voxel; sizes and counts are theirs."""
    labels, count = scipy.ndimage.label(mask, np.ones((3, 3, 3)) if corners else None)
    other = np.random.default_rng(9).random(mask.shape) < 0.5
    parts = parts_of(mask, corners=corners)
    numbers = parts.painted(np.arange(1, len(parts.sizes) + 1, dtype=np.int32))
    assert len(parts.sizes) == count
    assert len(np.unique(np.stack([labels, numbers]).reshape(2, -1), axis=1).T) == len(np.unique(labels))
    assert np.array_equal(numbers > 0, mask)
    assert np.array_equal(parts.sizes, np.bincount(numbers.ravel(), minlength=count + 1)[1:])
    assert np.array_equal(parts.counts(other), np.bincount(numbers[other], minlength=count + 1)[1:])
    assert corners or np.count_nonzero(largest_part(mask)) == parts.sizes.max(initial=0)


@pytest.mark.parametrize("mask", MASKS[:4])
def test_ends_and_middle(mask):
    for axis, (first, last) in enumerate((ends_of(mask)[:2], ends_of(mask)[2:])):
        none = ~mask.any(axis=axis)
        assert np.array_equal(first, np.where(none, -1, mask.argmax(axis=axis)))
        assert np.array_equal(last, np.where(none, -1, mask.shape[axis] - 1 - np.flip(mask, axis).argmax(axis=axis)))
    assert np.allclose(middle_of(mask), np.argwhere(mask).mean(axis=0))


@pytest.mark.parametrize("mask", MASKS)
@pytest.mark.parametrize("edge", [(1, 1, 1), (2, 3, 4), (5, 1, 2)])
def test_blocks_hold_what_their_voxels_are(mask, edge):
    pads = [(0, -n % size) for n, size in zip(mask.shape, edge, strict=True)]
    whole = np.pad(mask, pads)
    a, b, c = (n // size for n, size in zip(whole.shape, edge, strict=True))
    plain = whole.reshape(a, edge[0], b, edge[1], c, edge[2]).sum(axis=(1, 3, 5))
    assert np.array_equal(in_blocks(mask, np.array(edge)), plain)


WHERE = Path("made")
T_CT_INDEX = np.array([[0.8, 0.0, 0.0, -31.0], [0.0, 1.1, 0.0, 12.0], [0.0, 0.0, 2.5, -7.0], [0.0, 0.0, 0.0, 1.0]])


@pytest.fixture
def blobs(rng):
    smooth = scipy.ndimage.gaussian_filter(rng.normal(size=(30, 26, 22)), 2.0)
    return smooth > np.quantile(smooth, 0.8)


def test_the_voxels_inside_a_masks_surface_are_the_mask(blobs):
    """What is found in the surface's box is all that there is; in a part of the grid it is that part."""
    mesh = mask_surface(blobs, T_CT_INDEX, where=WHERE)
    assert np.array_equal(voxels_inside(mesh, T_CT_INDEX, blobs.shape), blobs)
    T = T_CT_INDEX.copy()
    T[:3, 3] += T[:3, :3] @ [9, 4, 3]
    assert np.array_equal(voxels_inside(mesh, T, (12, 11, 10)), blobs[9:21, 4:15, 3:13])
    T[:3, 3] += T[:3, :3] @ [100, 0, 0]
    assert not voxels_inside(mesh, T, (12, 11, 10)).any()


def test_what_is_marked_stays_beside_what_was(blobs, rng):
    mask = rng.random(blobs.shape) < 0.1
    before = mask.copy()
    mark_inside(mask_surface(blobs, T_CT_INDEX, where=WHERE), T_CT_INDEX, mask)
    assert np.array_equal(mask, before | blobs)


def test_a_masks_surface_is_that_of_its_field(blobs):
    blobs[:5], blobs[:, :, -4:] = False, False
    boxed = mask_surface(blobs, T_CT_INDEX, where=WHERE)
    framed, field = frame(blobs.shape)
    framed[:], field[:] = np.nan, blobs - 0.5  # the frame is written, whatever it held
    assert boxed.digest == framed_surface(framed, T_CT_INDEX, where=WHERE).digest
    assert np.array_equal(framed, np.pad(blobs - 0.5, 1, constant_values=-0.5))
