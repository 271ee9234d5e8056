"""Processes that write into an output folder and are killed: when, and what they leave."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections import Counter

import numpy as np
from case_world import coarse_carton
from places import ROOT

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import (
    MANIFEST_NAME,
    TIMINGS_NAME,
    problems,
    read_manifest,
    read_output,
)
from puncture_twin.planning.base.output.output_set import DRAFT_PREFIX, LOCK_NAME

REPOSITORY = ROOT
RUN_TIMEOUT_S = 600.0
SELFCAL = 'schema = 1\nname = "small"\nseed = 3\n[poses]\nsamples = 240\ncount = 20\n'
PLACE = """
[place]
mounts = ["ceiling"]
step_mm = 400.0
[place.ceiling]
along_mm = [-100.0, 0.0]
across_mm = [400.0, 500.0]
height_mm = [450.0, 550.0]
"""


def coarse_cases(here):
    """The carton twice, coarse, with two grids: whose files lie in a folder can be told by the case's hash."""
    return [coarse_carton(here / name, step) for name, step in (("a", 15.0), ("b", 18.0))]


def start(arguments):
    """The command line in a process of its own, behind the one that is to kill it in time."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY), os.environ.get("PYTHONPATH", "")])}
    program = [sys.executable, str(REPOSITORY / "run_twin.py"), *map(str, arguments)]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    return subprocess.Popen(
        program, cwd=REPOSITORY, env=environment, start_new_session=True, preexec_fn=_behind, **quiet
    )


def _behind():
    """Whoever watches it must see it move its files, which takes milliseconds, on a busy machine too."""
    os.nice(5)


def kill_while_writing(process, out, rng):
    """Kill a process at random, half the time while it writes its files and half while they are put in place."""
    aimed = bool(rng.integers(2))
    deadline = time.monotonic() + RUN_TIMEOUT_S
    while process.poll() is None and time.monotonic() < deadline:
        drafts = list(out.glob(f"{DRAFT_PREFIX}{process.pid}-*"))
        if drafts and (not aimed or (drafts[0] / "state" / "before").exists()):
            break
        if not aimed:
            time.sleep(0.005)
    time.sleep(rng.uniform(0.0, 0.003) if aimed else rng.uniform(0.0, 3.0))
    running = process.poll() is None
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)  # the session that `start` made: its workers and encoders too
    process.wait()
    return running


def passing(out):
    """Every file of a folder that a reader accepts, and the entry that lists it."""
    manifest, found = (read_manifest(out) if out.is_dir() else None), {}
    for path in sorted(out.rglob("*")) if manifest else ():
        name = path.relative_to(out).as_posix()
        if path.is_file() and name not in (MANIFEST_NAME, TIMINGS_NAME) and not name.startswith(".puncture"):
            with contextlib.suppress(InputError):
                if path.parent == out:
                    read_output(path, max_bytes=1 << 30)
                    assert manifest.owner(name) is not None
                if manifest.owner(name) is not None:
                    found[name] = manifest.owner(name)
    return found


def state_of(out, entry, old, new):
    """``old``, ``new`` or ``unfinished``; fails on anything else."""
    manifest = read_manifest(out) if out.is_dir() else None
    if manifest is None or entry not in manifest.entries:
        assert not [name for name, owner in passing(out).items() if owner == entry]
        return "unfinished"
    listed = manifest.entries[entry]
    wrong = [line for line in problems(out) if "left over" not in line]
    assert wrong == [], wrong
    hashes = {one.sha256 for one in listed.inputs}
    assert (old in hashes) != (new in hashes), "neither the old set nor the new one"
    return "new" if new in hashes else "old"


def temporaries(out):
    """What only a running command may have in a folder."""
    return [path.name for path in out.iterdir() if path.name.startswith(DRAFT_PREFIX) or path.name == LOCK_NAME]


def said(command, counts: Counter):
    return f"| {command} | {sum(counts.values())} | {counts['old']} | {counts['unfinished']} | {counts['new']} |"


def generator(name):
    return np.random.default_rng([ord(letter) for letter in name])
