"""Machine code that an installed wheel brings, and which processors may run it.

A new machine compiles all kernels first, half a minute of a processor. ``make wheel`` does that where the wheel is
built, for whole classes of processors in place of one, and lays the files that numba keeps into `BROUGHT`. They are
used only under the very sources and compilers that they were made with, on a processor that has all that their class
names; everything else compiles for itself, as a checkout does, which brings nothing.

The files are pickles and machine code. They are trusted as the wheel's own modules are, beside which its RECORD lists
them: who can change the one can change the other.
"""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.cache.entry_file import DamagedError, read_plain_file
from puncture_twin.planning.base.cache.source_stamp import PACKAGE

BROUGHT = PACKAGE / "machine_code"
"""Folders as in the package, each with the files of the kernels in its modules. Nothing is ever written there."""

MADE_FOR = "made_for.txt"
"""In that folder: the stamp of what the code was made from, then the classes that it was made for, best first."""

V2 = frozenset({"cx16", "popcnt", "sahf", "sse3", "sse4.1", "sse4.2", "ssse3"})
V3 = V2 | {"avx", "avx2", "bmi", "bmi2", "f16c", "fma", "lzcnt", "movbe", "xsave"}
V4 = V3 | {"avx512bw", "avx512cd", "avx512dq", "avx512f", "avx512vl"}
CLASSES = {"x86-64-v4": V4, "x86-64-v3": V3}
"""What the psABI and LLVM call these classes of processors, and what they can do beyond the first x86-64."""


def classes_of(features: frozenset[str]) -> list[str]:
    """The classes that a processor with these features is of, the best first."""
    return [name for name, needed in CLASSES.items() if needed <= features]


def brought_class(stamp: str, features: frozenset[str], brought: Path = BROUGHT) -> str | None:
    """The class of processors whose code is to be used, or None where nothing fits.

    Args:
        stamp: Of today's kernels and compilers.
        features: What this processor can do, in LLVM's words.
        brought: The folder of what the package brings.
    """
    try:
        made_from, *made_for = read_plain_file(brought / MADE_FOR).decode("utf-8").splitlines()
    except (FileNotFoundError, DamagedError, ValueError):
        return None
    return next((name for name in classes_of(features) if made_from == stamp and name in made_for), None)


def brought_folder(source: Path) -> Path | None:
    """Where the code of a source file's kernels lies if the package brings it."""
    folder = source.parent
    return BROUGHT / folder.relative_to(PACKAGE) if folder.is_relative_to(PACKAGE) else None
