"""Print every part's figures beside what is demanded: ``python -m benchmarks.experiment [--only PART ...]``."""

from __future__ import annotations

import argparse
import importlib
import sys
from pathlib import Path

NO_PARTS = ("__main__", "row", "workbench")
"""Files beside the parts."""


def main() -> int:
    """Exit code 1 where a demand is not met."""
    parts = sorted(path.stem for path in Path(__file__).parent.glob("*.py") if path.stem not in NO_PARTS)
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", nargs="+", choices=parts, default=parts)
    failed = 0
    for part in parser.parse_args().only:
        print(f"## {part}\n| what | measured | demanded | |\n|---|---|---|---|")
        for row in importlib.import_module(f"benchmarks.experiment.{part}").rows():
            print(f"| {row.what} | {row.value} | {row.demand} | {'' if row.met else 'NOT MET'} |", flush=True)
            failed += not row.met
        print()
    return int(failed > 0)


if __name__ == "__main__":
    sys.exit(main())
