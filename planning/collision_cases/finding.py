"""What a case was found to be, against what a file expects."""

from __future__ import annotations

from dataclasses import dataclass

from puncture_twin.planning.base.errors import one_line
from puncture_twin.planning.collision_cases.new_number import NewNumber

MOST_LINES, MOST_DIFFERENCES, MOST_CHARACTERS = 15, 6, 300
"""Of a failure: more is not read. Of its lines that say what differs; and of a line."""


@dataclass(frozen=True)
class Difference:
    """One thing that is not as expected.

    Attributes:
        line: What a person reads.
        number: What the file would have to expect; None where only a person may change it.
    """

    line: str
    number: NewNumber | None = None


@dataclass(frozen=True)
class Finding:
    """The result of one test.

    Attributes:
        differences: None where everything is as expected.
        detail: Lines for a person, the most telling first.
        last: How to see all of it; "" where nothing shows more.
    """

    differences: tuple[Difference, ...] = ()
    detail: tuple[str, ...] = ()
    last: str = ""

    def text(self, why: str) -> str:
        """What differs, why it was expected, and what was found, in `MOST_LINES` lines."""
        lines = [difference.line for difference in self.differences]
        if len(lines) > MOST_DIFFERENCES:
            lines[MOST_DIFFERENCES - 1 :] = [f"and {len(lines) - MOST_DIFFERENCES + 1} more that differ"]
        lines += [f"why: {why}"] if why.strip() else []
        last = [self.last] if self.last else []
        lines += [*self.detail[: MOST_LINES - len(lines) - len(last)], *last]
        return "\n".join(line if len(line) <= MOST_CHARACTERS else one_line(line, MOST_CHARACTERS) for line in lines)
