"""How often a reader of the code must come back to a module that they have left, on four long paths through it.

    .venv/bin/python -m benchmarks.walks           # a table; about two minutes
    .venv/bin/python -m benchmarks.walks --verbose # and every stay

The reader follows the calls as they happen and opens each function once, when it is called first. A stay is a run of
functions opened in one module; returns are stays minus modules. What every module knows (errors, files, progress:
planning/base), room faces, properties, lambdas and what a decorator writes are not opened, nor what is called only
while a module is imported or a kernel compiled: the table is the same on a new machine.
"""

import argparse
import contextlib
import os
import sys
import tempfile
from collections.abc import Callable, Iterator
from itertools import groupby
from pathlib import Path
from types import CodeType, FrameType

import numba
import numpy as np

from puncture_twin.planning.search.context import prepare
from puncture_twin.twin.guidance.ultrasound.recording_file import FILE_NAME, write_recording
from puncture_twin.twin.jobs.selfcal.selfcal import selfcal_recording
from puncture_twin.twin.plant.simulated_recording import simulate_recording

ROOT = Path(__file__).parents[1]
KNOWN = "planning/base/"
"""What a reader of any module knows already."""

NUMBA = str(Path(numba.__file__).parent)
"""What compiles a kernel runs functions of this project as it does."""

POSES = 30


class Opened:
    """The functions that were opened: (module, name), in order."""

    def __init__(self) -> None:
        self.functions: list[tuple[str, str]] = []
        self._seen: set[CodeType] = set()
        self._outside = 0

    def __call__(self, frame: FrameType, event: str, _: object) -> None:
        """Python's profiler calls this."""
        code = frame.f_code
        if code.co_name == "<module>" or code.co_filename.startswith(NUMBA):
            self._outside += {"call": 1, "return": -1}.get(event, 0)
        if event != "call" or self._outside or code in self._seen:
            return
        self._seen.add(code)
        module = _module(code.co_filename)
        if module is not None and not code.co_name.startswith(("<", "__")) and not _is_property(frame):
            self.functions.append((module, code.co_name))

    def stays(self) -> list[tuple[str, list[str]]]:
        """Runs of functions of one module."""
        return [(module, [name for _, name in run]) for module, run in groupby(self.functions, lambda one: one[0])]


def _module(file: str) -> str | None:
    """Path of a source file below the checkout; None for what the reader does not open."""
    path = os.path.realpath(file)
    inside = os.path.relpath(path, ROOT)
    if inside.startswith(("..", ".venv", KNOWN)) or not inside.startswith(("planning/", "twin/")):
        return None
    return None if inside.endswith("__init__.py") else inside


def _is_property(frame: FrameType) -> bool:
    """Whether a call reads a value of a class."""
    holder, _, name = frame.f_code.co_qualname.rpartition(".")
    return isinstance(vars(frame.f_globals.get(holder, object)).get(name), property)


@contextlib.contextmanager
def following() -> Iterator[Opened]:
    """Watch which functions are called."""
    opened = Opened()
    sys.setprofile(opened)
    try:
        yield opened
    finally:
        sys.setprofile(None)


def walks(folder: Path) -> Iterator[tuple[str, Callable[[], object]]]:
    """Name and start of each path."""
    context = prepare(ROOT / "meshes" / "abdomen")
    yield "check: one direction of a prepared case", lambda: context.explain(np.radians(30), np.radians(100))
    yield "search: a prepared case", context.search
    yield "prepare: a case to structures, trees and arm", lambda: prepare(ROOT / "meshes" / "abdomen")
    recording, _ = simulate_recording(np.random.default_rng(1), POSES)
    write_recording(recording, folder / FILE_NAME)
    yield "calibration: a recording", lambda: selfcal_recording(folder / FILE_NAME, None)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--verbose", action="store_true", help="print every stay")
    verbose = parser.parse_args().verbose
    print("stays  modules  returns  path")
    with tempfile.TemporaryDirectory() as folder:
        for name, start in walks(Path(folder)):
            with following() as opened:
                start()
            stays = opened.stays()
            modules = len({module for module, _ in stays})
            print(f"{len(stays):5d} {modules:8d} {len(stays) - modules:8d}  {name}", flush=True)
            for module, names in stays if verbose else ():
                print(f"      {module}: {', '.join(names)}")


if __name__ == "__main__":
    main()
