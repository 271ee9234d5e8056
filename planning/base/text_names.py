"""Names that come from files: what a terminal, a page and a table may be given."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from puncture_twin.planning.base.errors import InputError

MAX_NAME = 200
"""Characters of a name; the longest of TotalSegmentator has 29. A longer one is refused, never cut: two names that
differ at their end must not become one."""

ALLOWED_NAME = f"printable characters on one line, {MAX_NAME} at most: no escape sequence, line break or direction mark"


def check_name(name: str, what: str, *, where: str | Path) -> str:
    """A name that may be printed as it is.

    Args:
        name: The name as the file states it.
        what: What it names, for the error: "label 3", "point 2".
        where: The file, for the error.

    Raises:
        InputError: An empty name, one of more than `MAX_NAME` characters, or one with a control or format character.
    """
    if not name.strip():
        raise InputError(f"{what} has an empty name", where=where, allowed=ALLOWED_NAME)
    if len(name) > MAX_NAME:
        raise InputError(f"{what} has a name of {len(name)} characters", where=where, allowed=ALLOWED_NAME)
    if not name.isprintable():
        raise InputError(f"{what} has the name {name!a}", where=where, allowed=ALLOWED_NAME)
    return name


def first_few(names: Sequence[str], most: int = 8) -> str:
    """The first few of a list, and how many more there are.

    >>> first_few(["liver", "colon", "aorta"], 2)
    'liver, colon and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def unprintable_texts(document: object) -> Iterator[str]:
    """Every key and string of a nested document (tables, lists) that holds a control or format character."""
    waiting = [document]
    while waiting:
        one = waiting.pop()
        if isinstance(one, str) and not one.isprintable():
            yield one
        elif isinstance(one, dict):
            waiting += [*one.keys(), *one.values()]
        elif isinstance(one, list | tuple):
            waiting += one
