"""The terminal: lines on stdout that no width breaks, a reader who went away, and Ctrl-C that arrives.

Python raises ``KeyboardInterrupt`` at whatever line runs when the signal comes. Where that line is called from a
library's callback, a destructor or a lookup in C, or where a library catches whatever the import of another raises, the
exception is dropped there: it is raised again. It is put off where it would break what is not made for it: a compiled
module that is half imported stays so, and LLVM's memory is freed twice where its Python side does not learn of it.
"""

import atexit
import gc
import json
import os
import select
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from types import FrameType
from typing import Any, NamedTuple, NoReturn, TextIO

from puncture_twin.planning.base.files import atomic

UNNAMED_CASES = frozenset({"case.toml", "servo.toml", "selfcal.toml", "plan.json"})
"""Files that are named by their folder."""
AGAIN_S = 0.02  # how soon an interruption that was swallowed, or put off, comes again
UNBREAKABLE = frozenset({"importlib", "llvmlite"})  # packages that an interruption does not leave, nor what they call
LOOKS_EVERY = 20_000
"""New objects between Python's searches for circles of them: at its own 700 a first command, for which numba makes
millions, spends a fifth of its time in looking."""


class Answer(NamedTuple):
    """Answer of a command: yes or no, for the exit code; plain values, for ``--json``; and text for a person."""

    passed: bool
    summary: dict[str, Any]
    text: str


def default_out(source: Path, command: str) -> Path:
    """The folder for the files of a command on a case or plan where none is named, such as ``out/abdomen-search``."""
    place = source.absolute()
    if place.suffix.lower() not in {".toml", ".json"}:
        name = place.name
    elif place.name in UNNAMED_CASES:
        name = place.parent.name
    else:
        name = f"{place.parent.name}-{place.stem}"
    return Path("out") / f"{name or 'case'}-{command}"


def print_answer(summary: dict[str, Any], text: str, as_json: bool) -> None:
    """Print an answer: one JSON object, or the text for a person; nothing, where it was interrupted."""
    raise_dropped()
    sys.stdout.write((json.dumps(summary, allow_nan=False) if as_json else text) + "\n")


def print_whole(line: str) -> None:
    """Print a line on stderr at once, so that Ctrl-C comes before or after it."""
    sys.stderr.write(f"{line}\n")
    sys.stderr.flush()


def reader_is_gone(stream: TextIO) -> bool:
    """Whether a stream is a pipe that nobody reads any more, as after ``| head -1``."""
    try:
        number = stream.fileno()
        waiting = select.poll()
        waiting.register(number, select.POLLOUT)
        return any(events & select.POLLERR for _, events in waiting.poll(0))
    except (OSError, ValueError):  # a stream without a file, or a closed one
        return False


def refusal_of(stream: TextIO | None) -> str | None:
    """Why a stream does not take a line end, as where the disk is full; None where it does, and has it then."""
    try:
        if stream is not None and not stream.closed:
            stream.write("\n")
            stream.flush()
    except OSError as error:
        return error.strerror
    return None


def leave_unread(stream: TextIO) -> None:
    """Send whatever a stream still holds nowhere, so that the end of the program does not fail by it."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, stream.fileno())
    os.close(nowhere)


def flush_output() -> None:
    """Hand over everything that was printed; a `BrokenPipeError` where nobody reads it."""
    if sys.stdout is not None and not sys.stdout.closed:
        sys.stdout.flush()


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
    """Count of a frame, and of those that led to it, that are of `UNBREAKABLE`."""
    count = 0
    while frame is not None:
        count += str(frame.f_globals.get("__name__")).partition(".")[0] in UNBREAKABLE
        frame = frame.f_back
    return count


def _again(*_: object) -> None:
    """Interrupt again by signal: a block that puts Ctrl-C off, such as the renames of a folder, puts this off too."""
    if not _is_handled():
        signal.raise_signal(signal.SIGINT)


def _is_handled() -> bool:
    """Whether a ``finally``, ``except`` or ``with`` that the interruption reached runs now."""
    error = sys.exc_info()[1]
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__context__
    return error is not None


def _silent(_: Any) -> None:
    """Do nothing, in place of the traceback of an exception that nobody can catch."""


def look_seldom() -> None:
    """Let Python look for circles of objects every `LOOKS_EVERY` new ones."""
    gc.set_threshold(LOOKS_EVERY)


def leave(code: int) -> NoReturn:
    """End this process with an exit code, without taking apart what its memory, handed back at once, takes along.

    Threads are waited for and what was registered for the end is called, as at Python's own end; what was printed is
    written, and where nobody takes it, that is the code of Python's own: 120. Ctrl-C ends what is still waited for.
    """
    if signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)
    threading._shutdown()  # type: ignore[attr-defined]  # Python's own, by which executors end their threads
    atexit._run_exitfuncs()
    for stream in (sys.stdout, sys.stderr):
        try:
            if stream is not None and not stream.closed:
                stream.flush()
        except OSError:
            code = 120
    os._exit(code)


def write_result(summary: Mapping[str, Any], path: Path, out: Path) -> None:
    """Write what ``--json`` prints, its files named as the folder holds them: the same bytes wherever that lies."""
    write_json({**summary, "files": [os.path.relpath(file, out) for file in summary["files"]]}, path)


def write_json(document: Mapping[str, Any], path: Path) -> Path:
    """Write a document, whole or not at all; returns its path."""
    with atomic(path) as temporary:
        temporary.write_text(json.dumps(document, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    return path
