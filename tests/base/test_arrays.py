"""Masks that grow and numbers that are counted, as scipy and numpy do it in more time."""

import numpy as np
import pytest
import scipy

from puncture_twin.planning.base.arrays import counts_of, grown, widened


@pytest.fixture(params=[(7, 9, 11), (1, 4, 30), (40, 3, 2)], ids=str)
def mask(request, rng):
    return rng.random(request.param) < 0.06


@pytest.mark.parametrize("reach", [(0, 0, 0), (1, 1, 1), (2, 0, 3), (5, 4, 12)], ids=str)
def test_a_widened_mask_is_one_dilated_by_a_box(mask, reach):
    """Also where the box is larger than the grid; the mask itself stays."""
    before = mask.copy()
    box = np.ones([2 * r + 1 for r in reach], bool)
    assert np.array_equal(widened(mask, reach), scipy.ndimage.binary_dilation(mask, box))
    assert np.array_equal(mask, before)


def test_a_grown_mask_has_its_neighbours_by_a_face(mask):
    assert np.array_equal(grown(mask), scipy.ndimage.binary_dilation(mask))


def test_numbers_are_counted_as_by_bincount(rng):
    numbers = rng.integers(0, 9, (6, 7, 8))
    assert np.array_equal(counts_of(numbers, 12), np.bincount(numbers.ravel(), minlength=13))
