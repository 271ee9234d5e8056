"""The exceptions of the planner: few, and each says what was wrong, where, and what is allowed."""

from __future__ import annotations

from pathlib import Path


class PlanningError(Exception):
    """Base of everything that the planner raises on purpose."""


class InputError(PlanningError):
    """Input that cannot be used. The command line prints it as one line and exits with code 2.

    Args:
        what: What is wrong, with the offending value.
        where: The file, and the place in it (key, line, marker name).
        allowed: What would have been accepted.
    """

    def __init__(self, what: str, *, where: str | Path, allowed: str) -> None:
        self.what = _one_line(what)
        self.where = _one_line(str(where))
        self.allowed = _one_line(allowed)
        super().__init__(f"{self.where}: {self.what}; allowed: {self.allowed}")


class NoAnswerError(PlanningError):
    """The work was done and the answer is no. The command line exits with code 1.

    Args:
        message: What was not found.
        counts: How many candidates fell to which reason.
    """

    def __init__(self, message: str, *, counts: dict[str, int] | None = None) -> None:
        self.counts = dict(counts or {})
        super().__init__(message)


def _one_line(text: str) -> str:
    words = " ".join(text.split())
    return "".join(c if c.isprintable() else "?" for c in words)
