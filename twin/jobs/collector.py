"""Python's search for objects that hold one another, kept from where it finds none: loading modules, and the end.

A command loads some 250,000 objects that stay to its end. Looked through again and again as they come, and once more
when Python ends, they cost 0.2 and 0.4 s of a processor. What only one other object holds is freed at once, as ever.
"""

from __future__ import annotations

import atexit
import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager

FIRST_AT = 300_000
"""Objects after which circles are first looked for: a little more than a command loads."""

LATER_EVERY = 20_000
"""New objects between looks from then on: numba makes millions as it compiles, and at Python's 700 a fifth of the time
that a first command takes would go into looking."""

COUNTS_ITS_OWN = "ompl"
"""This library prints a list of what of it is still there at the very end: it is to find nothing."""


@contextmanager
def late_collection() -> Iterator[None]:
    """Begin to look for circles after ``FIRST_AT`` objects, from then on every ``LATER_EVERY`` among those that follow.

    At the end of the program nothing is looked through, where ``COUNTS_ITS_OWN`` is not loaded.
    """
    usual = gc.get_threshold()

    def resume(phase: str, _: object) -> None:
        if phase == "stop":
            gc.callbacks.remove(resume)
            gc.freeze()
            gc.set_threshold(LATER_EVERY, *usual[1:])

    gc.callbacks.append(resume)
    gc.set_threshold(FIRST_AT, *usual[1:])
    atexit.unregister(_set_aside)
    atexit.register(_set_aside)
    try:
        yield
    finally:
        gc.freeze()
        gc.unfreeze()  # both together: all that is there is old, and no next look begins with it
        gc.set_threshold(*usual)
        if resume in gc.callbacks:
            gc.callbacks.remove(resume)


def _set_aside() -> None:
    """At the end of the program: what is still there is looked through no more, its memory is the system's at once."""
    if not any(name.partition(".")[0] == COUNTS_ITS_OWN for name in sys.modules):  # or a part, if it was interrupted
        gc.freeze()
