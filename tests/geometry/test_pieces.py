"""Pieces by runs are those that scipy finds voxel by voxel."""

import numpy as np
import pytest
import scipy

from puncture_twin.planning.geometry.pieces import pieces

FULL = np.ones((3, 3, 3), bool)


@pytest.mark.parametrize("corners", [True, False])
@pytest.mark.parametrize("density", [0.02, 0.15, 0.4, 0.7, 0.97])
def test_numbered_sized_and_filled_as_by_scipy(density, corners):
    """Of random masks, also thin ones and one that is turned in memory: same numbers, sizes, counts, voxels."""
    rng = np.random.default_rng(3)
    for shape in ((1, 1, 40), (1, 30, 1), (9, 1, 11), (14, 11, 9), (5, 23, 17)):
        mask, other = rng.random(shape) < density, rng.random(shape) < 0.5
        for one in (mask, np.asfortranarray(mask), mask[::-1, :, ::-1]):
            labels, count = scipy.ndimage.label(one, FULL if corners else None)
            found = pieces(one, corners=corners)
            assert found.count == count
            assert np.array_equal(found.sizes(), np.bincount(labels.ravel(), minlength=count + 1)[1:])
            assert np.array_equal(found.sizes(other), np.bincount(labels[other], minlength=count + 1)[1:])
            for number in range(min(count, 5)):
                assert np.array_equal(found.mask(np.arange(count) == number), labels == number + 1)
            assert np.array_equal(found.mask(np.ones(count, bool)), one)


def test_a_piece_that_joins_late_is_one():
    """Arms of a comb that only the last line joins, and a line that comes back to where it began."""
    comb = np.zeros((20, 21, 3), bool)
    comb[:, ::2] = comb[-1] = True
    assert pieces(comb, corners=False).count == 1
    spiral = np.zeros((7, 7, 1), bool)
    spiral[0], spiral[:, -1], spiral[-1], spiral[2:, 0], spiral[2, :-2] = (True,) * 5
    assert pieces(spiral, corners=False).count == 1
