"""A small project that keeps its kernels as ours does: what is needed for that, and a kernel that takes in another."""

import shutil

from puncture_twin.planning.base.cache.source_stamp import PACKAGE

BASE = "planning/base"
COPIED = (
    *("__init__.py", "planning/__init__.py", f"{BASE}/__init__.py", f"{BASE}/errors.py", f"{BASE}/numba_kernels.py"),
    *(f"{BASE}/cache/{name}.py" for name in ("__init__", "kernel_cache", "kernel_files", "kernel_library")),
    *(f"{BASE}/cache/{name}.py" for name in ("brought_kernels", "source_stamp", "entry_file")),
)
"""What a project needs to keep its kernels as ours does."""

CALLEE = (
    "from puncture_twin.planning.base.numba_kernels import nb\nfrom puncture_twin.planning.size import SIZE\n\n"
    "@nb.njit(cache=True, forceinline=True)\ndef rule(x):\n    return x + {} * SIZE\n"
)
CALLER = (
    "from puncture_twin.planning.base.numba_kernels import nb\nfrom puncture_twin.planning.callee import rule\n\n"
    "@nb.njit(cache=True)\ndef add(x):\n    return rule(x)\n"
)


def copy_package(project):
    """The package with what it needs to keep its kernels, and nothing else."""
    for name in COPIED:
        copy = project / "puncture_twin" / name
        copy.parent.mkdir(parents=True, exist_ok=True)
        if name.endswith("__init__.py"):
            copy.write_text("")  # what a room hands on is not there
        else:
            shutil.copy(PACKAGE / name, copy)


def write_kernels(project):
    """A kernel that takes in another, which names a constant of a third file."""
    folder = project / "puncture_twin" / "planning"
    (folder / "caller.py").write_text(CALLER)
    (folder / "size.py").write_text("SIZE = 1\n")
    (folder / "callee.py").write_text(CALLEE.format(1))
