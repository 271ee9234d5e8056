"""On which line of a TOML file a table or a key of it stands: its reader does not say."""

from __future__ import annotations

import re
from bisect import bisect_left
from collections.abc import Sequence

TOKENS = re.compile(
    r'"""(?:\\.|[^\\])*?"""'
    r"|'''.*?'''"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'"
    r"|\#[^\n]*"
    r"|^[ \t]*\[\[[ \t]*(?P<kind>[A-Za-z0-9_-]+)[ \t]*\]\]",
    re.MULTILINE | re.DOTALL,
)
"""Strings and comments, so that what stands in them is passed over, and the heads of tables in arrays."""


def line_of(text: str, place: Sequence[str | int]) -> int | None:
    """The line of a place such as ("check", 2, "verdict"), counted from 1; that of its table where it has no own.

    Args:
        text: A valid TOML file.
        place: The array's name, the number of the table from 0 on, and keys; or keys of the file.

    Returns:
        None where the table does not begin with a line ``[[name]]`` of its own.
    """
    heads = [match for match in TOKENS.finditer(text) if match["kind"]]
    if len(place) < 2:
        first = heads[0].start() if heads else len(text)
        key = _key(text, str(place[0]), 0, first) if place else None
        return None if key is None else _line(text, key)
    own = [at for at, match in enumerate(heads) if match["kind"] == place[0]]
    number = int(place[1])
    if number >= len(own):
        return None
    start = heads[own[number]].end()
    end = heads[own[number] + 1].start() if own[number] + 1 < len(heads) else len(text)
    key = _key(text, str(place[2]), start, end) if len(place) > 2 else None
    return _line(text, start if key is None else key)


def table_lines(text: str, kind: str) -> list[int]:
    """The lines of all ``[[kind]]``, counted from 1."""
    breaks = [match.start() for match in re.finditer("\n", text)]
    return [1 + bisect_left(breaks, match.end()) for match in TOKENS.finditer(text) if match["kind"] == kind]


def _key(text: str, key: str, start: int, end: int) -> int | None:
    found = re.compile(rf"^[ \t]*[\"']?({re.escape(key)})\b", re.MULTILINE).search(text, start, end)
    return None if found is None else found.start(1)


def _line(text: str, at: int) -> int:
    return 1 + text.count("\n", 0, at)
