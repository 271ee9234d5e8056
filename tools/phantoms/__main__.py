"""``python -m tools.phantoms --out DIR``: make the embedded cases' meshes and point lists again.

With ``--seed N`` a trunk is drawn instead, and written as a case.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np

from tools.phantoms.drawn.trunk import draw_trunk
from tools.phantoms.drawn.trunk_case import write_trunk_case
from tools.phantoms.manifest import write_phantoms


def main() -> int:
    """Parse the options and write; progress goes to stderr."""
    parser = argparse.ArgumentParser(prog="python -m tools.phantoms", description=__doc__)
    parser.add_argument("--out", type=Path, required=True, help="folder for abdomen/, carton/ and manifest.json")
    parser.add_argument("--seed", type=_seed, help="draw a trunk by this seed: a case of meshes in --out")
    options = parser.parse_args()
    if options.seed is None:
        write_phantoms(options.out, _print)
    else:
        trunk = draw_trunk(np.random.default_rng(options.seed))
        _print(str(write_trunk_case(options.out, trunk, f"drawn_{options.seed}")))
    return 0


def _seed(text: str) -> int:
    if not text.isascii() or not text.isdigit() or len(text) > 18:
        raise argparse.ArgumentTypeError(f"'{text[:20]}' is no seed: a whole number from 0 on")
    return int(text)


def _print(line: str) -> None:
    sys.stderr.write(line + "\n")


if __name__ == "__main__":
    sys.exit(main())
