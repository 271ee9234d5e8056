"""One command in this process, its processor time divided by what was waited for: what `benchmarks.wait` starts.

    python wait_probe.py CHECKOUT ANSWER.json COMMAND...

Time is this process' processor time (all its threads, and what its children used), and belongs to the innermost of what
was going on: an import, a compiled kernel that is loaded or made, one of `FUNCTIONS`, an announced stage.
A name that a checkout lacks is left out, and its time is that of its caller.
"""

import builtins
import contextlib
import importlib
import importlib.abc
import importlib.machinery
import io
import json
import resource
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

ROOT = "puncture_twin."

FUNCTIONS = {
    "planning.case.case": {"load_case": "files"},
    "planning.registration.placement": {"load_placement": "files"},
    "planning.anatomy.anatomy": {"load_anatomy": "meshes"},
    "planning.evidence.checks": {"findings": "inputs compared"},
    "planning.clearance.fast_engine": {"_packed": "engine's blocks", "_remembered": "engine's blocks"},
    "planning.collision.workcell": {"case_checker": "workcell"},
    "planning.search.search": {"organ_distances": "search", "organ_candidates": "search"},
    "planning.search.constraints": {"with_reach": "reach"},
    "planning.search.phases": {"with_breathing_reach": "reach"},
    "planning.search.chances": {"with_chances": "chances", "with_best_chances": "chances"},
    "planning.search.ranking": {"ranked": "ranking"},
    "planning.search.uncertainty_breakdown": {"uncertainty_breakdown": "chances"},
}
"""By module: what of it is timed under which name."""
STAGES = {"map": "pictures", "scene": "pictures", "page": "pictures", "film": "film", "table": "table", "plan": "plan"}
"""What a command announces, under the table's names; others go to where they are called from."""


class Clock:
    """Processor seconds by name, of the innermost name only."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._names = ["rest"]
        self._since = used()

    @contextlib.contextmanager
    def under(self, name: str) -> Iterator[None]:
        """Time the block under a name."""
        self._book()
        self._names.append(name)
        try:
            yield
        finally:
            self._book()
            self._names.pop()

    def wrapped(self, function: Callable[..., Any], name: str) -> Callable[..., Any]:
        """The function, timed."""

        def timed(*arguments: Any, **named: Any) -> Any:
            with self.under(name):
                return function(*arguments, **named)

        return timed

    def all_seconds(self) -> dict[str, float]:
        """Up to now, with what Python took before this file began."""
        self._book()
        return {**self.seconds, "all": used()}

    def _book(self) -> None:
        now = used()
        self.seconds[self._names[-1]] = self.seconds.get(self._names[-1], 0.0) + now - self._since
        self._since = now


def used() -> float:
    """Processor seconds of this process and of its children that ended."""
    both = (resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    return sum(one.ru_utime + one.ru_stime for one in both)


class Timed(importlib.abc.MetaPathFinder):
    """Wraps what of a module is timed as soon as the module is there, before anyone takes a name from it."""

    def __init__(self, clock: Clock) -> None:
        self._clock = clock

    def find_spec(self, name: str, path: Sequence[str] | None, target: Any = None) -> Any:
        """The ordinary spec, whose loader wraps."""
        names = FUNCTIONS.get(name.removeprefix(ROOT)) if name.startswith(ROOT) else None
        progress = name == f"{ROOT}planning.base.progress"
        if names is None and not progress:
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and spec.loader is not None:
            loader: Any = spec.loader
            plain = loader.exec_module
            loader.exec_module = lambda module: (plain(module), self._wrap(module, names or {}))
        return spec

    def _wrap(self, module: Any, names: dict[str, str]) -> None:
        for name, label in names.items():
            holder, _, last = name.rpartition(".")
            owner = getattr(module, holder, None) if holder else module
            if hasattr(owner, last):
                setattr(owner, last, self._clock.wrapped(getattr(owner, last), label))
        if module.__name__.endswith("base.progress"):
            self._time_stages(module.Stages)

    def _time_stages(self, stages: Any) -> None:
        plain, clock = stages.time, self._clock

        @contextlib.contextmanager
        def timed(self: Any, name: str) -> Iterator[None]:
            with plain(self, name):
                if name not in STAGES:
                    yield
                    return
                with clock.under(STAGES[name]):
                    yield

        stages.time = timed


def main() -> None:
    """Run the command; write what it took."""
    checkout, answer, *command = sys.argv[1:]
    sys.path[0] = checkout
    clock = Clock()
    sys.meta_path.insert(0, Timed(clock))
    builtins.__import__ = clock.wrapped(builtins.__import__, "imports")
    importlib.import_module = clock.wrapped(importlib.import_module, "imports")
    shown = io.StringIO()
    with contextlib.redirect_stdout(shown):
        run_twin: Any = importlib.import_module("run_twin")
        code = run_twin.main(command)
    Path(answer).write_text(json.dumps({"exit_code": code, "seconds": clock.all_seconds()}))
    if hasattr(run_twin, "leave"):  # as the program does
        run_twin.leave(0)


if __name__ == "__main__":
    main()
