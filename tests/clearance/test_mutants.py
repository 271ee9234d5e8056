"""The mutator itself, on a few faults: `make mutants` runs them all."""

import importlib
import inspect
import sys

import numpy as np
import pytest
from places import ROOT

import puncture_twin.planning.reach.standoff
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.reach.standoff import skin_gaps

sys.path.insert(0, str(ROOT))

from tools.mutants import KERNELS, PLAIN, source_of
from tools.mutation import mutants, mutated

SOURCE = inspect.getsource(puncture_twin.planning.reach.standoff)
FILE = str(puncture_twin.planning.reach.standoff.__file__)
NEEDLE = Needle(200.0, 150.0, 1.2, None, 10.0, 30.0)


def test_a_fault_acts_where_the_function_was_imported_and_is_gone_afterwards():
    """Every mutant of a module changes what it changes for all who hold its functions; then all is as before."""
    angles = np.radians([0.0, 30.0, 45.0, 60.0, 89.99, 90.0])
    before, caught, loaded = skin_gaps(NEEDLE, angles), 0, 0
    constants = puncture_twin.planning.reach.standoff.MAX_GAP_MM, puncture_twin.planning.reach.standoff.UNEVEN_SKIN_MM
    for mutant in mutants(SOURCE, FILE):
        with mutated(puncture_twin.planning.reach.standoff, mutant.code):
            loaded += 1
            try:
                caught += not np.array_equal(skin_gaps(NEEDLE, angles), before, equal_nan=True)
            except (TypeError, ValueError):
                caught += 1
        assert constants == (
            puncture_twin.planning.reach.standoff.MAX_GAP_MM,
            puncture_twin.planning.reach.standoff.UNEVEN_SKIN_MM,
        )
    np.testing.assert_array_equal(skin_gaps(NEEDLE, angles), before)
    assert loaded >= 10 and caught >= 6


def test_what_a_mutant_raises_when_it_is_loaded_leaves_the_module_alone():
    """The original's functions stay."""
    before = skin_gaps(NEEDLE, 0.7)
    with (
        pytest.raises(ZeroDivisionError),
        mutated(puncture_twin.planning.reach.standoff, compile("1 / 0", FILE, "exec")),
    ):
        pass
    assert skin_gaps(NEEDLE, 0.7) == before


def functions_of(module):
    """The plain functions of a module, within what wraps them."""
    values = (getattr(value, "__wrapped__", getattr(value, "py_func", value)) for value in vars(module).values())
    return [value for value in values if inspect.isfunction(value) and value.__module__ == module.__name__]


def test_what_is_hunted_is_there():
    """Every module that is mutated, and every file of tests that is to notice: a name that has moved hunts nothing."""
    for module, tests in {**PLAIN, **KERNELS}.items():
        found = importlib.import_module(module)
        assert str(source_of(module)) in {one.__code__.co_filename for one in functions_of(found)}, module
        missing = [test for test in tests if not (ROOT / test.partition("::")[0]).is_file()]
        assert not missing, missing
