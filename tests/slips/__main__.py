"""``python -m slips --draws 1000 --seed 0``: the table of kinds, and every draw that passed or was wrongly refused."""

import argparse
import sys
import time

from slips.runner import HEAD, KINDS, row, run


def main():
    """Draw, and print what came of it; 1 if a slip passed or a true input was refused."""
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--draws", type=int, default=1000, help="Slips in all, and as many true inputs.")
    arguments.add_argument("--seed", type=int, default=0)
    arguments.add_argument("--only", default="", help="Kinds whose name holds this.")
    given = arguments.parse_args()
    start, found = time.monotonic(), []
    sys.stdout.write(HEAD)
    for kind in (one for one in KINDS if given.only in one.name):
        found.append(run(kind, given.draws, given.seed))
        sys.stdout.write(row(found[-1]))
        sys.stdout.flush()
    draws = sum(one.slips.total() for one in found)
    wrong = [line for one in found for line in one.wrong]
    sys.stdout.write("\n".join([f"\n{draws} slips, {draws} true inputs, {time.monotonic() - start:.0f} s", *wrong, ""]))
    return bool(wrong)


if __name__ == "__main__":
    raise SystemExit(main())
