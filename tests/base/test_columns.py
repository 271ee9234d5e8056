"""Columns for Parquet, against pyarrow's own conversion."""

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given, strategies as st

from puncture_twin.planning.search.table import column, truths

KINDS = {
    "floats": st.one_of(st.floats(allow_infinity=True), st.just(float("nan"))).map(np.float64),
    "integers": st.integers(-(2**62), 2**62).map(np.int64),
    "truths": st.booleans(),
}


@pytest.mark.parametrize("kind", KINDS)
@given(data=st.data())
def test_numbers_and_truths_are_those_that_pyarrow_makes(kind, data):
    """Values, nulls for NaN, and types, of any length."""
    values = np.array(
        data.draw(st.lists(KINDS[kind], max_size=20)), dtype={"floats": float, "integers": int}.get(kind, bool)
    )
    found, expected = column(values), pa.array(values, from_pandas=True)
    assert found.equals(expected)
    assert (found.type, found.null_count) == (expected.type, expected.null_count)
    found.validate(full=True)


@given(texts=st.lists(st.text(alphabet=st.characters(codec="utf-8", exclude_characters="\0"), max_size=8), max_size=20))
def test_texts_are_those_that_pyarrow_makes(texts):
    """Of NumPy's own text and of objects, in any script."""
    for values in (np.array(texts, dtype=object), np.array(texts, dtype=np.str_)):
        found, expected = column(values), pa.array(texts, pa.string())
        assert found.equals(expected)
        found.validate(full=True)


@given(pairs=st.lists(st.tuples(st.booleans(), st.booleans()), max_size=20))
def test_truths_that_are_not_known_are_null(pairs):
    """What is known is itself."""
    values, known = np.array(pairs, dtype=bool).reshape(-1, 2).T
    expected = pa.array([value if is_known else None for value, is_known in pairs], pa.bool_())
    assert truths(values, known).equals(expected)
