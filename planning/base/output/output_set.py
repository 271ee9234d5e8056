"""One mechanism for every command that writes: an output folder is one set, and no kill leaves a mix that passes.

New files are written into a draft, a folder of its own inside the output folder (the same file system). When all of
them are there:

1. the manifest is replaced by one without the entries that go, which names every file that may be left over;
2. the files are moved in;
3. files of the entries that went are removed;
4. the manifest is replaced by the one with the new entries.

The entries that go are the command's old one, every one that owns a file of the same name, and whatever depends on
those. Whoever is killed before 1 leaves the old set, after 4 the new one, and between them files that no manifest
lists.
"""

from __future__ import annotations

import errno
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

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.legacy import files_of_older_versions
from puncture_twin.planning.base.output.lock import locked
from puncture_twin.planning.base.output.manifest import (
    MANIFEST_NAME,
    TIMINGS_NAME,
    Manifest,
    ManifestEntry,
    file_digest,
    read_manifest,
)
from puncture_twin.planning.base.output.timings import with_timings
from puncture_twin.planning.base.provenance import Input

DRAFT_PREFIX = ".puncture-twin-draft-"
"""Folders of this name are drafts; who holds the folder's lock knows that nobody else is writing to one."""

NO_SPACE = frozenset({errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO})
"""What the system says of a disk that takes no more."""

LITTLE_SPACE_BYTES = 65_536
"""A library's failure without a number, on a disk with less than this, is the disk's."""


@dataclass(eq=False)
class Draft:
    """Files that are being written and belong to nothing yet.

    Attributes:
        command: Whose; the name of its entry.
        out: The output folder.
        folder: Where the files are written.
        depends_on: Entries of the output folder that these files are made from.
        parts: Files that go to an entry of another name than the command's.
        seconds: How long each stage took, for ``timings.json``; read at the end.
        note: Told what was removed that nobody might expect.
        old: What the output folder holds.
        legacy: Files in it that an older version left without a manifest.
    """

    command: str
    out: Path
    folder: Path
    inputs: Sequence[Input]
    seconds: Mapping[str, float]
    note: Callable[[str], None]
    old: Manifest
    legacy: tuple[str, ...]
    depends_on: tuple[str, ...] = ()
    parts: dict[str, str] = field(default_factory=dict)

    def final(self, files: Iterable[Path]) -> tuple[Path, ...]:
        """Where files of the draft will lie."""
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
        command: Name of the entry.
        inputs: Every file that decides the result.
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
        stack.enter_context(_folder(out))
        stack.enter_context(locked(out))
        _sweep(out)
        draft = Draft(command, out, out, inputs, seconds or {}, note or _silent, *_found(out))
        _refuse_foreign(draft, names)
        draft.depends_on = _sources(draft, made_from or {})
        draft.folder, started = _new_draft(out, stack), datetime.now(UTC)
        yield draft
        _publish(draft, started)


def withdraw(out: Path, command: str, *, keep: Iterable[str] = ()) -> None:
    """Remove what a command left earlier, where a new run was refused: an old answer must not stand beside it.

    Args:
        out: The output folder; untouched where no command has written into it.
        command: Name of the entry.
        keep: Files of the entry that stay: they may be the input.
    """
    if out.is_dir() and (read_manifest(out) or files_of_older_versions(out)):
        with writing(out, command) as draft:
            for name in keep:
                draft.keep(name)


def _silent(_: str) -> None:
    """Says nothing."""


@contextmanager
def _explained(out: Path) -> Iterator[None]:
    """A disk that takes no more is bad input, not a failure of the program."""
    try:
        yield
    except OSError as error:
        if error.errno not in NO_SPACE and not (error.errno is None and _full(out)):
            raise
        reason = os.strerror(error.errno or errno.ENOSPC)
        what = f"cannot be written ({reason}); what it held before is untouched"
        raise InputError(what, where=out, allowed="a folder with enough free space") from error


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
        raise InputError(what, where=out, allowed="a folder that may be written to") from error
    try:
        yield
    finally:
        with suppress(OSError):
            for place in missing:
                place.rmdir()


def _new_draft(out: Path, stack: ExitStack) -> Path:
    draft = Path(tempfile.mkdtemp(prefix=f"{DRAFT_PREFIX}{os.getpid()}-", dir=out))
    stack.callback(shutil.rmtree, draft, ignore_errors=True)
    for part in ("files", "state"):
        (draft / part).mkdir()
    return draft / "files"


def _sweep(out: Path) -> None:
    """Remove drafts of the dead: the lock is held, so nobody else is writing."""
    for path in out.glob(f"{DRAFT_PREFIX}*"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)


def _found(out: Path) -> tuple[Manifest, tuple[str, ...]]:
    """What the folder holds, and which files of it an older version left without a manifest."""
    manifest = read_manifest(out)
    if manifest is not None:
        return manifest, ()
    legacy = files_of_older_versions(out)
    return Manifest({}, legacy), legacy


def _sources(draft: Draft, made_from: Mapping[str, str]) -> tuple[str, ...]:
    """The entries that own the sources.

    Raises:
        InputError: The folder's set has another file of that name: what is made now would stand beside it.
    """
    owners = []
    for name, digest in made_from.items():
        owner = draft.old.owner(name)
        if owner is not None:
            if draft.old.files[name] != digest:
                allowed = f"another folder: what is made from one {name} does not belong beside another"
                raise InputError(f"holds another {name}", where=draft.out, allowed=allowed)
            owners.append(owner)
    return tuple(owners)


def _publish(draft: Draft, started: datetime) -> None:
    """Make the draft's files the command's set."""
    out, old, state = draft.out, draft.old, draft.folder.parent / "state"
    new = _entries(draft)
    files = {name for entry in new.values() for name in entry.files}
    gone = _gone(old, {draft.command, *new}, files)
    _refuse_foreign(draft, files)
    kept = {name: entry for name, entry in old.entries.items() if name not in gone}
    left = files.union(old.unfinished, *(old.entries[name].files for name in gone))
    (state / "before").write_text(Manifest(kept, tuple(sorted(left))).text(), encoding="utf-8")
    (state / "after").write_text(Manifest({**kept, **new}).text(), encoding="utf-8")
    timings = with_timings(out, kept, draft.command, started, draft.seconds)
    (state / "timings").write_text(timings, encoding="utf-8")
    with _uninterrupted():
        (state / "before").replace(out / MANIFEST_NAME)
        for name in sorted(files):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (draft.folder / name).replace(out / name)
        _remove(out, left - files)
        (state / "timings").replace(out / TIMINGS_NAME)
        (state / "after").replace(out / MANIFEST_NAME)
    _tell(draft, gone - {draft.command, *new} - _dependents(old, {draft.command, *new}))


def _entries(draft: Draft) -> dict[str, ManifestEntry]:
    """The new entries, from the files in the draft."""
    files: dict[str, dict[str, str]] = {draft.command: {}}
    for path in sorted(draft.folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(draft.folder).as_posix()
            files.setdefault(draft.parts.get(name, draft.command), {})[name] = file_digest(path)
    own = version("puncture-twin")
    return {
        name: ManifestEntry(
            own, tuple(draft.inputs), draft.depends_on if name == draft.command else (draft.command,), listed
        )
        for name, listed in files.items()
        if listed
    }


def _gone(old: Manifest, new: set[str], files: set[str]) -> set[str]:
    """The old entries that a new one replaces, robs of a file, or leaves without what they depend on."""
    gone = {name for name, entry in old.entries.items() if name in new or files & set(entry.files)}
    return gone | _dependents(old, gone)


def _dependents(old: Manifest, names: set[str]) -> set[str]:
    """The entries that depend on some, directly or through others."""
    found: set[str] = set()
    while more := {name for name, entry in old.entries.items() if {*names, *found} & set(entry.depends_on)} - found:
        found |= more
    return found


def _refuse_foreign(draft: Draft, files: Iterable[str]) -> None:
    """Never overwrite what no run of this program has written.

    Raises:
        InputError: Names the first such file.
    """
    known = {*draft.old.files, *draft.old.unfinished}
    if (draft.out / MANIFEST_NAME).exists():
        known.add(TIMINGS_NAME)
    for name in sorted({*files, TIMINGS_NAME} - known):
        foreign = _in_the_way(draft.out, name)
        if foreign is not None:
            what = f"{name} is to be written, but the file {foreign} there comes from no run of this program"
            raise InputError(what, where=draft.out, allowed="another folder, or this one without that file")


def _in_the_way(out: Path, name: str) -> str | None:
    """What stands under a name that is to be written, or where a sub-folder of it must be; a link leads elsewhere."""
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


def _tell(draft: Draft, others: set[str]) -> None:
    """Name what went although neither the command's own nor made from it."""
    if others:
        named = ", ".join(sorted(others))
        draft.note(f"{draft.out}: the files of {named} were removed: {draft.command} has replaced a part of them")
    if draft.legacy:
        named = ", ".join(draft.legacy)
        draft.note(f"{draft.out}: files of an older version, without a manifest, were replaced or removed: {named}")


@contextmanager
def _uninterrupted() -> Iterator[None]:
    """Put Ctrl-C off until the end of the block: some renames, a millisecond."""
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
