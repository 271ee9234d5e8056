"""A process that runs what it is told, line by line, each in a child with bounds on time and memory.

A line on stdin is JSON: ``argv`` of the command line, or ``reader`` with ``path``; ``seconds`` of the processor;
``megabytes``. The answer is a line too: ``exit`` (null if the child was stopped), ``out``, ``err``, ``seconds`` by the
clock, ``megabytes``.
"""

import importlib
import json
import os
import resource
import signal
import sys
import tempfile
import time
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.certify.certificate import read_certificate
from puncture_twin.planning.collision_cases.checks_file import read_checks
from puncture_twin.planning.formats.meshes.mesh_files import read_mesh
from puncture_twin.planning.geometry.spaces import Space, Unit
from puncture_twin.planning.plan.plan_document import read_plan
from puncture_twin.run_twin import main

LOADED = ("patient.main_job", "patient.pictures", "selfcal.selfcal", "servo.job", "live.mirror", "batch.jobs")
"""What commands load by themselves: once here, where each child would else spend a second on it."""

for name in ("planning.search.context", *(f"twin.jobs.{one}" for one in LOADED)):
    importlib.import_module(f"puncture_twin.{name}")

READERS = {
    "certificate": read_certificate,
    "collision": read_checks,
    "mesh": lambda path: read_mesh(path, unit=Unit.MM, space=Space.LPS),
    "plan": read_plan,
}


WALL = 20
"""By the clock a task may take so many times its processor's seconds: the machine may be shared."""


def do(task):
    if "argv" in task:
        return main(task["argv"])
    try:
        READERS[task["reader"]](Path(task["path"]))
    except InputError as error:
        sys.stderr.write(f"{error}\n")
        return 2
    return 0


def child(task, out, err):
    code = 70
    try:
        os.dup2(out.fileno(), 1)
        os.dup2(err.fileno(), 2)
        most = task["megabytes"] << 20
        resource.setrlimit(resource.RLIMIT_CPU, (task["seconds"], task["seconds"]))
        resource.setrlimit(resource.RLIMIT_AS, (virtual_bytes() + most, resource.RLIM_INFINITY))
        code = do(task)
        sys.stdout.flush()
        sys.stderr.flush()
    finally:
        os._exit(code)


def virtual_bytes():
    return int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()


def answer(task):
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err:
        start = time.monotonic()
        pid = os.fork()
        if pid == 0:
            child(task, out, err)
        status = usage = None
        while status is None:
            done, code, usage = os.wait4(pid, os.WNOHANG)
            if done:
                status = code
            elif time.monotonic() - start > WALL * task["seconds"]:
                os.kill(pid, signal.SIGKILL)
                os.waitpid(pid, 0)
                break
            else:
                time.sleep(0.005)
        said = [stream.seek(0) or stream.read(1_000_000).decode("utf-8", "replace") for stream in (out, err)]
        code = os.WEXITSTATUS(status) if status is not None and os.WIFEXITED(status) else None
        seconds = time.monotonic() - start
        peak = usage.ru_maxrss // 1024 if usage else 0
        return {"exit": code, "out": said[0], "err": said[1], "seconds": seconds, "megabytes": peak}


if __name__ == "__main__":
    for line in sys.stdin:
        sys.stdout.write(json.dumps(answer(json.loads(line))) + "\n")
        sys.stdout.flush()
