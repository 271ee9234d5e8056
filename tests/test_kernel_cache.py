"""Compiled kernels are made anew when any kernel's source has changed, also one that they only take in."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import planning

CALLEE = (
    "import numba as nb\nfrom planning.room import SIZE\n\n"
    "@nb.njit(cache=True, forceinline=True)\ndef rule(x):\n    return x + {} * SIZE\n"
)
CALLER = (
    "import numba as nb\nfrom planning.callee import rule\n\n@nb.njit(cache=True)\ndef judge(x):\n    return rule(x)\n"
)


def _answer(project, own):
    """What the kernel says in a process of its own, and how often it came from the cache."""
    lines = ["import planning, numba", "" if own else "numba.core.config.CACHE_LOCATOR_CLASSES = ''"]
    lines += ["from planning.caller import judge", "print(judge(1), sum(judge.stats.cache_hits.values()))"]
    code = "\n".join(lines)
    environment = os.environ | {"PYTHONPATH": str(project), "NUMBA_CACHE_DIR": str(project / "cache")}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=project, capture_output=True, text=True, check=True
    )
    return tuple(int(word) for word in run.stdout.split())


@pytest.mark.parametrize("own", [True, False], ids=["ours", "numba's"])
def test_an_edit_of_a_kernel_that_is_taken_in_reaches_its_callers(tmp_path, own):
    """Numba alone goes on answering by the old rule: then this module is not needed any more."""
    folder = tmp_path / "planning"
    folder.mkdir()
    for name in ("__init__.py", "kernel_cache.py"):
        shutil.copy(Path(planning.__file__).parent / name, folder)
    (folder / "caller.py").write_text(CALLER)
    (folder / "room.py").write_text("SIZE = 1\n")
    (folder / "callee.py").write_text(CALLEE.format(1))
    assert _answer(tmp_path, own) == (2, 0)
    assert _answer(tmp_path, own) == (2, 1)
    (folder / "callee.py").write_text(CALLEE.format(10))
    assert _answer(tmp_path, own) == ((11, 0) if own else (2, 1))
    (folder / "room.py").write_text("SIZE = 2\n")
    assert _answer(tmp_path, own) == ((21, 0) if own else (2, 1))
    (folder / "beside.py").write_text("SIZE = 3\n")  # no kernel names it
    assert _answer(tmp_path, own) == ((21, 1) if own else (2, 1))


def test_kernels_of_others_are_left_to_numba(tmp_path):
    """A function outside the project is stamped with its own file."""
    project, other = tmp_path / "project", tmp_path / "other"
    (project / "planning").mkdir(parents=True)
    other.mkdir()
    for name in ("__init__.py", "kernel_cache.py"):
        shutil.copy(Path(planning.__file__).parent / name, project / "planning")
    (other / "stranger.py").write_text("import numba as nb\n\n@nb.njit(cache=True)\ndef f(x):\n    return x\n")
    code = "import planning, stranger; print(type(stranger.f._cache._impl.locator).__module__)"
    environment = os.environ | {"PYTHONPATH": f"{project}{os.pathsep}{other}"}
    run = subprocess.run(
        [sys.executable, "-c", code], env=environment, cwd=other, capture_output=True, text=True, check=True
    )
    assert run.stdout.strip() == "numba.core.caching"
