"""Files that are being written: a draft is a folder of its own inside the output folder, on the same file system."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

from puncture_twin.planning.base.output.manifest import Manifest
from puncture_twin.planning.base.provenance import Input

DRAFT_PREFIX = ".puncture-twin-draft-"
"""Folders of this name are drafts; who holds the folder's lock knows that nobody else is writing to one."""


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
    """

    command: str
    out: Path
    folder: Path
    inputs: Sequence[Input]
    seconds: Mapping[str, float]
    note: Callable[[str], None]
    old: Manifest
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
