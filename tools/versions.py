"""What a user has who is not on these versions: ``make versions``, beside the environment of the checkout.

``newest``: the highest Python that pyproject.toml names, from `constraints.txt`, without the extras. ``oldest``: the
lowest, with the lowest version of each dependency. In an environment of its own each of them answers README's first
commands; its table of a search is that of the checkout's environment, but for rounding; on the newest the quick tests
of some rooms run. Both at once, on two cores. A Python that is not here is named, and skipped; the newest is skipped
where the checkout's environment is of it, with which ``make test`` tries everything.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tomllib
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from time import monotonic

ROOT = Path(__file__).resolve().parents[1]
OUT = ROOT / "out" / "versions"
CASE = "meshes/abdomen"
ROOMS = ("tests/base", "tests/case")
"""What leans on Python's own library: processes, files, pickles, TOML, text. Numbers are the search's, and NumPy's."""

TESTS_NEED = ("hypothesis", "pytest", "simpleitk")


@dataclass(frozen=True)
class Environment:
    """One environment: its name, its Python, and what pip is given."""

    name: str
    python: str
    pip: tuple[str, ...]
    rooms: tuple[str, ...] = ()


class FailedError(Exception):
    """A command that failed, with the end of what it said."""


NOT_OFFERED = ("No matching distribution found", "NewConnectionError", "ReadTimeoutError")
"""What pip says where an index lacks a version, or cannot be reached: the machine's fault, not the project's."""


def environments(folder: Path) -> list[Environment]:
    """Those of which the Python is here; the others are named on stderr."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
    named = sorted({(3, int(one)) for one in re.findall(r"Python :: 3\.(\d+)", "\n".join(project["classifiers"]))})
    lowest = folder / "lowest.txt"
    lowest.write_text("\n".join(one.replace(">=", "==") for one in project["dependencies"]), "utf-8")
    wanted = {
        "newest": (named[-1], ("--constraint", str(ROOT / "constraints.txt"), "--editable", ".", *TESTS_NEED), ROOMS),
        "oldest": (named[0], ("--constraint", str(lowest), "--editable", "."), ()),
    }
    found = []
    for name, (version, pip, rooms) in wanted.items():
        if name == "newest" and version == sys.version_info[:2]:
            continue
        if python := _python(version):
            found.append(Environment(name, python, pip, rooms))
        else:
            print(f"NO PYTHON {version[0]}.{version[1]} IS HERE: {name} versions are not tried", file=sys.stderr)
    return found


def _python(version: tuple[int, int]) -> str | None:
    """An interpreter of this version that makes environments: on the path, or of pyenv."""
    name = f"python{version[0]}.{version[1]}"
    pyenv = Path(os.environ.get("PYENV_ROOT", Path.home() / ".pyenv"))
    candidates = [shutil.which(name), *map(str, sorted(pyenv.glob(f"versions/{version[0]}.{version[1]}.*/bin/{name}")))]
    for one in filter(None, candidates):
        if subprocess.run([one, "-c", "import ensurepip, venv"], capture_output=True, check=False).returncode == 0:
            return one
    return None


def try_out(one: Environment, folder: Path) -> Path | None:
    """Make the environment, run the commands and the tests; returns the table, None where pip is not offered all parts.

    Raises:
        FailedError: Anything else fails.
    """
    place = folder / one.name
    _run(one, [one.python, "-m", "venv", str(place)])
    python = str(place / "bin" / "python")
    try:
        _run(one, [python, "-m", "pip", "install", "--quiet", "--no-compile", *one.pip])
    except FailedError as error:
        if not any(said in str(error) for said in NOT_OFFERED):
            raise
        print(f"{one.name} VERSIONS ARE NOT TRIED, for they are not offered here: {error}", file=sys.stderr)
        return None
    _run(one, [python, "-m", "pip", "check"])
    _run(one, [python, "-m", "puncture_twin", "--version"])
    _run(one, [python, "examples/01_check_one_direction.py"])
    _run(one, [python, "-m", "puncture_twin", "search", CASE, "--no-pictures", "--out", str(place / "out")])
    if one.rooms:
        _run(one, [python, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "not slow and not real", *one.rooms])
    return place / "out" / "candidates.parquet"


def _run(one: Environment, words: list[str]) -> None:
    began = monotonic()
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(words, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        raise FailedError(f"{one.name}: {' '.join(words)}: {done.returncode}\n{(done.stdout + done.stderr)[-5000:]}")
    print(f"{one.name}: {' '.join(words[1:6])} ({monotonic() - began:.0f} s)", flush=True)


ROUNDING = 1e-12
"""Of chances between 0 and 1: other versions of SciPy's special functions differ by 3e-16."""


def differing(one: Path, other: Path) -> list[str]:
    """Columns of two tables that differ: numbers by more than rounding, all else at all."""
    import numpy as np
    import pyarrow.parquet as pq

    tables = [pq.read_table(path) for path in (one, other)]
    names = sorted({name for table in tables for name in table.column_names})
    if any(set(table.column_names) != set(names) or len(table) != len(tables[0]) for table in tables):
        return names
    bad = []
    for name in names:
        a, b = (table[name].to_numpy() for table in tables)
        rounded = a.dtype.kind == "f" and b.dtype.kind == "f" and np.allclose(a, b, 1e-12, ROUNDING, equal_nan=True)
        if not rounded and not np.array_equal(a, b):
            bad.append(name)
    return bad


def main() -> int:
    """Try all of them; what fails is printed."""
    shutil.rmtree(OUT, ignore_errors=True)
    OUT.mkdir(parents=True)
    here = Environment("here", sys.executable, ())
    tried = environments(OUT)
    try:
        with ThreadPoolExecutor(len(tried) or 1) as pool:
            tables = list(pool.map(lambda one: try_out(one, OUT), tried))
        _run(here, [sys.executable, "run_twin.py", "search", CASE, "--no-pictures", "--out", str(OUT / "here")])
    except FailedError as error:
        print(error, file=sys.stderr)
        return 1
    own = OUT / "here" / "candidates.parquet"
    made = [(one.name, table) for one, table in zip(tried, tables, strict=True) if table is not None]
    bad = {name: differing(own, table) for name, table in made}
    for name, columns in bad.items():
        print(f"{name}: the table of {CASE} " + (f"differs in {columns}" if columns else "is the same"))
    return 1 if any(bad.values()) else 0


if __name__ == "__main__":
    sys.exit(main())
