"""The process that compiles beside the first command on a new machine: what it compiles, and that it ends."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from places import ROOT

from puncture_twin.planning.reach.small_workcell import ask_arm, small_workcell
from puncture_twin.twin.jobs import first_use

COMPILED = """
import json, sys
from puncture_twin.run_twin import main
from puncture_twin.twin.jobs.first_use import use_once

def compiled():
    ours = [m for name, m in sys.modules.items() if name.startswith(ROOMS)]
    kernels = {id(k): k for m in ours for k in vars(m).values() if hasattr(k, "signatures")}
    return {f"{k.py_func.__module__}.{k.py_func.__name__}{s}" for k in kernels.values() for s in k.signatures}

ROOMS = ("puncture_twin.planning.collision.kernels", "puncture_twin.planning.reach", "puncture_twin.planning.motion")
use_once()
before = compiled()
main(WORDS)
print(json.dumps([sorted(before), sorted(compiled() - before)]))
"""


@pytest.fixture
def begun(monkeypatch):
    """The processes that are begun, while nothing counts as compiled."""
    processes = []
    popen = subprocess.Popen

    def begin(*words, **settings):
        processes.append(popen(*words, **settings))
        return processes[-1]

    monkeypatch.setattr("puncture_twin.planning.base.cache.kernel_cache.is_compiled", lambda kernel: False)
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
    monkeypatch.setattr("puncture_twin.planning.base.cache.kernel_cache.is_compiled", lambda kernel: True)
    with first_use.compiling_beside():
        assert not begun


def test_the_small_workcell_has_directions_of_both_kinds():
    """What is reached goes through every kernel of the arm; what is not, says why."""
    answers = ask_arm(small_workcell())
    assert [answer.reachable for answer in answers] == [True, True, False, False]
    assert all(answer.detail for answer in answers if not answer.reachable)
    assert all(np.isfinite(answer.insertion_q).all() for answer in answers)


def test_a_plan_compiles_nothing_of_the_arm_that_was_not_compiled_beside_it(tmp_path):
    """Array types decide: a kernel that a command calls with another layout would be compiled again."""
    words = ["plan", str(ROOT / "meshes" / "carton" / "case_m.toml"), "--theta", "18", "--beta", "232"]
    code = COMPILED.replace("WORDS", repr([*words, "--out", str(tmp_path / "out"), "--json"]))
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path)
    compiled, anew = json.loads(done.stdout.splitlines()[-1])
    assert len(compiled) > 5
    assert anew == []
