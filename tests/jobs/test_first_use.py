"""The process that compiles beside the first command on a new machine: what it compiles, and that it ends."""

import os
import subprocess

import numpy as np
import pytest

from puncture_twin.planning.reach.reach import check_small_workcell, small_workcell
from puncture_twin.twin.jobs import first_use


@pytest.fixture
def begun(monkeypatch):
    """The processes that are begun, while nothing counts as compiled."""
    processes = []
    popen = subprocess.Popen

    def begin(*words, **settings):
        processes.append(popen(*words, **settings))
        return processes[-1]

    monkeypatch.setattr("puncture_twin.planning.base.numba_kernels.is_compiled", lambda kernel: False)
    monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, pieces: 2)
    monkeypatch.setattr(first_use.subprocess, "Popen", begin)
    return processes


def test_the_process_ends_with_the_command(begun):
    """Also where the command fails; it belongs to a session of its own, so that Ctrl-C ends the command alone."""
    with pytest.raises(ZeroDivisionError), first_use.compiling_beside():
        assert begun[0].poll() is None
        assert os.getsid(begun[0].pid) != os.getsid(0)
        raise ZeroDivisionError
    assert begun[0].poll() is not None


def test_none_begins_on_one_core(begun, monkeypatch):
    """Two that share a core would both be late."""
    monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, pieces: 1)
    with first_use.compiling_beside():
        assert not begun


def test_none_begins_where_all_is_compiled(begun, monkeypatch):
    """Which is so after any command."""
    monkeypatch.setattr("puncture_twin.planning.base.numba_kernels.is_compiled", lambda kernel: True)
    with first_use.compiling_beside():
        assert not begun


def test_the_small_workcell_has_directions_of_both_kinds():
    """What is reached goes through every kernel of the arm; what is not, says why."""
    answers = check_small_workcell(small_workcell())
    assert [answer.reachable for answer in answers] == [True, True, False, False]
    assert all(answer.detail for answer in answers if not answer.reachable)
    assert all(np.isfinite(answer.insertion_q).all() for answer in answers)


def test_everything_that_is_used_once_works():
    """Nobody reads what the process says: an arm, a planner or a painter that has changed must show here."""
    first_use.use_once()


def test_what_tells_that_all_is_compiled_is_compiled_by_each_search(begun, monkeypatch):
    """A kernel that a search no longer uses would let a process begin beside every command for good."""
    queried = []
    monkeypatch.setattr("puncture_twin.planning.base.numba_kernels.is_compiled", lambda kernel: queried.append(kernel))
    with first_use.compiling_beside():
        check_small_workcell(small_workcell())
    (kernel,) = queried
    assert kernel.signatures
