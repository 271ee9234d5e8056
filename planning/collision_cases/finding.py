"""What a case was found to be, against what a file expects, and the number that a file would have to expect."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal

from puncture_twin.planning.base.errors import one_line

MOST_DECIMALS = 17
"""More than a double has."""

MOST_LINES, MOST_DIFFERENCES, MOST_CHARACTERS = 15, 6, 300
"""Of a failure: more is not read. Of its lines that say what differs; and of a line."""


@dataclass(frozen=True)
class NewNumber:
    """What was found for a key.

    Attributes:
        keys: From the table inward.
        value: As computed.
        within: By how much the written number may differ.
        rounding: `ROUND_FLOOR` for a least value, `ROUND_CEILING` for a largest one: what is written must be satisfied.
    """

    keys: tuple[str, ...]
    value: float
    within: float
    rounding: str = ROUND_HALF_EVEN

    @property
    def is_limit(self) -> bool:
        """Whether it is a bound that a person demands, which a rewrite makes weaker."""
        return self.rounding in {ROUND_FLOOR, ROUND_CEILING}

    def written(self, old: str) -> str:
        """The number as text, with the old text's decimals, or with as many as it needs."""
        exact = Decimal(repr(self.value))
        for decimals in range(len(old.partition(".")[2]) if "e" not in old.lower() else 0, MOST_DECIMALS):
            rounded = exact.quantize(Decimal(1).scaleb(-decimals), rounding=self.rounding)
            if abs(rounded - exact) <= Decimal(repr(self.within)):
                return f"{rounded:f}"
        return repr(self.value)


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
