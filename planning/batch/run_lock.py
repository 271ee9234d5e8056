"""Who may run what in a cohort's folder: one run of the whole, or any parts side by side, each once."""

from __future__ import annotations

import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.output_set import disk_is_full
from puncture_twin.planning.batch.part import WHOLE, Part
from puncture_twin.planning.batch.result import WORK_PREFIX

LOCK_NAME = ".puncture-twin-run-lock"
ALLOWED = "one run at a time, parts beside each other (--part i/n), or another folder"


@contextmanager
def running(out: Path, part: Part) -> Iterator[Path]:
    """Hold a part of a cohort; yields a folder for what is being written, which goes in the end.

    The system frees the locks of a process that dies, and its folder is removed by the next run of the same part, or of
    the whole.

    Raises:
        InputError: Another process runs it, or the folder cannot be written to.
    """
    work = out / f"{WORK_PREFIX}{part.number}-of-{part.parts}"
    with ExitStack() as stack:
        try:
            stack.enter_context(_locked(out, LOCK_NAME, fcntl.LOCK_EX if part == WHOLE else fcntl.LOCK_SH))
            if part != WHOLE:
                stack.enter_context(_locked(out, f"{LOCK_NAME}-{part.number}-of-{part.parts}", fcntl.LOCK_EX))
            for left in out.glob(f"{WORK_PREFIX}*") if part == WHOLE else [work]:
                shutil.rmtree(left, ignore_errors=True)
            work.mkdir(exist_ok=True)
        except OSError as error:
            full = disk_is_full(error, out)
            allowed = "a folder with enough free space" if full else "a folder that may be written to"
            raise InputError(f"cannot be written ({error.strerror})", where=out, allowed=allowed) from error
        stack.callback(shutil.rmtree, work, ignore_errors=True)
        yield work


@contextmanager
def _locked(out: Path, name: str, kind: int) -> Iterator[None]:
    handle = os.open(out / name, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise InputError("another run is at work in this folder", where=out, allowed=ALLOWED) from None
    try:
        yield
    finally:
        os.close(handle)
