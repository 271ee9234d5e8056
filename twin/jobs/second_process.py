"""A second Python beside the command's own, which does in turn what it is asked: two stages at a time, on two cores.

It is asked by functions of the project and their arguments, pickled through a pipe, and answers with what they return
or raise, how long they took, and what was kept and could not be trusted. It is no member of the terminal's group:
Ctrl-C reaches the command alone, which ends it. Where one core is free, or nothing is compiled yet, all is done here.
"""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from functools import partial
from types import MappingProxyType
from typing import IO, Any, NamedTuple, NoReturn, Protocol

from puncture_twin.planning.base.errors import CacheWarning, PlanningError
from puncture_twin.twin.jobs.leave import leave

ENDS_WITHIN_S = 5.0
"""A process that was told to end and has not is ended."""

LOOKS_EVERY_S = 0.25
"""How soon a process ends whose command was killed: it may not write where the next command does."""


class Answer(NamedTuple):
    """What a function returned, and the seconds that it took."""

    value: Any
    seconds: float


class Asked(Protocol):
    """What was asked, answered or not."""

    def done(self) -> bool:
        """Whether the answer is there."""

    def result(self) -> Answer:
        """The answer; what the function raised is raised."""


class Beside(Protocol):
    """Does what it is asked, in the order in which it is asked."""

    def keep(self, make: Callable[..., Any], *arguments: Any) -> None:
        """Make a thing, and keep it where it is made."""

    def ask(self, method: Callable[..., Any], *arguments: Any) -> Asked:
        """Call a function with what is kept, and with arguments."""


class _Later:
    """A call that is made when its answer is wanted, once."""

    def __init__(self, call: Callable[[], Answer]) -> None:
        self._call = call
        self._answer: list[Answer] = []

    def done(self) -> bool:
        """See `Asked`."""
        return bool(self._answer)

    def result(self) -> Answer:
        """See `Asked`."""
        if not self._answer:
            self._answer = [self._call()]
        return self._answer[0]


class Here:
    """In this process, when the answer is wanted."""

    def __init__(self) -> None:
        self._make: Callable[[], Any] = lambda: None
        self._kept: list[Any] = []

    def keep(self, make: Callable[..., Any], *arguments: Any) -> None:
        """See `Beside`."""
        self._make, self._kept = partial(make, *arguments), []

    def ask(self, method: Callable[..., Any], *arguments: Any) -> Asked:
        """See `Beside`; answers must be taken in the order of the questions."""
        return _Later(partial(self._answer, method, *arguments))

    def _answer(self, method: Callable[..., Any], *arguments: Any) -> Answer:
        if not self._kept:
            self._kept = [self._make()]
        return _timed(method, self._kept[0], *arguments)


class SecondProcess:
    """In another process.

    Args:
        process: Running `serve`, its pipes open.
    """

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process, self._turns = process, ThreadPoolExecutor(1)
        self._kept: Future[Answer] | None = None

    def keep(self, make: Callable[..., Any], *arguments: Any) -> None:
        """See `Beside`; what it raises is raised by what is asked then."""
        self._kept = self._turns.submit(self._exchange, _Request(True, make, arguments))

    def ask(self, method: Callable[..., Any], *arguments: Any) -> Asked:
        """See `Beside`."""
        return self._turns.submit(self._asked, _Request(False, method, arguments))

    def end(self) -> None:
        """End the process, whatever it does."""
        self._process.terminate()
        try:
            self._process.wait(ENDS_WITHIN_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._turns.shutdown(cancel_futures=True)
        for pipe in (self._process.stdin, self._process.stdout):
            _close(pipe)

    def _asked(self, request: _Request) -> Answer:
        if self._kept is not None:
            self._kept.result()
        return self._exchange(request)

    def _exchange(self, request: _Request) -> Answer:
        to, back = self._process.stdin, self._process.stdout
        assert to is not None and back is not None
        try:
            _send(request, to)
            reply: _Reply = pickle.load(back)
        except (EOFError, BrokenPipeError) as error:
            raise RuntimeError(f"the process beside has ended, with {self._process.wait()}") from error
        for text in reply.made_anew:
            warnings.warn(text, CacheWarning, stacklevel=2)
        if reply.error is not None:
            raise reply.error
        return Answer(reply.value, reply.seconds)


@contextmanager
def second_process(get_ready: Callable[[], None]) -> Iterator[Beside]:
    """A second process while the block runs, or this one.

    Args:
        get_ready: What the second process does first, such as imports; a function of a module that this one has too.
    """
    from puncture_twin.planning.base.numba_kernels import is_compiled
    from puncture_twin.planning.base.processes import worker_count
    from puncture_twin.planning.collision.kernels.settled import first_not_clear

    if worker_count(2, 2) == 1 or not is_compiled(first_not_clear):
        yield Here()
        return
    beside = SecondProcess(_begin(get_ready))
    try:
        yield beside
    finally:
        beside.end()


def _begin(get_ready: Callable[[], None]) -> subprocess.Popen[bytes]:
    words = (
        f"from {__name__} import {serve.__name__}; {serve.__name__}({get_ready.__module__!r}, {get_ready.__name__!r})"
    )
    places = {"PYTHONPATH": os.pathsep.join(place for place in sys.path if place)}
    pipe = subprocess.PIPE
    return subprocess.Popen(
        [sys.executable, "-P", "-c", words],
        env={**os.environ, **places},
        stdin=pipe,
        stdout=pipe,
        start_new_session=True,
    )


class _Request(NamedTuple):
    """What is called; what it returns is kept, or else it is called with what is kept, and its return sent back."""

    keeps: bool
    function: Callable[..., Any]
    arguments: tuple[Any, ...]


class _Reply(NamedTuple):
    value: Any
    seconds: float
    error: Exception | None
    made_anew: tuple[str, ...]


def serve(module: str, get_ready: str) -> NoReturn:
    """Answer requests until nobody asks; what a library prints to standard output goes to standard error."""
    signal.signal(
        signal.SIGTERM, lambda *_: os._exit(0)
    )  # a module that is loaded takes an exit for an error of its own
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()
    requests, replies = sys.stdin.buffer, os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    with suppress(SystemExit):
        getattr(__import__(module, fromlist=[get_ready]), get_ready)()
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))  # by way of what must be closed, such as the encoder
        _answer_all(requests, replies)
    leave(0)


def _answer_all(requests: IO[bytes], replies: IO[bytes]) -> None:
    kept = None
    while True:
        try:
            request: _Request = pickle.load(requests)
        except EOFError:
            return
        reply = _reply(request, kept)
        if request.keeps and reply.error is None:
            kept, reply = reply.value, reply._replace(value=None)
        _send(reply, replies)


def _end_with(parent: int) -> None:
    """End this process soon after the one that began it, however that ended."""
    while os.getppid() == parent:
        time.sleep(LOOKS_EVERY_S)
    os._exit(1)


def _reply(request: _Request, kept: Any) -> _Reply:
    first = () if request.keeps else (kept,)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always", CacheWarning)
        try:
            value, seconds = _timed(request.function, *first, *request.arguments)
            error = None
        except Exception as raised:  # whatever it is, the command is told
            value, seconds, error = None, 0.0, raised
            if not isinstance(raised, PlanningError):  # where it was raised helps whoever mends it
                raised.add_note(f"in the process beside:\n{traceback.format_exc()}")
    made_anew = tuple(str(one.message) for one in caught if issubclass(one.category, CacheWarning))
    return _Reply(value, seconds, error, made_anew)


def _timed(function: Callable[..., Any], *arguments: Any) -> Answer:
    start = time.perf_counter()
    return Answer(function(*arguments), time.perf_counter() - start)


class _Pickler(pickle.Pickler):
    """Also takes read-only mappings, and errors that are not made from their message alone."""

    def reducer_override(self, thing: Any) -> Any:
        """How such a thing is made again."""
        if isinstance(thing, MappingProxyType):
            return _mapping, (dict(thing),)
        if isinstance(thing, PlanningError):
            return _error, (type(thing), thing.args, vars(thing))
        return NotImplemented


def _mapping(values: dict[Any, Any]) -> MappingProxyType[Any, Any]:
    return MappingProxyType(values)


def _error(kind: type[PlanningError], arguments: tuple[Any, ...], parts: dict[str, Any]) -> PlanningError:
    error = kind.__new__(kind, *arguments)
    error.args = arguments
    vars(error).update(parts)
    return error


def _send(thing: Any, pipe: IO[bytes]) -> None:
    """Pickled in the newest form, in which arrays stay read-only."""
    _Pickler(pipe, pickle.HIGHEST_PROTOCOL).dump(thing)
    pipe.flush()


def _close(pipe: IO[bytes] | None) -> None:
    try:
        if pipe is not None:
            pipe.close()
    except BrokenPipeError:  # something was still to be sent
        pass
