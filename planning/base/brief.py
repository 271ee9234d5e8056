"""One line for a value that holds arrays: what ``print`` and a prompt show."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import TypeVar

from puncture_twin.planning.base.errors import one_line

Value = TypeVar("Value")


def brief(describe: Callable[[Value], str]) -> Callable[[Value], str]:
    """Make a ``__repr__`` of a method that says what a value holds; it never raises: a failing test prints values too.

    >>> class Grid:
    ...     @brief
    ...     def __repr__(self) -> str:
    ...         return "3 directions"
    >>> Grid()
    <Grid: 3 directions>
    """

    @functools.wraps(describe)
    def shown(value: Value) -> str:
        try:
            return f"<{type(value).__name__}: {one_line(describe(value))}>"
        except Exception:  # a value that is only half made still has a name
            return object.__repr__(value)

    return shown
