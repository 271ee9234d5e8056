"""One writer at a time in an output folder. The system frees the lock of a process that dies."""

from __future__ import annotations

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from puncture_twin.planning.base.errors import InputError

LOCK_NAME = ".puncture-twin-lock"
"""Lies in the folder while a command writes into it; without its process it locks nothing."""


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of an existing folder.

    Raises:
        InputError: Another process holds it, or the file system knows no locks.
        OSError: The lock file cannot be made.
    """
    path = folder / LOCK_NAME
    handle = _locked(path)
    try:
        os.truncate(handle, 0)
        os.write(handle, str(os.getpid()).encode())
        yield
    finally:
        path.unlink(missing_ok=True)  # while the lock is held: nobody else's file stands under this name
        os.close(handle)


def _locked(path: Path) -> int:
    """An open, locked handle on the file that stands under the name."""
    while True:
        handle = _opened(path)
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            if _is_at(handle, path):
                return handle
        except BlockingIOError:
            holder = os.pread(handle, 20, 0).decode(errors="replace")
            os.close(handle)
            what = f"another command is writing into this folder (process {holder or 'unknown'})"
            raise InputError(what, where=path.parent, allowed="one at a time, or another folder") from None
        except OSError as error:
            os.close(handle)
            what = f"the folder cannot be locked ({error.strerror})"
            raise InputError(what, where=path.parent, allowed="a folder on a file system with locks") from error
        os.close(handle)


def _opened(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        raise InputError(what, where=path.parent, allowed="a folder that may be written to") from error


def _is_at(handle: int, path: Path) -> bool:
    """Whether the file is still the one of that name: its last holder may have removed it meanwhile."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
