"""Writing of an output folder as one locked set, for every command: no kill leaves a mix that passes.

New files are written into a draft, a folder of its own inside the output folder. When all of them are there:

1. the manifest is replaced by one without the entries that go, which names every file that may be left over;
2. the files are moved in;
3. files of the entries that went are removed;
4. the manifest is replaced by the one with the new entries.

The entries that go are the command's old one, every one that owns a file of the same name, and whatever depends on
those. Whoever is killed before 1 leaves the old set, after 4 the new one, and between them files that no manifest
lists.
"""

import errno
import fcntl
import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import FrameType

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.output import manifest
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.strict_json import read_json
from puncture_twin.planning.base.text import first_few

NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO})
"""The system's error numbers of a full disk."""
LITTLE_SPACE_BYTES = 65_536
"""A library's failure without a number, on a disk with less than this, is the disk's."""
LOCK_NAME = ".puncture-twin-lock"
"""File that lies in the folder while a command writes into it; without its process it locks nothing."""
DRAFT_PREFIX = ".puncture-twin-draft-"
"""Folders of this name are drafts; who holds the folder's lock knows that nobody else is writing to one."""


@dataclass(eq=False)
class Draft:
    """Files of a command that are being written and belong to no set yet."""

    command: str  # whose; the name of its entry
    out: Path
    folder: Path
    inputs: Sequence[Input]
    seconds: Mapping[str, float]  # how long each stage took, for ``timings.json``; read at the end
    note: Callable[[str], None] | None
    old: manifest.Manifest
    depends_on: tuple[str, ...] = ()  # entries of the output folder that these files are made from
    parts: dict[str, str] = field(default_factory=dict)  # files that go to an entry of another name than the command's

    def final(self, files: Iterable[Path]) -> tuple[Path, ...]:
        """Path at which each file of the draft will be."""
        return tuple(self.out / path.relative_to(self.folder) for path in files)

    def split(self, command: str, *files: Path) -> None:
        """Give files to an entry of their own, which depends on this command's."""
        self.parts |= {path.relative_to(self.folder).as_posix(): command for path in files}

    def source_has(self, name: str) -> bool:
        """Whether an entry that this draft depends on has a file of this name in the output folder."""
        return self.old.owner(name) in self.depends_on

    def keep(self, name: str) -> None:
        """Take over a file of the command's old entry as it is, if that has it: it may be the input of this run."""
        if self.old.owner(name) == self.command and (self.out / name).is_file():
            shutil.copyfile(self.out / name, self.folder / name)


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
    """
    with _explained(out), ExitStack() as stack:
        with uninterrupted():  # no folder, lock or draft without what removes it
            stack.enter_context(_folder(out))
            stack.enter_context(locked(out))
            for path in out.glob(f"{DRAFT_PREFIX}*"):  # of the dead: the lock is held, so nobody else is writing
                if path.is_dir() and not path.is_symlink():
                    shutil.rmtree(path, ignore_errors=True)
            folder = Path(tempfile.mkdtemp(prefix=f"{DRAFT_PREFIX}{os.getpid()}-", dir=out))
            stack.callback(shutil.rmtree, folder, ignore_errors=True)
            for part in ("files", "state"):
                (folder / part).mkdir()
        old = manifest.read_manifest(out) or manifest.Manifest({})
        draft = Draft(command, out, folder / "files", inputs, seconds or {}, note, old)
        _refuse_foreign(draft, names)
        owned = {name: owner for name in made_from or {} if (owner := old.owner(name)) is not None}
        for name in owned:
            if made_from and old.files[name] != made_from[name]:
                allowed = f"another folder: outputs of different {name}s are not mixed"
                refuse(f"has outputs of another {name}", out, allowed, "folder_of_another")
        draft.depends_on, started = tuple(owned.values()), datetime.now(UTC)
        yield draft
        _publish(draft, started)


def withdraw(out: Path, command: str, *, keep: Iterable[str] = ()) -> None:
    """Remove what a command left earlier, where a new run was refused: an old answer must not stand beside it.

    Nothing is touched where no command has written; ``keep``: files of its entry that stay, as they may be the input.
    """
    if out.is_dir() and manifest.read_manifest(out):
        with writing(out, command) as draft:
            for name in keep:
                draft.keep(name)


def _publish(draft: Draft, started: datetime) -> None:
    """Make the draft's files the command's set."""
    out, old, state = draft.out, draft.old, draft.folder.parent / "state"
    new = _entries(draft)
    files = {name for entry in new.values() for name in entry.files}
    own = {draft.command, *new}
    # The old entries that a new one replaces, robs of a file, or leaves without what they depend on.
    gone = {name for name, entry in old.entries.items() if name in own or files & set(entry.files)}
    gone |= _dependents(old, gone)
    _refuse_foreign(draft, files)
    stays = {name: entry for name, entry in old.entries.items() if name not in gone}
    left = files.union(old.unfinished, *(old.entries[name].files for name in gone))
    (state / "before").write_text(manifest.Manifest(stays, tuple(sorted(left))).text(), encoding="utf-8")
    (state / "after").write_text(manifest.Manifest({**stays, **new}).text(), encoding="utf-8")
    (state / "timings").write_text(_timings(draft, stays, started), encoding="utf-8")
    with uninterrupted():
        (state / "before").replace(out / manifest.MANIFEST_NAME)
        for name in sorted(files):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (draft.folder / name).replace(out / name)
        _remove(out, left - files)
        (state / "timings").replace(out / manifest.TIMINGS_NAME)
        (state / "after").replace(out / manifest.MANIFEST_NAME)
    # What went is named: what the command itself wrote earlier, or was made from that, and what is of others.
    others = gone - own - _dependents(old, own)
    outdated = {name for entry in gone - others for name in old.entries[entry].files} - files
    if outdated and draft.note:
        draft.note(f"{out}: {first_few(sorted(outdated))} of an earlier run removed: not part of this {draft.command}")
    if others and draft.note:
        named = ", ".join(sorted(others))
        draft.note(f"{out}: the files of {named} were removed: {draft.command} replaced some of them")


def _entries(draft: Draft) -> dict[str, manifest.ManifestEntry]:
    """The new entries, from the files in the draft."""
    files: dict[str, dict[str, str]] = {draft.command: {}}
    for path in sorted(draft.folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(draft.folder).as_posix()
            files.setdefault(draft.parts.get(name, draft.command), {})[name] = manifest.file_digest(path)
    own, inputs = version("puncture-twin"), tuple(draft.inputs)
    depends_on = {draft.command: draft.depends_on}
    return {
        name: manifest.ManifestEntry(own, inputs, depends_on.get(name, (draft.command,)), listed)
        for name, listed in files.items()
        if listed
    }


def _dependents(old: manifest.Manifest, names: set[str]) -> set[str]:
    """The entries that depend on some, directly or through others."""
    above: set[str] = set()
    while more := {name for name, entry in old.entries.items() if {*names, *above} & set(entry.depends_on)} - above:
        above |= more
    return above


def _refuse_foreign(draft: Draft, files: Iterable[str]) -> None:
    """Refuse to overwrite what no run of this program has written. Raises InputError: names the first such file."""
    known = {*draft.old.files, *draft.old.unfinished}
    if (draft.out / manifest.MANIFEST_NAME).exists():
        known.add(manifest.TIMINGS_NAME)
    for name in sorted({*files, manifest.TIMINGS_NAME} - known):
        foreign = _foreign_entry(draft.out, name)
        if foreign is not None:
            what = f"{name} would be written, but the existing file {foreign} is not from this program"
            refuse(what, draft.out, "another folder, or remove that file", "foreign_file")


def _foreign_entry(out: Path, name: str) -> str | None:
    """An entry that is in the way of a file or sub-folder that is to be written; a link leads elsewhere."""
    place = out / name
    for folder in reversed(Path(name).parents[:-1]):
        if (out / folder).is_symlink() or ((out / folder).exists() and not (out / folder).is_dir()):
            return folder.as_posix()
    return name if place.exists() or place.is_symlink() else None


def _remove(out: Path, names: Iterable[str]) -> None:
    """Remove files, and sub-folders that are empty then; nothing outside of the folder."""
    home = out.resolve()
    for name in sorted(names):
        path = out / name
        if path.parent.resolve().is_relative_to(home) and not path.is_dir():
            path.unlink(missing_ok=True)
            with suppress(OSError):
                for parent in path.relative_to(out).parents[:-1]:
                    (out / parent).rmdir()


def _timings(draft: Draft, stays: Iterable[str], started: datetime) -> str:
    """The folder's timings with those of the command put in; those of entries that stay are kept."""
    try:
        document = read_json(
            draft.out / manifest.TIMINGS_NAME, max_bytes=manifest.MAX_MANIFEST_BYTES, allowed="timings"
        )
    except InputError:  # no result depends on it
        document = {}
    before = document if isinstance(document, dict) else {}
    timings = {name: before[name] for name in stays if name in before}
    seconds = {stage: round(float(spent), 3) for stage, spent in draft.seconds.items()}
    timings[draft.command] = {"started": started.isoformat(timespec="seconds"), "seconds": seconds}
    return json.dumps(timings, indent=1, allow_nan=False) + "\n"


@contextmanager
def uninterrupted() -> Iterator[None]:
    """Put Ctrl-C off until the end of the block: some renames or folders, milliseconds."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    came: list[tuple[int, FrameType | None]] = []
    before = signal.signal(signal.SIGINT, lambda number, frame: came.append((number, frame)))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if came and callable(before):
        before(*came[0])


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
    """Whether the disk of a folder is full; some libraries fail without a number."""
    with suppress(OSError):
        return error.errno in NO_SPACE or (error.errno is None and shutil.disk_usage(out).free < LITTLE_SPACE_BYTES)
    return False


@contextmanager
def _folder(out: Path) -> Iterator[None]:
    """Context with the folder made, and removed again if it stays empty."""
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


@contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the lock of an existing folder. Raises InputError: another process holds it, or there are no locks."""
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
        try:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        except OSError as error:
            what = f"cannot be written ({error.strerror})"
            where = path.parent
            raise InputError(what, where=where, allowed="a writable folder", code="unwritable") from error
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


def _is_at(handle: int, path: Path) -> bool:
    """Whether the file is still the one of that name: its last holder may have removed it meanwhile."""
    try:
        return os.path.samestat(os.fstat(handle), path.stat())
    except FileNotFoundError:
        return False
