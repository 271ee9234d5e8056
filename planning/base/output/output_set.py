"""One mechanism for every command that writes: an output folder is one locked set; no kill leaves a mix that passes.

New files are written into a draft (`draft`); when all of them are there they become the command's set (`publish`).
"""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.output.manifest import Manifest, read_manifest
from puncture_twin.planning.base.output.publish import Draft, new_draft, publish, refuse_foreign, sweep, uninterrupted
from puncture_twin.planning.base.provenance import Input

NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO})
"""What the system says of a disk that takes no more."""

LITTLE_SPACE_BYTES = 65_536
"""A library's failure without a number, on a disk with less than this, is the disk's."""

LOCK_NAME = ".puncture-twin-lock"
"""Lies in the folder while a command writes into it; without its process it locks nothing."""


@contextmanager
def writing(
    out: Path,
    command: str,
    *,
    inputs: Sequence[Input] = (),
    seconds: Mapping[str, float] | None = None,
    names: Iterable[str] = (),
    made_from: Mapping[str, str] | None = None,
    note: Callable[[str], None] | None = None,
) -> Iterator[Draft]:
    """Yield a draft; when the block ends without an exception, its files become the command's set.

    Args:
        out: The output folder; made where it is missing.
        seconds: How long each stage took; read when the block ends.
        names: Files that will be written, as far as they are known: one that is somebody else's is refused at once.
        made_from: Name to SHA-256 of outputs of earlier commands that this one starts from. Where the folder's set has
            a file of that name, it must be that one, and the new entry depends on its entry.
        note: Told in a sentence what was removed that nobody might expect.

    Raises:
        InputError: The folder cannot be written to, is full, is being written to, holds a foreign file under a name
            that is to be written, or another source than ``made_from``.
    """
    with _explained(out), ExitStack() as stack:
        with uninterrupted():  # no folder, lock or draft without what removes it
            stack.enter_context(_folder(out))
            stack.enter_context(locked(out))
            sweep(out)
            folder = new_draft(out, stack)
        draft = Draft(command, out, out, inputs, seconds or {}, note or _silent, read_manifest(out) or Manifest({}))
        refuse_foreign(draft, names)
        draft.depends_on = _sources(draft, made_from or {})
        draft.folder, started = folder, datetime.now(UTC)
        yield draft
        publish(draft, started)


def withdraw(out: Path, command: str, *, keep: Iterable[str] = ()) -> None:
    """Remove what a command left earlier, where a new run was refused: an old answer must not stand beside it.

    Args:
        out: The output folder; untouched where no command has written into it.
        keep: Files of the entry that stay: they may be the input.
    """
    if out.is_dir() and read_manifest(out):
        with writing(out, command) as draft:
            for name in keep:
                draft.keep(name)


def _silent(_: str) -> None:
    """Says nothing."""


@contextmanager
def _explained(out: Path) -> Iterator[None]:
    """Context in which a full disk is reported as bad input, not as a failure of the program."""
    try:
        yield
    except OSError as error:
        if not disk_is_full(error, out):
            raise
        reason = os.strerror(error.errno or errno.ENOSPC)
        what = f"cannot be written ({reason}); its earlier content is unchanged"
        raise InputError(what, where=out, allowed="a folder with enough free space", code="unwritable") from error


def disk_is_full(error: OSError, out: Path) -> bool:
    """Whether it is the disk of a folder that takes no more; some libraries fail without a number."""
    return error.errno in NO_SPACE or (error.errno is None and _full(out))


def _full(out: Path) -> bool:
    with suppress(OSError):
        return shutil.disk_usage(out).free < LITTLE_SPACE_BYTES
    return False


@contextmanager
def _folder(out: Path) -> Iterator[None]:
    """Make the folder, and remove it again if nothing came to lie in it."""
    missing = [place for place in (out, *out.parents) if not place.exists()]
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        if error.errno in NO_SPACE:
            raise
        what = f"cannot be written ({error.strerror})"
        raise InputError(what, where=out, allowed="a writable folder", code="unwritable") from error
    try:
        yield
    finally:
        with suppress(OSError):
            for place in missing:
                place.rmdir()


def _sources(draft: Draft, made_from: Mapping[str, str]) -> tuple[str, ...]:
    """The entries that own the sources."""
    owners = []
    for name, digest in made_from.items():
        owner = draft.old.owner(name)
        if owner is not None:
            if draft.old.files[name] != digest:
                allowed = f"another folder: outputs of different {name}s are not mixed"
                refuse(f"has outputs of another {name}", draft.out, allowed, "folder_of_another")
            owners.append(owner)
    return tuple(owners)


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of an existing folder.

    Raises:
        InputError: Another process holds it, or the file system knows no locks.
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
            allowed = "one command at a time, or another folder"
            raise InputError(what, where=path.parent, allowed=allowed, code="folder_in_use") from None
        except OSError as error:
            os.close(handle)
            what = f"the folder cannot be locked ({error.strerror})"
            allowed = "a folder on a file system that supports locks"
            raise InputError(what, where=path.parent, allowed=allowed, code="folder_not_locked") from error
        os.close(handle)


def _opened(path: Path) -> int:
    try:
        return os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        what = f"cannot be written ({error.strerror})"
        where = path.parent
        raise InputError(what, where=where, allowed="a writable folder", code="unwritable") from error


def _is_at(handle: int, path: Path) -> bool:
    """Whether the file is still the one of that name: its last holder may have removed it meanwhile."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
