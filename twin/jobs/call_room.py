"""Room for the calls of a command in one piece of memory.

Python 3.11 keeps the frames of its calls in pieces of 16 KB. A call that no longer fits brings a new piece from the
system, which goes back as soon as that call returns: a loop whose calls begin just there pays for a piece at each. A
search lost 0.1 s so, where a library, imported a hundred calls deep, sets up its types.
"""

from __future__ import annotations

from collections.abc import Callable
from types import FunctionType
from typing import TypeVar

Result = TypeVar("Result")

WORDS = 70_000
"""Of a frame that fits into no piece below 1 MB, the next power of two: 60,000 words of it are left for calls inside,
some two thousand. The system gives memory to what of it is used."""


def _call(function: Callable[[], Result]) -> Result:
    return function()


def with_room(function: Callable[[], Result]) -> Result:
    """What the function returns, called where calls inside it need no other piece."""
    roomy = FunctionType(_call.__code__.replace(co_stacksize=WORDS), {})
    result: Result = roomy(function)
    return result
