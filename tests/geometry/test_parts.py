"""What of a mask holds together, by runs: held against numbers in a grid."""

import numpy as np
import pytest
import scipy

from puncture_twin.planning.geometry.parts import ends_of, in_blocks, largest_part, middle_of, parts_of

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
