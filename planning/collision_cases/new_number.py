"""A number that a file would have to expect, with as many digits as it is written with."""

from __future__ import annotations

from dataclasses import dataclass
from decimal import ROUND_CEILING, ROUND_FLOOR, ROUND_HALF_EVEN, Decimal

MOST_DECIMALS = 17
"""More than a double has."""


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
