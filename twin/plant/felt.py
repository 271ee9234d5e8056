"""How hard tissue pressed on a needle, as a person is told."""

from __future__ import annotations

from typing import NamedTuple


class Felt(NamedTuple):
    """The greatest forces of one insertion, N: along the needle, and across it as its holder bears them."""

    along_n: float
    across_n: float

    @property
    def text(self) -> str:
        """For a person."""
        if self.along_n == self.across_n == 0.0:
            return "the tissue did not push: the needle met none"
        return f"the tissue pushed with up to {self.along_n:.2f} N along the needle, {self.across_n:.2f} N across it"


NOT_FELT = "no force of tissue: the case declares none ([tissue])"
"""Of an insertion through tissue that nobody described."""
