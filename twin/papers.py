"""The papers whose numbers this project prints beside its own, by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

from twin import words
from twin.ct import chen2019


class PaperResult(NamedTuple):
    """A paper's numbers beside ours."""

    holds: bool
    """Whether every number that should hold does."""
    summary: dict[str, Any]
    """Plain values, for ``--json``."""
    text: str
    """For a person."""


Reproduce = Callable[[Path, int | None], PaperResult]
"""Takes the folder for pictures and pages, and the number of seeds (None: the paper's own default)."""


def _chen2019(out_dir: Path, seeds: int | None) -> PaperResult:
    del out_dir, seeds  # arithmetic on printed tables: nothing is drawn, in either sense
    result = chen2019.reproduce()
    return PaperResult(result.holds, words.reproduction_summary(result), words.reproduction_text(result))


PAPERS: Mapping[str, Reproduce] = MappingProxyType({"chen2019": _chen2019})
"""Name on the command line to what reproduces it."""
