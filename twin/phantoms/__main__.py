"""``python -m puncture_twin.twin.phantoms --out DIR``: make the embedded cases' meshes and point lists again."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from puncture_twin.twin.phantoms.manifest import write_phantoms


def main() -> int:
    """Parse the one option and write; progress goes to stderr."""
    parser = argparse.ArgumentParser(prog="python -m puncture_twin.twin.phantoms", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for abdomen/, carton/ and manifest.json")
    write_phantoms(parser.parse_args().out, _print)
    return 0


def _print(line: str) -> None:
    sys.stderr.write(line + "\n")


if __name__ == "__main__":
    sys.exit(main())
