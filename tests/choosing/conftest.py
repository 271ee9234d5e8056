"""Balls about a target, without an arm, in RAS."""

import pytest
from case_world import write_case

from puncture_twin.planning.search.context import prepare

CHANGES = (('space = "LPS"', 'space = "RAS"'), ("theta_deg = [0, 10]", 'frame = "ct"\ntheta_deg = [0, 60]'))


@pytest.fixture(scope="module")
def context(tmp_path_factory):
    return prepare(write_case(tmp_path_factory.mktemp("choosing"), *CHANGES), arm=False)


@pytest.fixture
def another(tmp_path):
    return lambda *changes: prepare(write_case(tmp_path, *CHANGES, *changes), arm=False)
