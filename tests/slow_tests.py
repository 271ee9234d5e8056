"""Which tests are slow: read from pytest's report of durations, kept in ``slow_tests.txt``.

python tests/slow_tests.py REPORT      (make durations)
"""

import re
import sys
from collections import defaultdict
from pathlib import Path

LIST = Path(__file__).with_name("slow_tests.txt")
SLOW_S = 0.5
"""Of one case, its fixtures included. Fixtures that many share count where they were first made."""

LINE = re.compile(r"^\s*([\d.]+)s (?:call|setup|teardown)\s+(\S+?)(\[.*)?$")


def slow_tests(report):
    """Test functions (file::name) of which a case takes longer than `SLOW_S`."""
    seconds = defaultdict(float)
    for line in report.splitlines():
        found = LINE.match(line)
        if found:
            seconds[found[2], found[3]] += float(found[1])
    return sorted({test for (test, _), spent in seconds.items() if spent > SLOW_S})


def listed():
    """The slow tests as they were measured last."""
    return frozenset(LIST.read_text(encoding="utf-8").splitlines())


if __name__ == "__main__":
    LIST.write_text("".join(f"{test}\n" for test in slow_tests(Path(sys.argv[1]).read_text(encoding="utf-8"))))
