"""Names of tests that stay what they are when others are added."""

from __future__ import annotations

from collections.abc import Iterable


def unique_names(wanted: Iterable[str]) -> list[str]:
    """Each name as it is wanted; one that is taken already gets the next free number, from 2 on."""
    names: dict[str, None] = {}
    for name in wanted:
        free, number = name, 1
        while free in names:
            number += 1
            free = f"{name}-{number}"
        names[free] = None
    return list(names)
