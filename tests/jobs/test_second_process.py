"""The process beside a command: what it answers, what it raises, and that it ends."""

import gc
import operator
import os
import pickle
import signal
import subprocess
import sys
import time
import warnings
from io import BytesIO
from types import MappingProxyType

import numpy as np
import pytest

from puncture_twin.planning.base.errors import CacheWarning, InputError, InputListError, NoAnswerError
from puncture_twin.planning.case.read_case import load_case
from puncture_twin.twin.jobs import second_process as module
from puncture_twin.twin.jobs.second_process import Here, SecondProcess, second_process


@pytest.fixture
def two_cores(monkeypatch):
    """As on a machine where a second process pays."""
    monkeypatch.setattr("puncture_twin.planning.base.numba_kernels.is_compiled", lambda kernel: True)
    monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, pieces: 2)


@pytest.fixture
def process(two_cores):
    """One that needs nothing to get ready."""
    with second_process(gc.collect) as beside:
        assert isinstance(beside, SecondProcess)
        yield beside


@pytest.fixture(params=["here", "beside"])
def either(request):
    """Who is asked, in this process or in another."""
    return Here() if request.param == "here" else request.getfixturevalue("process")


def test_it_calls_functions_with_what_is_kept(either):
    """In the order of the questions; read-only arrays and mappings stay so, and the seconds are those of the work."""
    either.keep(dict, {"a": np.arange(3.0), "b": MappingProxyType({"c": 1})})
    first, then, slept = either.ask(dict.get, "a"), either.ask(dict.get, "b"), either.ask(_slept_after)
    assert np.array_equal(first.result().value, np.arange(3.0)) and then.result().value == {"c": 1}
    assert isinstance(then.result().value, MappingProxyType)
    assert slept.result().seconds >= 0.2 and slept.done()
    fixed = np.arange(4)
    fixed.setflags(write=False)
    either.keep(list, [fixed])
    assert not either.ask(_first).result().value.flags.writeable


def _slept_after(kept):
    time.sleep(0.2)


def _first(kept):
    return kept[0]


def _print(kept):
    os.write(1, b"noise of a library\n")
    print("of Python")  # noqa: T201  # that it goes elsewhere is what is tested
    return kept


def test_what_is_printed_does_not_reach_the_answers(process, capfd):
    """Some libraries write to file descriptor 1."""
    process.keep(str, "answer")
    assert process.ask(_print).result().value == "answer"
    assert capfd.readouterr().out == ""


def test_errors_are_what_they_are(either, tmp_path):
    """Of what is kept too, and the next question is answered all the same."""
    either.keep(load_case, tmp_path / "nowhere")
    with pytest.raises(InputError) as wanted:
        load_case(tmp_path / "nowhere")
    with pytest.raises(InputError) as found:
        either.ask(_first).result()
    assert vars(found.value) == vars(wanted.value) and str(found.value) == str(wanted.value)
    either.keep(list, [7])
    with pytest.raises(TypeError, match="'list' object cannot be interpreted"):
        either.ask(operator.index).result()
    assert either.ask(_first).result().value == 7


@pytest.mark.parametrize(
    "error",
    [
        InputListError("what", where="where", allowed="allowed"),
        NoAnswerError("none", counts={"too_close": 3}),
        KeyError("k"),
        OSError(28, "No space left on device", "film.mp4"),
    ],
)
def test_errors_are_made_again_with_all_their_parts(error):
    """Not from their message alone."""
    pipe = BytesIO()
    module._send(error, pipe)
    found = pickle.loads(pipe.getvalue())
    assert (type(found), str(found), vars(found)) == (type(error), str(error), vars(error))
    assert getattr(found, "errno", None) == getattr(error, "errno", None)


def test_what_was_made_anew_is_said_here(process):
    """A cache that could not be trusted is named by the command, as if it had made it anew itself."""
    process.keep(str, "skin: made anew")
    with pytest.warns(CacheWarning, match="skin: made anew"):
        process.ask(warnings.warn, CacheWarning).result()


def test_a_process_that_was_killed_is_a_failure(process):
    """Nobody waits for its answer for ever."""
    process.keep(list, [1])
    asked = process.ask(_sleep_long)
    os.kill(process._process.pid, signal.SIGKILL)
    with pytest.raises(RuntimeError, match="the process beside has ended, with -9"):
        asked.result()


def _sleep_long(kept):
    time.sleep(60)


def test_it_ends_with_the_block_whatever_it_does(two_cores):
    """It belongs to a session of its own, so that Ctrl-C ends the command alone."""
    with pytest.raises(KeyboardInterrupt), second_process(gc.collect) as beside:
        process = beside._process
        assert os.getsid(process.pid) != os.getsid(0)
        beside.keep(list, [1])
        beside.ask(_first).result()
        asked = beside.ask(_sleep_long)
        raise KeyboardInterrupt
    assert process.poll() is not None
    with pytest.raises(RuntimeError, match="has ended"):
        asked.result()


def test_nothing_begins_on_one_core_or_before_all_is_compiled(two_cores, monkeypatch):
    """Two that share a core, or compile the same, would both be late."""
    monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, pieces: 1)
    with second_process(gc.collect) as beside:
        assert isinstance(beside, Here)
    monkeypatch.setattr("puncture_twin.planning.base.processes.worker_count", lambda wanted, pieces: 2)
    monkeypatch.setattr("puncture_twin.planning.base.numba_kernels.is_compiled", lambda kernel: False)
    with second_process(gc.collect) as beside:
        assert isinstance(beside, Here)


def test_it_is_ended_while_a_module_loads_without_a_word(tmp_path):
    """Compiled modules turn an exit inside of them into an error of theirs, and Python would print its traceback."""
    (tmp_path / "slow_to_load.py").write_text(
        "import sys, time\n"
        "print('loading', file=sys.stderr, flush=True)\n"
        "try:\n    time.sleep(60)\n"
        "except SystemExit as exit:\n    raise ImportError('already registered') from exit\n"
    )
    code = "from puncture_twin.twin.jobs.second_process import serve; serve('slow_to_load', 'get_ready')"
    child = subprocess.Popen(
        [sys.executable, "-c", code],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *filter(None, sys.path)])},
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert child.stderr.readline() == "loading\n"
    child.terminate()
    _, said = child.communicate(timeout=30)
    assert (child.returncode, said) == (0, "")
