"""Where numba keeps compiled kernels, and when it must not trust them: when any kernel's source has changed.

Numba stamps what it has compiled with the source of the function's own file. A kernel that takes in another file's
kernel would be reused after an edit of that file alone, and a search would go on judging by the old rule. Kernels of
this project are stamped with the sources of all of them instead.

The classes are numba's own places, tried in numba's own order; `CACHE_LOCATOR_CLASSES` is its setting for others'.
Files outside the project are left to numba. What the package brings is looked up behind them.
"""

# mypy: disable-error-code="no-untyped-call, misc"
# numba has no types

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

from numba.core import config as numba_config
from numba.core.caching import InTreeCacheLocator, UserProvidedCacheLocator, UserWideCacheLocator
from numba.core.codegen import get_host_cpu_features

from puncture_twin.planning.base.cache.brought_kernels import BROUGHT, brought_class, brought_folder
from puncture_twin.planning.base.cache.kernel_files import CheckedFiles, ProjectStamp, use_checked_files
from puncture_twin.planning.base.cache.source_stamp import PACKAGE, PARTS, library_versions, sources_with, stamp_of

config: Any = numba_config
"""It makes its attributes when it is loaded."""

COMPILERS = ("numba", "llvmlite", "numpy")
"""Whose versions decide what is compiled."""

NUMBAS = (
    "UserProvidedCacheLocator",
    "InTreeCacheLocator",
    "UserWideCacheLocator",
    "IPythonCacheLocator",
    "ZipCacheLocator",
)
"""What numba tries where nothing is set."""


@cache
def kernels_stamp() -> str:
    """A hash of every source file of the project that speaks of numba, and of all that they import from the project.

    What they import counts too: numba freezes a constant into the kernel that names it. So do the compilers' versions.
    """
    return f"{stamp_of(sources_with(b'numba'))} {library_versions(COMPILERS)}"


@cache
def _ours(py_file: str) -> bool:
    return any(Path(py_file).resolve().is_relative_to((PACKAGE / part).resolve()) for part in PARTS)


class _OfTheProject:
    """Of two bases, the one that comes first: takes the project's files only, and stamps them with all kernels."""

    _py_file: str

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        return super().from_function(py_func, py_file) if _ours(py_file) else None

    def get_source_stamp(self) -> ProjectStamp:
        brought = None if class_in_use() is None else brought_folder(Path(self._py_file))
        return ProjectStamp(kernels_stamp(), brought)


class SetFolder(_OfTheProject, UserProvidedCacheLocator):
    """In the folder that NUMBA_CACHE_DIR names."""


class BesideSource(_OfTheProject, InTreeCacheLocator):
    """In ``__pycache__``."""


class UserFolder(_OfTheProject, UserWideCacheLocator):
    """In the user's cache folder, where the source's folder cannot be written."""


class Nowhere(_OfTheProject, InTreeCacheLocator):
    """Where no folder can be written: what is brought is found, and what is compiled is not kept.

    Numba alone would end in an error, as for a user without a home on a file system that is read-only.
    """

    def ensure_cache_path(self) -> None:
        """Whatever cannot be written is not."""


def use_kernel_cache() -> None:
    """Let numba try these places first; a user's own setting stays in force behind them."""
    ours = [f"{__name__}.{place.__name__}" for place in (SetFolder, BesideSource, UserFolder, Nowhere)]
    theirs = config.CACHE_LOCATOR_CLASSES.split(",") if config.CACHE_LOCATOR_CLASSES else list(NUMBAS)
    use_checked_files()
    config.CACHE_LOCATOR_CLASSES = ",".join([*ours, *(place for place in theirs if place not in ours)])
    name = class_in_use()
    if name is not None:
        config.CPU_NAME, config.CPU_FEATURES = name, ""  # no feature beyond those of the class


@cache
def class_in_use() -> str | None:
    """The class of processors for which code is brought, and for which this process compiles; None: for its own.

    What a user has told numba of the processor stays in force. Numba knows one processor for all that a process
    compiles: kernels of others are made for that class too.
    """
    if not BROUGHT.is_dir() or config.CPU_NAME is not None or config.CPU_FEATURES is not None:
        return None
    return brought_class(kernels_stamp(), host_features())


def host_features() -> frozenset[str]:
    """What this processor can do, in LLVM's words, without what numba is told to leave out."""
    words = get_host_cpu_features().split(",")
    return frozenset(word.removeprefix("+") for word in words if word.startswith("+"))


def is_compiled(kernel: Any) -> bool:
    """Whether a kernel of this project was compiled for anything, now or earlier, or is never compiled and kept."""
    files = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    return not isinstance(files, CheckedFiles) or bool(kernel.signatures) or files.any_kept()
