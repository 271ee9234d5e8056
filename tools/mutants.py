"""How many faults the tests notice: ``python -m tools.mutants [MODULE ...]`` (``make mutants``).

All mutants of the plain modules and a random sample of the kernels', each against the fast tests of its module, in one
process. The kernels run as plain Python (NUMBA_DISABLE_JIT=1). A mutant is killed by a test that fails, by an
error, or by time. Results go to a JSON file with each source's hash; what survives is named there.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib
import json
import os
import random
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from types import MappingProxyType

import pytest
from hypothesis import Phase, settings

from tools.mutation import Mutant, mutants, mutated

REPOSITORY = Path(__file__).resolve().parents[1]

RESIDUALS = tuple(
    f"tests/registration/test_registration_residuals.py::{name}"
    for name in (
        "test_residuals_of_11_mm_are_refused_and_flagged_where_accepted",
        "test_a_declared_noise_that_does_not_explain_the_residuals_is_refused_or_scaled",
        "test_a_triad_is_tested_by_its_rigid_fit",
        "test_a_marker_that_slipped_is_called_by_its_name",
        "test_a_declared_noise_that_explains_it_is_held",
        "test_tiny_residuals_and_few_markers_name_nobody",
    )
)
"""Without those that draw thousands of registrations."""

REGISTRATION = (
    *(f"tests/registration/test_{name}.py" for name in ("registration_limits", "registration", "fits")),
    "tests/registration/test_register_command.py",
    *RESIDUALS,
)

PLAIN = MappingProxyType(
    {
        "puncture_twin.planning.case.entry": ("tests/case/test_entry.py",),
        "puncture_twin.planning.anatomy.skin": (
            "tests/anatomy/test_skin_entry.py",
            "tests/search/test_constraints.py",
        ),
        "puncture_twin.planning.reach.standoff": ("tests/reach/test_standoff.py",),
        "puncture_twin.planning.geometry.containment": ("tests/geometry/test_containment.py",),
        "puncture_twin.planning.search.constraints": (
            "tests/search/test_verdict_order.py",
            "tests/search/test_windows.py",
        ),
        "puncture_twin.planning.registration.marker_pairs": (
            *REGISTRATION,
            "tests/registration/test_marker_ambiguity.py",
        ),
        "puncture_twin.planning.registration.fits": REGISTRATION,
        "puncture_twin.planning.registration.registration": (*REGISTRATION, "tests/registration/test_distortion.py"),
    }
)
"""All mutants of these, and the tests that must notice them."""

KERNELS = MappingProxyType(
    {
        "puncture_twin.planning.clearance.kernels.segment_triangle": ("tests/clearance/test_plain_kernels.py",),
        "puncture_twin.planning.clearance.kernels.side_by_side": ("tests/clearance/test_plain_kernels.py",),
        "puncture_twin.planning.geometry.containment": (
            "tests/clearance/test_plain_kernels.py",
            "tests/geometry/test_crossings.py",
            "tests/anatomy/test_skin_entry.py",
        ),
    }
)
"""A sample of these."""

SAMPLE, SEED = 150, 20191104

SLOW_S = 3.0
"""Tests that take longer without a fault are left out."""

TIMEOUT_S = 30.0
"""Of a mutant, of the processor, beyond three times what all tests take without a fault."""

MEMORY_BYTES = 8 << 30
"""A mutant that asks for more ends as a MemoryError."""


@dataclass
class Result:
    """What became of one module's mutants.

    Attributes:
        sha256: Of the source.
        tests: How many were run on each.
        slow: Names of those left out.
        survivors: Line and change of each.
    """

    module: str
    sha256: str
    mutants: int = 0
    killed: int = 0
    tests: int = 0
    slow: list[str] = field(default_factory=list)
    survivors: list[str] = field(default_factory=list)
    minutes: float = 0.0


class Hunt:
    """A pytest plugin: collects once, and runs the tests on every mutant until one of them fails."""

    def __init__(self, module: str, chosen: list[Mutant], result: Result) -> None:
        self._module = importlib.import_module(module)
        self._chosen = chosen
        self._result = result
        self._failed = False

    @pytest.hookimpl(tryfirst=True)
    def pytest_collection(self) -> None:
        """Random tests repeat themselves, and shrink nothing."""
        settings.register_profile("mutants", deadline=None, derandomize=True, database=None, phases=[Phase.generate])
        settings.load_profile("mutants")

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """One phase of one test."""
        self._failed |= report.failed

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        """Instead of running each test once."""
        self._run(session.items, session)
        took = {item: self._timed(item, session) for item in session.items}
        if self._failed or not took:
            raise pytest.UsageError(f"the tests of {self._module.__name__} fail without a fault")
        self._result.slow = [item.nodeid for item, s in took.items() if s > SLOW_S]
        fast = sorted((item for item, s in took.items() if s <= SLOW_S), key=lambda item: took[item])
        self._result.tests = len(fast)
        limit = TIMEOUT_S + 3.0 * sum(took[item] for item in fast)
        for done, mutant in enumerate(self._chosen):
            if self._survives(mutant, fast, session, limit):
                self._result.survivors.append(f"line {mutant.line}: {mutant.change}")
                print(f"\n  #{mutant.number} survives, line {mutant.line}: {mutant.change}", flush=True)
            self._result.mutants = done + 1
        self._result.killed = self._result.mutants - len(self._result.survivors)
        return True

    def _timed(self, item: pytest.Item, session: pytest.Session) -> float:
        start = time.process_time()
        self._run([item], session)
        return time.process_time() - start

    def _survives(self, mutant: Mutant, items: list[pytest.Item], session: pytest.Session, limit: float) -> bool:
        self._failed = False
        try:
            with mutated(self._module, mutant.code), time_limit(limit):
                self._run(items, session)
        except Exception as error:  # a mutant may raise anything, when it is loaded too
            print(f"\n  #{mutant.number} line {mutant.line}: {type(error).__name__}", flush=True)
            return False
        return not self._failed

    def _run(self, items: list[pytest.Item], session: pytest.Session) -> None:
        for item in items:
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=None)
            if self._failed:
                return


@contextmanager
def time_limit(seconds: float) -> Iterator[None]:
    """Raise within whatever runs when it has taken so much of the processor: others share the machine."""

    def stop(*_: object) -> None:
        raise TimeoutError(f"{seconds:.0f} s")

    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)


def source_of(module: str) -> Path:
    """The file of a module as it is imported: code of another path is exchanged nowhere."""
    return Path(str(importlib.import_module(module).__file__))


def hunt(module: str, tests: tuple[str, ...], numbers: frozenset[int] | None = None) -> Result:
    """Run a module's mutants, all or those of some numbers."""
    path, start = source_of(module), time.perf_counter()
    source = path.read_bytes()
    chosen = [m for m in mutants(source.decode(), str(path)) if numbers is None or m.number in numbers]
    result = Result(module, hashlib.sha256(source).hexdigest())
    config = ["-c", str(REPOSITORY / "pyproject.toml"), "-o", "addopts=--import-mode=importlib"]
    quiet = ["-p", "no:terminal", "-p", "no:cacheprovider", "-p", "no:xdist", "-W", "ignore"]
    code = pytest.main([*config, *quiet, *(str(REPOSITORY / t) for t in tests)], plugins=[Hunt(module, chosen, result)])
    if code not in (pytest.ExitCode.OK, pytest.ExitCode.TESTS_FAILED) or not result.tests:
        raise SystemExit(f"the tests of {module} cannot be run: {code}")
    result.minutes = round((time.perf_counter() - start) / 60, 1)
    return result


def kernel_sample(count: int, seed: int) -> dict[str, frozenset[int]]:
    """Numbers of the kernels' mutants, drawn from all of them together."""
    every = [
        (module, mutant.number)
        for module in KERNELS
        for mutant in mutants(source_of(module).read_text(), str(source_of(module)))
    ]
    drawn = random.Random(seed).sample(every, min(count, len(every)))
    print(f"{len(drawn)} of {len(every)} mutants of the kernels", flush=True)
    return {module: frozenset(number for name, number in drawn if name == module) for module in KERNELS}


def report(results: list[Result], out: Path) -> None:
    """Print each module's line, and put it into the file in place of its old one."""
    told = {one["module"]: one for one in json.loads(out.read_text())} if out.exists() else {}
    for one in results:
        told[one.module] = asdict(one)
        share = 100.0 * one.killed / max(one.mutants, 1)
        print(
            f"{one.module} {one.sha256[:12]}: {one.killed} of {one.mutants} killed ({share:.1f} %), "
            f"{one.tests} tests, {one.minutes:g} min"
        )
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps(list(told.values()), indent=1) + "\n")


def main() -> int:
    """Run what is asked for; the kernels in a process of their own, where numba compiles nothing."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "modules",
        nargs="*",
        metavar="MODULE",
        help="puncture_twin.planning.case.entry, ... or kernels; all if left out",
    )
    parser.add_argument("--out", type=Path, default=Path("out/mutants.json"))
    parser.add_argument("--sample", type=int, default=SAMPLE, help="of the kernels' mutants")
    parser.add_argument("--seed", type=int, default=SEED)
    options = parser.parse_args()
    wanted = options.modules or [*PLAIN, "kernels"]
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    for name in wanted:
        if name != "kernels":
            report([hunt(name, PLAIN[name])], options.out)
        elif os.environ.get("NUMBA_DISABLE_JIT") == "1":
            sample = kernel_sample(options.sample, options.seed)
            report([hunt(module, KERNELS[module], numbers) for module, numbers in sample.items()], options.out)
        else:
            again = [
                sys.executable,
                "-m",
                "tools.mutants",
                "kernels",
                "--out",
                options.out.resolve(),
                "--sample",
                str(options.sample),
            ]
            plain = os.environ | {"NUMBA_DISABLE_JIT": "1"}
            subprocess.run([*again, "--seed", str(options.seed)], env=plain, cwd=REPOSITORY, check=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
