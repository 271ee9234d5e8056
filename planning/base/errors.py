"""The exceptions of the planner: few, and each says what was wrong, where, and what is allowed."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any

MOST_WHAT, MOST_WHERE, MOST_ALLOWED = 400, 300, 600
"""Characters of an error's parts: what is longer loses its middle, so that the line can still be read."""

MOST_MESSAGE = 1_500
"""Characters of any other line."""


class PlanningError(Exception):
    """Base of everything that the planner raises on purpose."""

    def __reduce__(self) -> tuple[Any, ...]:
        """With all its parts, which a process that sends it makes again; they do not follow from the message alone."""
        return _error_again, (type(self), self.args, vars(self))


def _error_again(kind: type[PlanningError], arguments: tuple[Any, ...], parts: dict[str, Any]) -> PlanningError:
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    vars(error).update(parts)
    return error


class InputError(PlanningError):
    """Input that cannot be used. The command line prints it as one line and exits with code 2.

    Args:
        what: What is wrong, with the offending value.
        where: The file, and the place in it (key, line, marker name).
        allowed: What would have been accepted.
        code: What kind of fault it is, in one word, for those who ask a program and not a person.
        numbers: What was measured, by name with its unit.
    """

    most_what = MOST_WHAT
    """Characters of what is wrong."""

    def __init__(
        self,
        what: str,
        *,
        where: str | Path,
        allowed: str,
        code: str = "",
        numbers: Mapping[str, Any] = MappingProxyType({}),
    ) -> None:
        self.code, self.numbers = code, dict(numbers)
        self.what = one_line(what, self.most_what)
        self.where = one_line(str(where), MOST_WHERE)
        self.allowed = one_line(allowed, MOST_ALLOWED)
        super().__init__(f"{self.where}: {self.what}; allowed: {self.allowed}")


class InputListError(InputError):
    """Several things that are wrong with one input, in one line."""

    most_what = 900


class NoAnswerError(PlanningError):
    """The work was done and the answer is no. The command line exits with code 1.

    Args:
        message: What was not found.
        counts: How many candidates fell to which reason.
    """

    def __init__(self, message: str, *, counts: dict[str, int] | None = None) -> None:
        self.counts = dict(counts or {})
        super().__init__(message)


class CacheWarning(UserWarning):
    """Something kept from an earlier run could not be trusted and was made anew: the answer is the same."""


def one_line(text: str, most: int = MOST_MESSAGE) -> str:
    """A text as one printable line.

    Args:
        text: Any text.
        most: Characters, from 3 on; a longer text loses its middle.
    """
    line = " ".join(text.split())
    if len(line) > most:
        head = (most - 3) // 2
        line = line[:head] + "..." + line[len(line) - (most - 3 - head) :]
    return "".join(c if c.isprintable() else "?" for c in line)
