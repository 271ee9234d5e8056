"""Which tests are slow: measured (make durations), kept in ``slow_tests.txt``, marked by conftest.

``DURATIONS=FILE pytest`` appends the processor's seconds of every test and of every fixture that tests share;
``python tests/slow_tests.py FILE`` makes the list of them.
"""

import os
import resource
import sys
from collections import defaultdict
from pathlib import Path

import pytest

LIST = Path(__file__).with_name("slow_tests.txt")
SLOW_S = 0.07
"""Of one case, without the fixtures that it shares."""
SLOW_FIXTURE_S = 1.5
"""Of a shared fixture, without others below it: whatever uses it is slow, since one test alone pays for all of it."""

COUNTED_LATE = frozenset(
    {
        "tests/batch/test_cohort_page.py::browser",
        "tests/jobs/test_hostile.py::runner",
        "tests/twin/report/test_page_browser.py::browser",
    }
)
"""Fixtures whose processes are waited for, and so counted, at their end: a browser's take seconds, half a minute."""


def slow_names(report):
    """Tests (file::name) and shared fixtures (file::name) that take longer than their limit.

    Of many cases the longest is left out: the first one loads the compiled kernels for all.
    """
    found = defaultdict(list)
    for line in report.splitlines():
        kind, name, seconds = line.split("\t")
        found[kind, name].append(float(seconds))
    limits = {"test": SLOW_S, "fixture": SLOW_FIXTURE_S}
    slow = {name for (kind, name), taken in found.items() if sorted(taken)[-2 if len(taken) > 3 else -1] > limits[kind]}
    return sorted(slow | COUNTED_LATE)


def totals(report):
    """Seconds of every file, the most first: where time goes."""
    seconds = defaultdict(float)
    for line in report.splitlines():
        _, name, spent = line.split("\t")
        seconds[name.partition("::")[0]] += float(spent)
    return sorted(seconds.items(), key=lambda one: -one[1])


def listed():
    """The slow tests and fixtures as they were measured last."""
    return frozenset(LIST.read_text(encoding="utf-8").splitlines())


def names_of(item):
    """A test by the name under which it is listed, and the fixtures of its own file that it uses."""
    file = item.nodeid.partition("::")[0]
    return {item.nodeid.partition("[")[0], *(f"{file}::{name}" for name in getattr(item, "fixturenames", ()))}


def processor_seconds():
    """Of this process and of the processes it has waited for: what a busy machine does not stretch."""
    return sum(
        used.ru_utime + used.ru_stime
        for used in map(resource.getrusage, (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))
    )


class Durations:
    """A plugin of pytest that writes what each test, and each fixture that tests share, takes."""

    def __init__(self, path):
        self._path = path
        self._shared = 0.0

    def _write(self, kind, name, seconds):
        with Path(self._path).open("a", encoding="utf-8") as file:
            file.write(f"{kind}\t{name}\t{seconds:.3f}\n")

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef):
        """A fixture of its own test alone counts as part of the test."""
        if fixturedef.scope == "function":
            return (yield)
        start, below = processor_seconds(), self._shared
        try:
            return (yield)
        finally:
            own = processor_seconds() - start - (self._shared - below)
            self._shared += own
            self._write("fixture", f"{fixturedef.baseid}::{fixturedef.argname}", own)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item):
        """A test, set up and taken down, less the shared fixtures that happened to be made for it."""
        start, self._shared = processor_seconds(), 0.0
        try:
            return (yield)
        finally:
            self._write("test", item.nodeid.partition("[")[0], processor_seconds() - start - self._shared)


def plugins():
    """What measures, where ``DURATIONS`` names a file."""
    path = os.environ.get("DURATIONS")
    return [Durations(path)] if path else []


if __name__ == "__main__":
    measured = Path(sys.argv[1]).read_text(encoding="utf-8")
    LIST.write_text("".join(f"{name}\n" for name in slow_names(measured)), encoding="utf-8")
    for name, spent in totals(measured)[:20]:
        sys.stdout.write(f"{spent:7.1f} s  {name}\n")
