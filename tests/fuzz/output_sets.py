"""A manifest as a target: whatever it lists, the next run of a command touches nothing that is not its own."""

import tempfile
from pathlib import Path
from typing import NamedTuple

from fuzz.corpus import SET_FILES
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.output.manifest import MANIFEST_NAME, TIMINGS_NAME, problems, read_manifest
from puncture_twin.planning.base.output.output_set import writing

KEPT = ("out/mine.txt", "out/sub/mine.txt", "map.png", "left.csv", "beside/map.png")
"""Files that no manifest of the corpus lists: in the output folder, beside it, and in another folder."""


class Rewritten(NamedTuple):
    """A set before and after a command wrote into it."""

    text: str
    before: tuple[str, ...]
    after: tuple[str, ...]
    read: object
    read_again: object


def rewritten_set(path):
    """Put a manifest into an output folder with files, and let a command write there.

    Raises:
        InputError: The manifest is refused; the folder is as it was then.
        AssertionError: A file is gone that the manifest does not list, or a refusal changed something.
    """
    with tempfile.TemporaryDirectory() as place:
        home, text = Path(place), path.read_bytes().decode("utf-8", "replace")
        for name in (*KEPT, *(f"out/{name}" for name in SET_FILES)):
            (home / name).parent.mkdir(parents=True, exist_ok=True)
            (home / name).write_text(name.removeprefix("out/"))
        (home / "out" / MANIFEST_NAME).write_bytes(path.read_bytes())
        there = contents(home)
        try:
            found = read_manifest(home / "out"), problems(home / "out")
            with writing(home / "out", "search") as draft:
                (draft.folder / "fresh.txt").write_text("fresh")
        except InputError:
            assert contents(home) == there
            raise
        listed = {f"out/{name}" for name in (*found[0].files, *found[0].unfinished)}
        lost = there.items() - contents(home).items()
        assert {name for name, _ in lost} <= {*listed, f"out/{MANIFEST_NAME}"}, lost
        assert not {name for name, _ in lost} & set(KEPT) - listed
        return Rewritten(text, found[1], problems(home / "out"), found[0], read_manifest(home / "out"))


def contents(home):
    files = [path for path in sorted(home.rglob("*")) if path.is_file() and not path.name.startswith(".puncture")]
    return {path.relative_to(home).as_posix(): path.read_bytes() for path in files if path.name != TIMINGS_NAME}


def whole_set(one):
    assert set(one.after) <= set(one.before), (one.before, one.after, one.text)
    assert set(one.read_again.entries["search"].files) == {"fresh.txt"} and one.read_again.unfinished == ()
    assert set(one.read_again.entries) - {"search"} <= set(one.read.entries)
