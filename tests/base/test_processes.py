"""Work in other processes: what goes there and comes back whole, and that no process outlives its command."""

import os
import pickle
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import MappingProxyType

import pytest

from puncture_twin.planning.base.errors import InputError, InputListError, NoAnswerError
from puncture_twin.planning.base.processes import process_pool


@pytest.mark.parametrize(
    "error",
    [
        InputError("what", where="where", allowed="allowed", code="odd", numbers={"shift_mm": 2.0}),
        InputListError("what", where="where", allowed="allowed", code="odd"),
        NoAnswerError("none", counts={"too_close": 3}, code="odd"),
    ],
)
def test_errors_are_made_again_with_all_their_parts(error):
    found = pickle.loads(pickle.dumps(error))
    assert (type(found), str(found), vars(found)) == (type(error), str(error), vars(error))


def test_what_a_worker_answers_is_whole_and_what_it_prints_is_no_answer(capfd):
    """Read-only mappings go there and back; a library that prints to file descriptor 1 does not reach stdout."""
    with process_pool(1, 1) as pool:
        assert pool.submit(os.write, 1, b"noise of a library\n").result() == 19
        found = pool.submit(dict.get, {"a": MappingProxyType({"b": 1})}, "a").result()
    assert isinstance(found, MappingProxyType) and found["b"] == 1
    assert capfd.readouterr().out == ""


def test_ctrl_c_at_the_terminal_is_not_the_workers(capfd):
    """It reaches the whole group of processes: the command alone says something, and what runs is waited for."""
    with process_pool(1, 1) as pool:
        worker = pool.submit(os.getpid).result()
        os.kill(worker, signal.SIGINT)
        assert pool.submit(os.getpid).result() == worker
    assert capfd.readouterr().err == ""


COMMAND = """
import os, time
from puncture_twin.planning.base.processes import process_pool

if __name__ == "__main__":
    with process_pool(1, 1) as pool:
        print(pool.submit(os.getpid).result(), flush=True)
        pool.submit(time.sleep, 60)
        time.sleep(60)
"""


def test_a_worker_ends_with_a_command_that_was_killed(tmp_path):
    """It may not write where the next command does."""
    (tmp_path / "command.py").write_text(COMMAND)
    places = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = subprocess.Popen([sys.executable, tmp_path / "command.py"], env=places, stdout=subprocess.PIPE, text=True)
    worker = int(command.stdout.readline())
    command.kill()
    command.communicate()
    end = time.monotonic() + 30
    while _runs(worker):
        assert time.monotonic() < end
        time.sleep(0.05)


def _runs(process):
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except FileNotFoundError:
        return False
