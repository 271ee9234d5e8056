"""The sockets of `live`: bytes of many clients in, newest questions to the planner, newest answers out.

One thread has all sockets and never computes; another computes one answer after the other. Between them nothing queues:
of each client there waits at most one question of each subject, and one answer of each name. A newer one takes its
place, so that a needle that is tracked at 50 Hz is answered as it is now, as often as the planner can.

What a client does wrong costs that client alone: what is no message, stays half, or is never read, ends its connection
with one line in the log; what is a message with something wrong in it is answered, and passed over. A client is read a
limited amount at a time, then the next; beyond that its bytes wait in its own socket.

pyigtl's own server is not used: it reads whatever size a header claims into memory, serves one client while others
wait, answers all of them from one queue, and prints a traceback for each message that it cannot read.
"""

from __future__ import annotations

import logging
import selectors
import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, field
from ipaddress import ip_address

from puncture_twin.planning.base.errors import InputError, PlanningError, refuse
from puncture_twin.twin.jobs.live.messages import HEADER, Header, read_header, read_message
from puncture_twin.twin.jobs.live.planner import SUBJECTS, Answer, Planner, Question, Session

LOG = logging.getLogger(__name__)

MOST_CLIENTS = 8
MOST_KEPT = 65_536
"""Bytes of a body that is kept: 900 tracked tools. A larger one is passed over."""

CHUNK = 65_536
MOST_AT_ONCE = 20
"""Messages of one client, before the next is heard."""

REST_S = 0.005
"""How long a client is not read after it has sent as much: 4,000 messages, or 13 MB, in a second."""

MESSAGE_S = 5.0
"""A message that has begun is whole after this time, or its sender is gone."""

STALL_S = 10.0
"""An answer of which nothing is taken for so long has no reader."""

SEND_BUFFER = 262_144
"""Bytes that the system keeps for a client: what waits there cannot be replaced by what is newer."""

MOST_LINES, LINES_S = 20, 60.0
"""So many lines in the log in this time."""

USED = "the messages of docs/reference/live.md"


class Exchange:
    """What waits between sockets and planner: the newest question of each subject, in turn for each client."""

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake, self._changed, self._closed = wake, threading.Condition(), False
        self._questions: dict[int, dict[str, Question]] = {}
        self._answers: dict[int, dict[str, bytes]] = {}

    def open(self, client: int) -> None:
        """From now on its questions and answers are kept."""
        with self._changed:
            self._answers[client] = {}

    def drop(self, client: int) -> None:
        """Nothing of a client that is gone is kept."""
        with self._changed:
            self._answers.pop(client, None)
            self._questions.pop(client, None)

    def close(self) -> None:
        """There are no more questions."""
        with self._changed:
            self._closed = True
            self._changed.notify()

    def ask(self, question: Question, *, newest: bool = True) -> None:
        """Put a question in place of an older one; one that is not the newest gives way to one that waits."""
        with self._changed:
            if question.client in self._answers:
                waiting = self._questions.setdefault(question.client, {})
                waiting[question.subject] = question if newest else waiting.get(question.subject, question)
                self._changed.notify()

    def take(self) -> Question | None:
        """The first subject of the client that waits longest, which then waits anew; None where there are no more."""
        with self._changed:
            self._changed.wait_for(lambda: self._questions or self._closed)
            if self._closed:
                return None
            client = next(iter(self._questions))
            waiting = self._questions.pop(client)
            question = waiting.pop(min(waiting, key=SUBJECTS.index))
            if waiting:
                self._questions[client] = waiting
            return question

    def give(self, client: int, answer: Answer) -> None:
        """Put an answer in place of an older one of its name."""
        with self._changed:
            if client in self._answers:
                self._answers[client][answer.name] = answer.data
        self._wake()

    def answer(self, client: int) -> bytes | None:
        """The answer that waits longest for a client, taken away."""
        with self._changed:
            waiting = self._answers.get(client)
            return waiting.pop(next(iter(waiting))) if waiting else None


@dataclass(eq=False)
class Client:
    """One connection: what has come and is no whole message yet, and what is being sent.

    Attributes:
        passed_over: Bytes of a body that are still to come and are not kept.
        since: When the message began that is not whole yet.
        rests_until: It is not read before.
        taken_at: When it last took some of what is being sent.
        logged: Codes of what it did wrong, each logged once.
    """

    number: int
    session: Session
    socket: socket.socket
    where: str
    received: bytearray = field(default_factory=bytearray)
    passed_over: int = 0
    since: float | None = None
    rests_until: float = 0.0
    sending: memoryview = field(default_factory=lambda: memoryview(b""))
    taken_at: float = 0.0
    logged: set[str] = field(default_factory=set)


class Log:
    """Lines about clients: each kind once for each of them, and `MOST_LINES` in `LINES_S`."""

    def __init__(self) -> None:
        self._times: list[float] = []

    def line(self, client: Client, code: str, text: str) -> None:
        """Log it, if it is new, and not too many were."""
        now = time.monotonic()
        self._times = [one for one in self._times if now - one < LINES_S]
        if code not in client.logged and len(self._times) < MOST_LINES:
            self._times.append(now)
            LOG.warning("live: client %s: %s", client.where, text)
        client.logged.add(code)


def bound(host: str, port: int) -> socket.socket:
    """A socket that has its address and does not listen yet: a port that is taken is told before a case is read.

    Raises:
        InputError: No such address here, or the port is taken.
    """
    try:
        family, _, _, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        listener = socket.socket(family, socket.SOCK_STREAM)
    except (OSError, UnicodeError) as error:
        what = f"no address of this machine ({error})"
        raise InputError(what, where=f"--host {host}", allowed="such as 127.0.0.1", code="bad_host") from error
    try:
        listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        listener.bind(address)
        listener.listen()
        listener.setblocking(False)
        if not ip_address(listener.getsockname()[0].partition("%")[0]).is_loopback:
            LOG.warning("warning: %s is not loopback: whoever reaches it can ask, and read the answers", host)
    except OSError as error:
        listener.close()
        where, allowed = f"{host}, port {port}", "an address of this machine and a free port (--port)"
        raise InputError(error.strerror or str(error), where=where, allowed=allowed, code="port_not_free") from error
    return listener


def serve(listener: socket.socket, planner: Planner) -> None:
    """Answer clients until it is interrupted; the port is free then.

    Args:
        listener: From `bound`; closed at the end.
    """
    woken, waker = socket.socketpair()
    with listener, woken, waker, selectors.DefaultSelector() as selector:
        for one in (woken, waker):
            one.setblocking(False)
        exchange = Exchange(lambda: _wake(waker))
        computing = threading.Thread(target=_compute, args=(exchange, planner), name="live", daemon=True)
        computing.start()
        selector.register(listener, selectors.EVENT_READ)
        selector.register(woken, selectors.EVENT_READ)
        sockets = Sockets(selector, listener, exchange, planner)
        try:
            while True:
                sockets.turn()
                with suppress(BlockingIOError):
                    woken.recv(CHUNK)
        finally:
            exchange.close()
            for client in list(sockets.clients.values()):
                client.socket.close()
            computing.join(STALL_S)


def _wake(waker: socket.socket) -> None:
    with suppress(OSError):  # full: the reader wakes anyway; closed: nobody is left to wake
        waker.send(b"x")


def _compute(exchange: Exchange, planner: Planner) -> None:
    """One question after the other, until there are no more."""
    while (question := exchange.take()) is not None:
        for found in _found(planner, question):
            if isinstance(found, Question):
                exchange.ask(found, newest=False)
            else:
                exchange.give(question.client, found)


def _found(planner: Planner, question: Question) -> Iterator[Answer | Question]:
    """The answers, or why there are none."""
    try:
        yield from planner.answers(question)
    except PlanningError as error:
        yield from planner.refused(question.subject, question.stamp, error)
    except Exception as error:  # the last line of defence: the others are answered on
        LOG.exception("live: the program failed")
        yield from planner.refused(question.subject, question.stamp, PlanningError(f"the program failed: {error!r}"))


class Sockets:
    """The connections, and one turn over all of them."""

    def __init__(
        self, selector: selectors.BaseSelector, listener: socket.socket, exchange: Exchange, planner: Planner
    ) -> None:
        self.clients: dict[int, Client] = {}
        self._selector, self._listener, self._exchange, self._planner = selector, listener, exchange, planner
        self._log, self._number = Log(), 0

    def turn(self) -> None:
        """Wait for something to do, and do what each client has to do."""
        now = time.monotonic()
        for client in list(self.clients.values()):
            self._prepare(client, now)
        resting = [client.rests_until - now for client in self.clients.values() if client.rests_until > now]
        for key, events in self._selector.select(min(resting, default=1.0)):
            if key.fileobj is self._listener:
                self._accept()
            elif isinstance(key.data, Client):
                self._attend(key.data, events)

    def _prepare(self, client: Client, now: float) -> None:
        """End what takes too long; say what is waited for."""
        if client.since is not None and now - client.since > MESSAGE_S and now > client.rests_until:
            self._end(client, "half_a_message", f"a message is not whole after {MESSAGE_S:g} s")
            return
        if client.sending and now - client.taken_at > STALL_S:
            self._end(client, "not_reading", f"takes no answer for {STALL_S:g} s")
            return
        if not client.sending and (data := self._exchange.answer(client.number)) is not None:
            client.sending, client.taken_at = memoryview(data), now
        if now >= client.rests_until and len(client.received) >= HEADER.size:
            self._read_messages(client)
            if client.number not in self.clients:
                return
        events = selectors.EVENT_WRITE if client.sending else 0
        if now >= client.rests_until:
            events |= selectors.EVENT_READ
        with suppress(KeyError):
            self._selector.unregister(client.socket)
        if events:
            self._selector.register(client.socket, events, client)

    def _accept(self) -> None:
        with suppress(OSError):  # it was gone before it was greeted
            connection, address = self._listener.accept()
            self._number += 1
            client = Client(self._number, self._planner.session(), connection, f"{address[0]}:{address[1]}")
            connection.setblocking(False)
            connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
            self.clients[client.number] = client
            self._exchange.open(client.number)
            if len(self.clients) > MOST_CLIENTS:
                self._end(client, "too_many", f"one more than {MOST_CLIENTS} clients")

    def _attend(self, client: Client, events: int) -> None:
        try:
            if events & selectors.EVENT_WRITE:
                client.sending = client.sending[client.socket.send(client.sending) :]
                client.taken_at = time.monotonic()
            if events & selectors.EVENT_READ:
                self._receive(client, client.socket.recv(CHUNK))
        except BlockingIOError:
            return
        except OSError as error:
            self._end(client, "broken", f"the connection broke ({error.strerror})")

    def _receive(self, client: Client, data: bytes) -> None:
        if not data:
            half = client.received or client.passed_over
            self._end(client, "gone", "ended within a message" if half else "")
            return
        now = time.monotonic()
        over = min(client.passed_over, len(data))
        client.passed_over -= over
        client.since = now if over or client.since is None else client.since
        client.received += data[over:]
        if len(data) == CHUNK:
            client.rests_until = now + REST_S
        self._read_messages(client)

    def _read_messages(self, client: Client) -> None:
        """Take whole messages from what has come, at most `MOST_AT_ONCE`."""
        for _ in range(MOST_AT_ONCE):
            try:
                if not self._read_one(client):
                    break
            except InputError as error:  # what follows is not known to be a message
                self._end(client, error.code, str(error))
                return
        else:
            client.rests_until = time.monotonic() + REST_S
        if not client.received and not client.passed_over:
            client.since = None

    def _read_one(self, client: Client) -> bool:
        """Take one message, or its beginning; False where more has to come first."""
        received = client.received
        if client.passed_over or len(received) < HEADER.size:
            return False
        header = read_header(bytes(received[: HEADER.size]))
        subject, whole = self._planner.subject(header), HEADER.size + header.size
        if subject is None or header.size > MOST_KEPT:
            client.passed_over = max(whole - len(received), 0)
            body = None
        elif len(received) < whole:
            return False
        else:
            body = bytes(received[HEADER.size : whole])
        del received[:whole]
        client.since = time.monotonic()
        try:
            if body is None or subject is None:
                what = f"{header.kind} '{header.name}' of {header.size} bytes is not used"
                refuse(what, "OpenIGTLink", USED, "unknown_message")
            message = read_message(header, body)
            self._exchange.ask(Question(client.number, client.session, subject, message.stamp, message))
        except InputError as error:
            self._wrong(client, subject, header, error)
        return True

    def _wrong(self, client: Client, subject: str | None, header: Header, error: InputError) -> None:
        """Answer a message that cannot be used; of those that are about nothing here, the first of each kind."""
        if subject is not None:
            self._exchange.ask(Question(client.number, client.session, subject, header.stamp, fault=error))
        elif error.code not in client.logged:
            for answer in self._planner.refused(None, header.stamp, error):
                self._exchange.give(client.number, answer)
        self._log.line(client, error.code, str(error))

    def _end(self, client: Client, code: str, why: str) -> None:
        """End a connection; an empty reason is not worth a line."""
        if why:
            self._log.line(client, code, f"{why}; disconnected")
        del self.clients[client.number]
        self._exchange.drop(client.number)
        with suppress(KeyError):
            self._selector.unregister(client.socket)
        client.socket.close()
