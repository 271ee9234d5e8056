"""Runs: each has a number, from which everything in it follows; a run that fails says so and is kept."""

import contextlib
import resource
import shutil
import time
import traceback
import warnings
from pathlib import Path

import numpy as np

from fuzz.command_lines import command_line, run
from fuzz.corpus import make_corpus
from fuzz.mutate import mutated
from fuzz.targets import TARGETS
from puncture_twin.planning.base.errors import PlanningError

SECONDS = 2.0
"""Processor time of one run."""

MEGABYTES = 1000
"""By which one run may raise the process's peak."""

COMMAND_SHARE = 0.03
"""Part of the runs that are command lines."""


class Fuzzer:
    """A corpus in a folder, and runs by number.

    Args:
        folder: An empty folder for the corpus and the mutated files.
    """

    def __init__(self, folder):
        self.corpus, self.work = Path(folder) / "corpus", Path(folder) / "work"
        self.empty = Path(folder) / "empty"
        for made in (self.corpus, self.work, self.empty):
            made.mkdir()
        make_corpus(self.corpus)
        for path in self.corpus.iterdir():
            shutil.copy(path, self.work)
        self.data = {path.name: path.read_bytes() for path in self.corpus.iterdir()}
        self.files = [str(self.corpus / name) for name in self.data if not name.endswith(".toml")]
        self.files += [str(self.corpus / "x.collision.toml")]
        weights = np.array([2.0 if target.heavy else 4.0 for target in TARGETS])
        self.weights = weights / weights.sum()
        self.accepted = dict.fromkeys([*(target.name for target in TARGETS), "command line"], 0)
        self.refused = dict(self.accepted)

    def check_corpus(self):
        for target in TARGETS:
            for name in target.files:
                target.check(target.read(self.corpus / name))

    def run(self, number):
        rng = np.random.default_rng([2026, number])
        start, peak = time.process_time(), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # a warning is a second line on stderr
            wrong = self._command(rng) if rng.random() < COMMAND_SHARE else self._reader(rng)
        seconds = time.process_time() - start
        more = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak) / 1024
        if wrong is None and seconds > SECONDS:
            wrong = f"{seconds:.1f} s of processor time: {self._what}"
        if wrong is None and more > MEGABYTES:
            wrong = f"{more:.0f} MB: {self._what}"
        return wrong

    def _reader(self, rng):
        target = TARGETS[int(rng.choice(len(TARGETS), p=self.weights))]
        name = list(target.files)[int(rng.integers(len(target.files)))]
        others = [self.data[other] for other in target.files]
        data = mutated(rng, self.data[name], target.files[name], others)
        path = self.work / name
        path.write_bytes(data)
        self._what = f"{target.name} {name}"
        try:
            target.check(target.read(path))
            self.accepted[target.name] += 1
        except PlanningError:
            self.refused[target.name] += 1
        except Exception:
            return f"{self._what}\n{traceback.format_exc()}"
        finally:
            self.last = path.read_bytes()
            path.write_bytes(self.data[name])
        return None

    def _command(self, rng):
        from puncture_twin.run_twin import main

        words = command_line(rng, self.files)
        self._what, self.last = f"command line {words}", repr(words).encode()
        try:
            with contextlib.chdir(self.empty):  # "." must be no case: a command that succeeds takes minutes
                run(main, words)
            self.refused["command line"] += 1
        except Exception:
            return f"{self._what}\n{traceback.format_exc()}"
        return None
