"""Where numba keeps compiled kernels, and when it must not trust them: when any kernel's source has changed.

Numba stamps what it has compiled with the source of the function's own file. A kernel that takes in another file's
kernel would be reused after an edit of that file alone, and a search would go on judging by the old rule. Kernels of
this project are stamped with the sources of all of them instead: there are many ways to take one in, and some are seen
in no import.

The places are numba's own, in numba's own order, and a user's setting of them stays in force. Functions of files
outside the project are left to numba. What the package brings is looked up behind them.
"""

# mypy: disable-error-code="no-untyped-call, misc"
# numba has no types

from __future__ import annotations

import inspect
from functools import cache, cached_property
from pathlib import Path
from typing import Any

from numba.core import caching, codegen as numba_codegen, config as numba_config, dispatcher as numba_dispatcher
from numba.core.runtime.nrt import rtsys

from puncture_twin.planning.base.cache.brought_kernels import BROUGHT, brought_class, brought_folder
from puncture_twin.planning.base.cache.kernel_files import CheckedFiles
from puncture_twin.planning.base.cache.kernel_library import KernelLibrary
from puncture_twin.planning.base.cache.source_stamp import (
    PACKAGE,
    PARTS,
    files_unedited,
    library_versions,
    sources_with,
    stamp_of,
)

config: Any = numba_config
"""It makes its attributes when it is loaded."""

NumbasCache: Any = caching.FunctionCache
"""Numba's own, of one function's compiled code."""

NumbasPlaces: Any = caching.CompileResultCacheImpl
"""Where it is, and what of it is kept."""

COMPILERS = ("numba", "llvmlite", "numpy")
"""Whose versions decide what is compiled."""


@cache
def kernels_stamp() -> str:
    """A hash of every source file of the project that speaks of numba, and of all that they import from the project.

    What they import counts too: numba freezes a constant into the kernel that names it. So do the compilers' versions.
    """
    return f"{stamp_of(_kernels_files())} {library_versions(COMPILERS)}"


@cache
def _kernels_files() -> tuple[str, ...]:
    return tuple(sources_with(b"numba"))


@cache
def _own_file(py_file: str) -> str | None:
    """The file as one of the package, whose parts may be links; None for others' files."""
    file = Path(py_file).resolve()
    folders = (PACKAGE / part for part in PARTS)
    found = (folder / file.relative_to(folder.resolve()) for folder in folders if file.is_relative_to(folder.resolve()))
    return next(map(str, found), None)


class Nowhere(caching.InTreeCacheLocator):
    """Where no folder can be written: what is brought is found, and what is compiled is not kept.

    Numba alone would end in an error, as for a user without a home on a file system that is read-only.
    """

    def ensure_cache_path(self) -> None:
        """Whatever cannot be written is not."""


class Places(NumbasPlaces):
    """Numba's own places for what it compiles, and behind them none."""

    _locator_classes = (*NumbasPlaces._locator_classes, Nowhere)


class KernelCache(NumbasCache):
    """The cache of one kernel: set up when it is first asked, for most kernels are only taken in by others.

    What is kept is loaded without numba's registries, of which only compiling knows anything, and which take a tenth of
    a second: compiled code needs numba's runtime alone.
    """

    def __init__(self, py_func: Any) -> None:
        self._name, self._py_func = repr(py_func), py_func
        self._stamp = kernels_stamp()  # now: when the kernel is first called, the sources may be others
        self.enable()

    @cached_property
    def _impl(self) -> Any:
        return Places(self._py_func)

    @cached_property
    def _cache_path(self) -> Any:
        return self._impl.locator.get_cache_path()

    @cached_property
    def _cache_file(self) -> CheckedFiles:
        file = _own_file(inspect.getfile(self._py_func))
        assert file is not None  # others' functions have numba's cache
        brought = None if class_in_use() is None else brought_folder(Path(file))
        return CheckedFiles(self._cache_path, self._impl.filename_base, self._stamp, brought)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """What was compiled for these types, or None."""
        rtsys.initialize(target_context)
        return self._load_overload(sig, target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep what was compiled, unless a source was edited meanwhile: the stamp may be of other code than this."""
        if files_unedited(_kernels_files()):
            super().save_overload(sig, data)


def use_kernel_cache() -> None:
    """Let numba keep this project's kernels so, all others as ever, and parse no kept bitcode before it is needed."""
    dispatcher: Any = numba_dispatcher  # its attribute is a class; what stands in for it makes an object of one of two
    dispatcher.FunctionCache = _cache_of
    codegen: Any = numba_codegen.JITCPUCodegen
    codegen._library_class = KernelLibrary
    name = class_in_use()
    if name is not None:
        config.CPU_NAME, config.CPU_FEATURES = name, ""  # no feature beyond those of the class


def _cache_of(py_func: Any) -> Any:
    ours = _own_file(inspect.getfile(py_func)) is not None
    return KernelCache(py_func) if ours else NumbasCache(py_func)


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
    words = numba_codegen.get_host_cpu_features().split(",")
    return frozenset(word.removeprefix("+") for word in words if word.startswith("+"))


def is_compiled(kernel: Any) -> bool:
    """Whether a kernel of this project was compiled for anything, now or earlier, or is never compiled and kept."""
    files = getattr(getattr(kernel, "_cache", None), "_cache_file", None)
    return not isinstance(files, CheckedFiles) or bool(kernel.signatures) or files.any_kept()
