"""Checkers of arms that many tests share: what encloses the bodies of an arm and its tool is made once a process."""

from typing import Any, TypeVar

from puncture_twin.planning.base.cache.array_cache import Cache, Memory
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker

Kind = TypeVar("Kind", bound=CellChecker)
ENCLOSURES = Cache(None, memory=Memory(10**9))


def built(kind: type[Kind], *arguments: Any, **named: Any) -> Kind:
    """A checker of a kind, from its own arguments."""
    return kind(*arguments, **named, **({"cache": ENCLOSURES} if kind is FastChecker else {}))
