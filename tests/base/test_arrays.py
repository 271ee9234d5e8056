"""Masks that grow, numbers that are counted and columns for Parquet, as scipy, numpy and pyarrow do it in more time."""

import numpy as np
import pyarrow as pa
import pytest
import scipy

from puncture_twin.planning.base.arrays import grown, label_counts, widened
from puncture_twin.planning.search.table import column, truths


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
    assert np.array_equal(label_counts(numbers, 12), np.bincount(numbers.ravel(), minlength=13))


def test_numbers_and_truths_are_those_that_pyarrow_makes(rng):
    for size in (0, 1, 2, 7, 8, 9, 20, 65):
        floats = rng.normal(size=size)
        floats[rng.random(size) < 0.3] = np.nan
        floats[rng.random(size) < 0.1] = -np.inf
        for values in (floats, rng.integers(-(2**62), 2**62, size), rng.random(size) < 0.5):
            found, expected = column(values), pa.array(values, from_pandas=True)
            assert found.equals(expected)
            assert (found.type, found.null_count) == (expected.type, expected.null_count)
            found.validate(full=True)


def test_texts_are_those_that_pyarrow_makes():
    for texts in ([], [""], ["a", "", "é肝\U0001f600", " ", "b" * 300, "\u202e"] * 5):
        for values in (np.array(texts, dtype=object), np.array(texts, dtype=np.str_)):
            found, expected = column(values), pa.array(texts, pa.string())
            assert found.equals(expected)
            found.validate(full=True)


def test_truths_that_are_not_known_are_null(rng):
    for size in (0, 1, 8, 9, 20):
        values, known = rng.random((2, size)) < 0.5
        expected = pa.array([value if there else None for value, there in zip(values, known, strict=True)], pa.bool_())
        assert truths(values, known).equals(expected)
