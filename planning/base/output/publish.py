"""Publish a set of output files: from a draft folder to the command's own.

When all files of a draft are there:

1. the manifest is replaced by one without the entries that go, which names every file that may be left over;
2. the files are moved in;
3. files of the entries that went are removed;
4. the manifest is replaced by the one with the new entries.

The entries that go are the command's old one, every one that owns a file of the same name, and whatever depends on
those. Whoever is killed before 1 leaves the old set, after 4 the new one, and between them files that no manifest
lists.

Files that are being written: a draft is a folder of its own inside the output folder, on the same file system.
"""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import version
from pathlib import Path
from types import FrameType
from typing import Any

from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.output import manifest
from puncture_twin.planning.base.provenance import Input
from puncture_twin.planning.base.strict_json import read_json

MOST_NAMED = 8
"""Of the files that went; a series of slices has hundreds."""


def publish(draft: Draft, started: datetime) -> None:
    """Make the draft's files the command's set."""
    out, old, state = draft.out, draft.old, draft.folder.parent / "state"
    new = _entries(draft)
    files = {name for entry in new.values() for name in entry.files}
    gone = _gone(old, {draft.command, *new}, files)
    refuse_foreign(draft, files)
    kept = {name: entry for name, entry in old.entries.items() if name not in gone}
    left = files.union(old.unfinished, *(old.entries[name].files for name in gone))
    (state / "before").write_text(manifest.Manifest(kept, tuple(sorted(left))).text(), encoding="utf-8")
    (state / "after").write_text(manifest.Manifest({**kept, **new}).text(), encoding="utf-8")
    timings = with_timings(out, kept, draft.command, started, draft.seconds)
    (state / "timings").write_text(timings, encoding="utf-8")
    with uninterrupted():
        (state / "before").replace(out / manifest.MANIFEST_NAME)
        for name in sorted(files):
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (draft.folder / name).replace(out / name)
        _remove(out, left - files)
        (state / "timings").replace(out / manifest.TIMINGS_NAME)
        (state / "after").replace(out / manifest.MANIFEST_NAME)
    others = gone - {draft.command, *new} - _dependents(old, {draft.command, *new})
    _report_outdated(draft, {name for entry in gone - others for name in old.entries[entry].files} - files)
    _report_removed(draft, others)


def _entries(draft: Draft) -> dict[str, manifest.ManifestEntry]:
    """The new entries, from the files in the draft."""
    files: dict[str, dict[str, str]] = {draft.command: {}}
    for path in sorted(draft.folder.rglob("*")):
        if path.is_file():
            name = path.relative_to(draft.folder).as_posix()
            files.setdefault(draft.parts.get(name, draft.command), {})[name] = manifest.file_digest(path)
    own = version("puncture-twin")
    return {
        name: manifest.ManifestEntry(
            own, tuple(draft.inputs), draft.depends_on if name == draft.command else (draft.command,), listed
        )
        for name, listed in files.items()
        if listed
    }


def _gone(old: manifest.Manifest, new: set[str], files: set[str]) -> set[str]:
    """The old entries that a new one replaces, robs of a file, or leaves without what they depend on."""
    gone = {name for name, entry in old.entries.items() if name in new or files & set(entry.files)}
    return gone | _dependents(old, gone)


def _dependents(old: manifest.Manifest, names: set[str]) -> set[str]:
    """The entries that depend on some, directly or through others."""
    found: set[str] = set()
    while more := {name for name, entry in old.entries.items() if {*names, *found} & set(entry.depends_on)} - found:
        found |= more
    return found


def refuse_foreign(draft: Draft, files: Iterable[str]) -> None:
    """Never overwrite what no run of this program has written.

    Raises:
        InputError: Names the first such file.
    """
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


def _report_outdated(draft: Draft, names: set[str]) -> None:
    """Name what the command itself wrote earlier, or was made from that, and is not written anew."""
    if not names:
        return
    first, more = sorted(names)[:MOST_NAMED], max(len(names) - MOST_NAMED, 0)
    named = ", ".join(first) + (f" and {more} more" if more else "")
    draft.note(f"{draft.out}: {named} of an earlier run removed: not part of this {draft.command}")


def _report_removed(draft: Draft, others: set[str]) -> None:
    """Name what went although neither the command's own nor made from it."""
    if others:
        named = ", ".join(sorted(others))
        draft.note(f"{draft.out}: the files of {named} were removed: {draft.command} replaced some of them")


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


def with_timings(
    folder: Path, kept: Iterable[str], command: str, started: datetime, seconds: Mapping[str, float]
) -> str:
    """The folder's timings with those of a command put in.

    Args:
        kept: Commands whose entries stay, and so their timings.
    """
    before = _read(folder / manifest.TIMINGS_NAME)
    timings = {name: before[name] for name in kept if name in before}
    timings[command] = {
        "started": started.isoformat(timespec="seconds"),
        "seconds": {stage: round(float(spent), 3) for stage, spent in seconds.items()},
    }
    return json.dumps(timings, indent=1, allow_nan=False) + "\n"


def _read(path: Path) -> dict[str, Any]:
    """Bytes of a file; nothing where it cannot be read: no result depends on it."""
    try:
        document = read_json(path, max_bytes=manifest.MAX_MANIFEST_BYTES, allowed="timings")
    except InputError:
        return {}
    return document if isinstance(document, dict) else {}


DRAFT_PREFIX = ".puncture-twin-draft-"
"""Folders of this name are drafts; who holds the folder's lock knows that nobody else is writing to one."""


@dataclass(eq=False)
class Draft:
    """Files that are being written and belong to nothing yet.

    Attributes:
        command: Whose; the name of its entry.
        depends_on: Entries of the output folder that these files are made from.
        parts: Files that go to an entry of another name than the command's.
        seconds: How long each stage took, for ``timings.json``; read at the end.
    """

    command: str
    out: Path
    folder: Path
    inputs: Sequence[Input]
    seconds: Mapping[str, float]
    note: Callable[[str], None]
    old: manifest.Manifest
    depends_on: tuple[str, ...] = ()
    parts: dict[str, str] = field(default_factory=dict)

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


def new_draft(out: Path, stack: ExitStack) -> Path:
    """A folder for the files; it goes with the stack, whatever happens."""
    draft = Path(tempfile.mkdtemp(prefix=f"{DRAFT_PREFIX}{os.getpid()}-", dir=out))
    stack.callback(shutil.rmtree, draft, ignore_errors=True)
    for part in ("files", "state"):
        (draft / part).mkdir()
    return draft / "files"


def sweep(out: Path) -> None:
    """Remove drafts of the dead: the lock is held, so nobody else is writing."""
    for path in out.glob(f"{DRAFT_PREFIX}*"):
        if path.is_dir() and not path.is_symlink():
            shutil.rmtree(path, ignore_errors=True)
