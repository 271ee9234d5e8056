"""Ctrl-C that arrives: raised again where compiled code has swallowed it.

Python raises ``KeyboardInterrupt`` at whatever line runs when the signal comes. Where that line is called from a
library's callback, a destructor or a lookup in C, or where a library catches whatever the import of another raises, the
exception is dropped there, and the command would run to its end.

And put off where it would break what is not made for it: a compiled module that is half imported stays so, and LLVM's
memory is freed twice where its Python side learns not that it was freed, which ends the process without a word.
"""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from types import FrameType
from typing import Any

AGAIN_S = 0.02
"""How soon an interruption that was swallowed, or put off, comes again."""

UNBREAKABLE = frozenset({"importlib", "llvmlite"})
"""Packages whose functions are not left by an interruption, nor what they have called."""


@contextmanager
def insistent_ctrl_c() -> Iterator[None]:
    """Raise ``KeyboardInterrupt`` again until some code of the block handles it.

    It does nothing outside the main thread, nor where another handler than Python's own is set (a shell starts what
    is in the background deaf to the signal).
    """
    heard = signal.default_int_handler
    if threading.current_thread() is not threading.main_thread() or signal.getsignal(signal.SIGINT) is not heard:
        yield
        return
    alarm, unraisable = signal.getsignal(signal.SIGALRM), sys.unraisablehook
    signal.signal(signal.SIGINT, partial(_first, _unbreakable(sys._getframe())))
    try:
        yield
        raise_dropped()
    except Exception as error:
        if _is_on_its_way():  # a library made its own error of it
            raise KeyboardInterrupt from error
        raise
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGINT, heard)
        signal.signal(signal.SIGALRM, alarm)
        sys.unraisablehook = unraisable


@contextmanager
def ended_by_ctrl_c() -> Iterator[None]:
    """A block that Ctrl-C ends, and after which the command goes on."""
    try:
        yield
    except KeyboardInterrupt:
        signal.setitimer(signal.ITIMER_REAL, 0.0)


def raise_dropped() -> None:
    """Raise an interruption that was dropped and has not come again yet: what was interrupted gives no answer."""
    if _is_on_its_way() and not _is_handled():
        raise KeyboardInterrupt


def _is_on_its_way() -> bool:
    """Whether an interruption has come that no block ended with."""
    return signal.getitimer(signal.ITIMER_REAL)[1] > 0.0


def _first(outside: int, _: int, frame: FrameType | None) -> None:
    """The signal: from now on what is dropped is a consequence of it, and not worth a traceback.

    It is put off within frames of `UNBREAKABLE` that the block has entered, beyond those that it was entered from.
    """
    sys.unraisablehook = _silent
    signal.signal(signal.SIGALRM, _again)
    signal.setitimer(signal.ITIMER_REAL, AGAIN_S, AGAIN_S)
    if _unbreakable(frame) <= outside:
        raise KeyboardInterrupt


def _unbreakable(frame: FrameType | None) -> int:
    """How many of a frame, and of those that led to it, are of `UNBREAKABLE`."""
    count = 0
    while frame is not None:
        count += str(frame.f_globals.get("__name__")).partition(".")[0] in UNBREAKABLE
        frame = frame.f_back
    return count


def _again(*_: object) -> None:
    """By way of the signal: a block that puts Ctrl-C off, such as the renames of a folder, puts this off too."""
    if not _is_handled():
        signal.raise_signal(signal.SIGINT)


def _is_handled() -> bool:
    """Whether a ``finally``, ``except`` or ``with`` that the interruption reached runs now."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _silent(_: Any) -> None:
    """In place of the traceback of an exception that nobody can catch."""
