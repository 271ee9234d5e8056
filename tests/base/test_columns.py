"""Columns for Parquet, against pyarrow's own conversion."""

import numpy as np
import pyarrow as pa

from puncture_twin.planning.search.table import column, truths


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
