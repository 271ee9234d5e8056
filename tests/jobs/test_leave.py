"""The end of a process: at once, but after all that Python's own end does for others."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

ENDS = """
import atexit, os, sys, tempfile, threading, time
from concurrent.futures import ThreadPoolExecutor
from puncture_twin.twin.jobs.terminal import leave

class Last:
    def __del__(self):
        os.write(2, b"taken apart")

kept = Last()
folder = tempfile.TemporaryDirectory()
pool = ThreadPoolExecutor(1)
pool.submit(time.sleep, 0.2).add_done_callback(lambda _: print("work is over"))
threading.Thread(target=lambda: (time.sleep(0.4), print("thread is over"))).start()
atexit.register(lambda: print("called, thread and folder there:", threading.active_count(), os.path.isdir(folder.name)))
print(folder.name)
leave(7)
"""


def test_what_others_count_on_is_done_and_nothing_more():
    """Threads, executors, what was registered, what was printed; objects are not taken apart."""
    done = subprocess.run([sys.executable, "-c", ENDS], capture_output=True, text=True, check=False, timeout=60)
    folder, *rest = done.stdout.splitlines()
    assert (done.returncode, done.stderr) == (7, "")
    assert rest == ["work is over", "thread is over", "called, thread and folder there: 1 True"]
    gone = subprocess.run(["test", "-e", folder], check=False)
    assert gone.returncode == 1


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="/dev/full is of Linux")
def test_an_output_that_cannot_be_written_is_told():
    """As by Python itself: 120."""
    code = "from puncture_twin.twin.jobs.terminal import leave; print('answer'); leave(0)"
    with Path("/dev/full").open("w") as full:
        buffered = {**os.environ, "PYTHONUNBUFFERED": ""}
        done = subprocess.run([sys.executable, "-c", code], stdout=full, env=buffered, check=False)
    assert done.returncode == 120


def test_who_does_not_wait_for_the_end_sees_no_traceback():
    """Ctrl-C once the command is over ends the process, as it does one that knows nothing of it."""
    code = (
        "import os, signal, threading, time\nfrom puncture_twin.twin.jobs.terminal import leave\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "def interrupt():\n    time.sleep(0.5)\n    os.kill(os.getpid(), signal.SIGINT)\n    time.sleep(20)\n"
        "threading.Thread(target=interrupt).start()\n"
        "leave(0)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, check=False, timeout=60)
    assert (done.returncode, done.stdout, done.stderr) == (-signal.SIGINT, b"", b"")
