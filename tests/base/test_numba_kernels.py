"""Kernels that make no array count no references, and one that makes an array is refused."""

import numpy as np
import pytest
from numba.core.errors import NumbaError

from puncture_twin.planning.base.numba_kernels import allocation_free, nb


def passed_on(pair):
    """Takes arrays out of a tuple, lets them change places and cuts them."""
    first, second = pair
    total = 0.0
    for row in range(len(first)):
        if first[row, 0] > total:
            first, second = second, first
        total += first[row][0] * second[row, 1]
    return total


def made(count):
    """Makes an array."""
    return np.zeros(count).sum()


@pytest.fixture(scope="module")
def pair():
    """Two arrays of rows."""
    return np.arange(6.0).reshape(3, 2), np.arange(6.0).reshape(3, 2)


def test_it_counts_no_references(pair):
    """That is what it is for: the plain kernel of the same function counts them, and answers the same."""
    counting, free = nb.njit(passed_on), allocation_free(cache=False)(passed_on)
    assert free(pair) == counting(pair) == passed_on(pair)
    assert "NRT_incref" in next(iter(counting.inspect_llvm().values()))
    assert "NRT_incref" not in next(iter(free.inspect_llvm().values()))


def test_one_that_makes_an_array_is_refused():
    """Rather than to lose what it has made."""
    with pytest.raises(NumbaError, match="NRT|returning of array"):
        allocation_free(cache=False)(made)(3)


def test_its_arrays_live_on():
    """It takes no reference away either: what only the call holds is whole all the while, again and again."""
    free = allocation_free(cache=False)(passed_on)
    for _ in range(1000):
        assert free((np.ones((3, 2)), np.ones((3, 2)))) == 3.0
