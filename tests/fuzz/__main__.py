"""``python -m fuzz --runs 100000 --first 0``: as many runs as wished, and what they found; `make fuzz`."""

import argparse
import json
import sys
import tempfile
import time
from pathlib import Path

from fuzz.runner import Fuzzer


def main():
    arguments = argparse.ArgumentParser()
    arguments.add_argument("--runs", type=int, default=100_000)
    arguments.add_argument("--first", type=int, default=0, help="Number of the first run.")
    arguments.add_argument("--keep", type=Path, help="Folder for the inputs of runs that failed.")
    given = arguments.parse_args()
    start, failed = time.monotonic(), []
    with tempfile.TemporaryDirectory() as folder:
        fuzzer = Fuzzer(folder)
        fuzzer.check_corpus()
        for number in range(given.first, given.first + given.runs):
            wrong = fuzzer.run(number)
            if wrong is not None:
                failed.append(number)
                sys.stdout.write(f"run {number}: {wrong}\n")
                if given.keep is not None:
                    given.keep.mkdir(parents=True, exist_ok=True)
                    (given.keep / str(number)).write_bytes(fuzzer.last)
            if (number + 1) % 5000 == 0:
                sys.stdout.write(
                    f"{number + 1 - given.first} runs, {time.monotonic() - start:.0f} s, {len(failed)} failed\n"
                )
                sys.stdout.flush()
    counts = {name: [fuzzer.accepted[name], fuzzer.refused[name]] for name in fuzzer.accepted}
    sys.stdout.write(
        f"{given.runs} runs in {time.monotonic() - start:.0f} s; accepted, refused: {json.dumps(counts)}\n"
    )
    sys.stdout.write(f"{len(failed)} failed: {failed[:50]}\n")
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(main())
