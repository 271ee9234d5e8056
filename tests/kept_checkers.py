"""Checkers of arms that many tests share: what encloses the bodies of an arm and its tool is made once a run."""

from dataclasses import replace
from functools import cache

from puncture_twin.planning.base.cache.array_cache import Cache, Memory, user_cache
from puncture_twin.planning.collision.fast_checker import FastChecker


@cache
def enclosures() -> Cache:
    """The folder that all processes of a run share, and this one's memory."""
    return replace(user_cache(), memory=Memory(10**9))


def built(kind, *arguments, **named):
    """A checker of a kind, from its own arguments."""
    return kind(*arguments, **named, **({"cache": enclosures()} if kind is FastChecker else {}))
