"""Calls inside a command need no new memory from the system, however deep they begin."""

import resource
from types import FunctionType

import pytest

from puncture_twin.twin.jobs.call_room import with_room

CALLS = 500
DEPTHS = range(300)


leaf = FunctionType((lambda: None).__code__.replace(co_stacksize=100), {})
"""Its frame is larger than that of `faults_at`: at some depth it is the one for which a piece has no room left."""


def faults_at(depth):
    """Pages that the system gives to many calls that begin so deep."""
    if depth:
        return faults_at(depth - 1)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
    for _ in range(CALLS):
        leaf()
    return resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before


def most_faults():
    """At any depth."""
    return max(faults_at(depth) for depth in DEPTHS)


def test_python_alone_fetches_a_piece_at_each_call_of_some_depth():
    """What the room is for; where this fails, Python keeps its pieces and the room can go."""
    assert most_faults() >= CALLS


def test_inside_the_room_no_depth_costs_memory_at_each_call():
    """Not one page for ten calls."""
    assert with_room(most_faults) < CALLS / 10


def test_what_the_function_gives_and_raises_passes_through():
    """The room adds nothing."""
    assert with_room(lambda: "done") == "done"
    with pytest.raises(KeyError, match="gone"):
        with_room(lambda: {}["gone"])
