"""The sockets of `live`: messages of many clients in, newest questions to the planner, newest answers out.

Each client has two threads, one to read and one to send; one more computes one answer after the other. Nothing queues:
of each client there waits at most one question of each subject, and one answer of each name; a newer one takes its
place. What is no message, stays half, or is never read, ends its connection with one line in the log; what is a message
with something wrong in it is answered. A client is read a limited amount in a time. (pyigtl's own server reads whatever
size a header claims, and serves one client while others wait.)
"""

import logging
import math
import socket
import threading
import time
from contextlib import suppress
from ipaddress import ip_address
from itertools import count

from puncture_twin.planning.base.errors import InputError, PlanningError, refuse
from puncture_twin.twin.jobs.live.messages import HEADER, Header, read_header, read_message
from puncture_twin.twin.jobs.live.planner import SUBJECTS, Answer, Planner, Question

LOG = logging.getLogger(__name__)
MOST_CLIENTS = 8
MOST_KEPT = 65_536  # bytes of a body that is kept: 900 tracked tools. A larger one is passed over
CHUNK = 65_536
MOST_AT_ONCE, REST_S = 20, 0.005  # so many messages, or a chunk of bytes, and a client is not read for a while
MESSAGE_S = 5.0  # a message that has begun is whole after this time, or its sender is gone
STALL_S = 10.0  # an answer that is not taken in this time has no reader
VANISHED_S, PROBES = 20.0, 4  # a client whose machine, probed so often in it, is silent for this time is gone
POSE_S = 2.0  # a pose counts so long: a tracker that stopped leaves no verdict behind
SEND_BUFFER = 262_144  # bytes that the system keeps for a client: what waits there cannot be replaced by what is newer
MOST_LINES, LINES_S = 20, 60.0  # so many lines in the log in this time
USED = "the messages of docs/reference/live.md"


class Exchange:
    """Queue between clients and planner: the newest question of each subject, in turn for each client.

    A needle without a newer pose for `pose_s` is asked about by the exchange itself, as one that is refused.
    """

    def __init__(self, pose_s: float = POSE_S) -> None:
        self._pose_s = pose_s
        self._posed: dict[int, tuple[float, Question]] = {}
        self._lock, self._closed = threading.Lock(), False
        self._asked, self._given = threading.Condition(self._lock), threading.Condition(self._lock)
        self._questions: dict[int, dict[str, Question]] = {}
        self._answers: dict[int, dict[str, bytes]] = {}

    def open(self, client: int) -> bool:
        """Keep questions and answers of a client from now on; False where there are too many."""
        with self._lock:
            full = len(self._answers) >= MOST_CLIENTS
            if not full:
                self._answers[client] = {}
            return not full

    def drop(self, client: int) -> bool:
        """Keep nothing of a client that is gone; False where that was known."""
        with self._lock:
            self._questions.pop(client, None)
            self._posed.pop(client, None)
            self._given.notify_all()
            return self._answers.pop(client, None) is not None

    def close(self) -> None:
        """End all waits: there are no more questions, and no clients."""
        with self._lock:
            self._closed = True
            self._answers.clear()
            self._asked.notify()
            self._given.notify_all()

    def put_question(self, question: Question) -> None:
        """Put a question in place of an older one."""
        with self._lock:
            if question.client in self._answers:
                self._questions.setdefault(question.client, {})[question.subject] = question
                if question.subject == "needle":
                    self._posed.pop(question.client, None)  # the oldest is the first
                    self._posed[question.client] = time.monotonic(), question
                self._asked.notify()

    def take(self) -> Question | None:
        """The first subject of the client that waits longest, which then waits anew; None where there are no more."""
        with self._lock:
            while not self._closed:
                since, posed = next(iter(self._posed.values()), (math.inf, None))
                left = since + self._pose_s - time.monotonic()
                if posed is not None and left <= 0.0:
                    return self._silent(posed)
                if self._questions:
                    client = next(iter(self._questions))
                    return self._taken(client, min(self._questions[client], key=SUBJECTS.index))
                self._asked.wait(min(left, threading.TIMEOUT_MAX))
            return None

    def _silent(self, posed: Question) -> Question:
        """Question in place of a pose that counts no longer, whether it was answered or not."""
        del self._posed[posed.client]
        if "needle" in self._questions.get(posed.client, {}):
            self._taken(posed.client, "needle")
        what, allowed = f"no pose for {self._pose_s:g} s", "poses that go on coming, or a longer --pose-s"
        silent = InputError(what, where="OpenIGTLink Needle", allowed=allowed, code="needle_silent")
        return posed._replace(message=None, fault=silent)

    def take_from(self, client: int, subject: str) -> Question | None:
        """Question of a client about a subject, out of turn; None without one."""
        with self._lock:
            return self._taken(client, subject) if subject in self._questions.get(client, {}) else None

    def _taken(self, client: int, subject: str) -> Question:
        waiting = self._questions.pop(client)
        question = waiting.pop(subject)
        if waiting:
            self._questions[client] = waiting
        return question

    def put_answer(self, client: int, answer: Answer) -> None:
        """Put an answer in place of an older one of its name."""
        with self._lock:
            if client in self._answers:
                self._answers[client][answer.name] = answer.data
                self._given.notify_all()

    def answer(self, client: int) -> bytes | None:
        """The answer that waits longest for a client, taken away; None where the client is gone."""
        with self._lock:
            self._given.wait_for(lambda: self._answers.get(client) != {})
            waiting = self._answers.get(client)
            return waiting.pop(next(iter(waiting))) if waiting else None


class Log:
    """Lines about clients: each kind once for each of them, and `MOST_LINES` in `LINES_S`."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._times: list[float] = []

    def line(self, where: str, text: str) -> None:
        """Log a line, if not too many were."""
        with self._lock:
            now = time.monotonic()
            self._times = [one for one in self._times if now - one < LINES_S]
            if len(self._times) < MOST_LINES:
                self._times.append(now)
                LOG.warning("live: client %s: %s", where, text)


def bound(host: str, port: int) -> socket.socket:
    """A socket that listens; a port that is taken is refused before a case is read. Clients wait until `serve`."""
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
    except OSError as error:
        listener.close()
        where, allowed = f"{host}, port {port}", "an address of this machine and a free port (--port)"
        raise InputError(error.strerror or str(error), where=where, allowed=allowed, code="port_not_free") from error
    if not ip_address(listener.getsockname()[0].partition("%")[0]).is_loopback:
        LOG.warning("warning: %s is not loopback: whoever reaches it can ask, and read the answers", host)
    return listener


def serve(listener: socket.socket, planner: Planner, pose_s: float = POSE_S) -> None:
    """Answer clients until it is interrupted; the port is free then. A needle's pose counts so many seconds."""
    exchange, log, clients = Exchange(pose_s), Log(), dict[int, Client]()
    computing = threading.Thread(target=_compute, args=(exchange, planner), daemon=True)
    computing.start()
    try:
        with listener:
            for number in count():
                try:
                    connection, address = listener.accept()
                    client = Client(number, connection, f"{address[0]}:{address[1]}", planner, exchange, log)
                except OSError as error:  # gone before it was greeted, or there are no more files
                    log.line("", f"not accepted ({error.strerror})")
                    time.sleep(REST_S)
                    continue
                clients = {key: one for key, one in clients.items() if one.open} | {number: client}
                client.start()
    finally:
        exchange.close()
        for client in clients.values():
            client.close()
        computing.join(STALL_S)


def _compute(exchange: Exchange, planner: Planner) -> None:
    """Answer one question after the other, until there are no more.

    A target is followed by its client's needle at once: one that moves faster than its map is made would be asked about
    forever, and the needle never.
    """
    planner.begin()
    while (question := exchange.take()) is not None:
        _answer(exchange, planner, question)
        if question.subject == "target":
            needle = exchange.take_from(question.client, "needle") or planner.needle(question.session)
            if needle is not None:
                _answer(exchange, planner, needle)


def _answer(exchange: Exchange, planner: Planner, question: Question) -> None:
    fault = None
    try:
        for answer in planner.answers(question):
            exchange.put_answer(question.client, answer)
    except PlanningError as error:
        fault = error
    except Exception as error:  # the last line of defence: the others are answered on
        LOG.exception("live: the program failed")
        fault = PlanningError(f"the program failed: {error!r}")
    for answer in () if fault is None else planner.refused(question.subject, question.stamp, fault):
        exchange.put_answer(question.client, answer)


def _notice_the_vanished(connection: socket.socket) -> None:
    """Let the system end a connection whose other machine is gone without a word: it would keep its place for hours."""
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    probe_s = max(1, round(VANISHED_S / PROBES))
    for name, value in (
        ("TCP_KEEPIDLE", probe_s),
        ("TCP_KEEPINTVL", probe_s),
        ("TCP_KEEPCNT", PROBES - 1),
        ("TCP_USER_TIMEOUT", round(1e3 * VANISHED_S)),  # of answers that are on their way
    ):
        if hasattr(socket, name):  # not every system has each
            connection.setsockopt(socket.IPPROTO_TCP, getattr(socket, name), value)


class Client:
    """One connection, with threads that read and send."""

    def __init__(
        self, number: int, connection: socket.socket, where: str, planner: Planner, exchange: Exchange, log: Log
    ) -> None:
        self.open = True
        self._number, self._in, self._out, self._where = number, connection, connection.dup(), where
        self._in.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._in.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        _notice_the_vanished(self._in)
        self._out.settimeout(STALL_S)  # of its own
        self._planner, self._exchange, self._log = planner, exchange, log
        self._session, self._logged, self._read_since = planner.session(), set[str](), 0.0

    def start(self) -> None:
        """Read and send from now on."""
        if not self._exchange.open(self._number):
            self._line("too_many", f"one more than {MOST_CLIENTS} clients; disconnected")
            self.close()
            return
        for work in (self._read, self._send):
            threading.Thread(target=work, daemon=True).start()

    def close(self) -> None:
        """End the connection: whoever waits for it wakes."""
        self.open = False
        with suppress(OSError):
            self._in.shutdown(socket.SHUT_RDWR)
        self._in.close()
        self._out.close()

    def _end(self, code: str, why: str) -> None:
        """End the connection, once; an empty reason is not worth a line."""
        if self._exchange.drop(self._number):
            if why:
                self._line(code, f"{why}; disconnected")
            self.close()

    def _line(self, code: str, text: str) -> None:
        if code not in self._logged:
            self._logged.add(code)
            self._log.line(self._where, text)

    def _send(self) -> None:
        try:
            while (data := self._exchange.answer(self._number)) is not None:
                self._out.sendall(data)
        except OSError as error:
            self._broken(error, "not_reading", f"has not taken an answer in {STALL_S:g} s")

    def _read(self) -> None:
        try:
            while True:
                self._in.settimeout(None)
                if not (first := self._in.recv(1)):
                    break
                self._read_message(first, time.monotonic() + MESSAGE_S)
            self._end("gone", "")
        except InputError as error:  # what follows is not known to be a message
            self._end(error.code, str(error))
        except OSError as error:
            self._broken(error, "half_a_message", f"a message is not whole after {MESSAGE_S:g} s")

    def _broken(self, error: OSError, code: str, late: str) -> None:
        """End the connection after an error; that of a wait which was too long has no number of the system's."""
        if isinstance(error, TimeoutError) and error.errno is None:
            self._end(code, late)
        else:
            self._end("broken", f"the connection broke ({error.strerror or error})")

    def _read_message(self, first: bytes, until: float) -> None:
        header = read_header(first + self._exactly(HEADER.size - 1, until))
        subject = self._planner.subject(header)
        try:
            if subject is None or header.size > MOST_KEPT:
                left = header.size
                while left > 0:  # nothing is kept; each part has the time of a message
                    left -= len(self._exactly(min(left, CHUNK), time.monotonic() + MESSAGE_S))
                what = f"{header.kind} '{header.name}' of {header.size} bytes is not used"
                refuse(what, "OpenIGTLink", USED, "unknown_message")
            message = read_message(header, self._exactly(header.size, until))
            self._exchange.put_question(Question(self._number, self._session, subject, message.stamp, message))
        except InputError as error:
            self._wrong(subject, header, error)

    def _wrong(self, subject: str | None, header: Header, error: InputError) -> None:
        """Answer a message that cannot be used; of those that are about nothing here, the first of each kind."""
        first = error.code not in self._logged
        self._line(error.code, str(error))
        if subject is not None:
            self._exchange.put_question(Question(self._number, self._session, subject, header.stamp, fault=error))
        elif first:
            for answer in self._planner.refused(None, header.stamp, error):
                self._exchange.put_answer(self._number, answer)

    def _exactly(self, size: int, until: float) -> bytes:
        data = bytearray()
        while len(data) < size:
            left = until - time.monotonic()
            if left <= 0.0:
                raise TimeoutError
            self._in.settimeout(left)
            more = self._in.recv(size - len(data))
            if not more:
                raise ConnectionError("ended within a message")
            data += more
        self._read_since += max(size / CHUNK, 0.5 / MOST_AT_ONCE)  # a message has two parts
        if self._read_since >= 1.0:  # enough was read since the last rest: a body as large as a chunk is enough alone
            self._read_since = 0.0
            time.sleep(REST_S)
        return bytes(data)
