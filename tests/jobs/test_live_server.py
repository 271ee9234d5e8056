"""The sockets of `live`: what is no message, floods, stalls or dies costs its sender alone; the newest counts."""

import ctypes
import json
import logging
import resource
import socket
import struct
import sys
import threading
import time
from contextlib import ExitStack, contextmanager, suppress

import numpy as np
import pytest
from igtl_client import Talk, message, point, text, transform
from refusals import refused

from puncture_twin.planning.base.errors import InputError
from puncture_twin.twin.jobs.live import server
from puncture_twin.twin.jobs.live.messages import checksum, packed, text_content
from puncture_twin.twin.jobs.live.planner import Answer, Question
from puncture_twin.twin.jobs.live.server import Exchange, bound, serve


class Slow:
    """A planner that takes its time, and answers with the text that it was sent, or a megabyte."""

    def __init__(self):
        self.begun, self.waits_s = [], 0.0

    def session(self):
        """Nothing is kept."""

    def subject(self, header):
        return {"Query": "status", "Target": "target", "Needle": "needle"}.get(header.name)

    def begin(self):
        """Nothing is made."""

    def needle(self, _):
        """None is known."""

    def answers(self, question):
        if question.message is None:
            raise question.fault
        self.begun.append((question.client, question.subject, question.stamp.fraction))
        time.sleep(self.waits_s)
        if question.message.content.endswith(b"fail"):
            raise ZeroDivisionError("as told")
        content = bytes(1_000_000) if question.subject == "target" else question.message.content
        yield Answer("Told", packed("STRING", "Told", question.stamp, content))

    def refused(self, subject, stamp, error):
        content = text_content(json.dumps({"subject": subject, "code": error.code}))
        yield Answer("Refused", packed("STRING", "Refused", stamp, content))


class Running:
    """A server in a thread; `stop` ends it as Ctrl-C does."""

    def __init__(self, planner, pose_s=server.POSE_S):
        self.planner, self.listener, self.ends = planner, bound("127.0.0.1", 0), False
        self.pose_s = pose_s
        self.port = self.listener.getsockname()[1]
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def __enter__(self):
        return self.listener.__enter__()

    def __exit__(self, *error):
        return self.listener.__exit__(*error)

    def accept(self):
        accepted = self.listener.accept()
        if self.ends:
            raise KeyboardInterrupt
        return accepted

    def run(self):
        with pytest.raises(KeyboardInterrupt):
            serve(self, self.planner, self.pose_s)

    def stop(self):
        self.ends = True
        with suppress(OSError):
            socket.create_connection(("127.0.0.1", self.port), 1.0).close()  # it wakes
        self.thread.join(10.0)
        assert not self.thread.is_alive()


@pytest.fixture
def running(monkeypatch):
    monkeypatch.setattr(server, "MESSAGE_S", 0.3)
    monkeypatch.setattr(server, "STALL_S", 0.4)
    started = Running(Slow())
    yield started
    started.stop()


def answers_well(port, said="well"):
    with Talk(port, 5.0) as talk:
        begun = time.monotonic()
        talk.send("STRING", "Query", text(said), stamp=(3, 4))
        told = talk.receive()
        return told.content == text(said) and told.stamp == (3, 4) and time.monotonic() - begun < 3.0


def as_version(number, sent):
    return struct.pack(">H", number) + sent[2:]


def test_the_checksum_is_that_of_the_standard(rng):
    """ECMA-182's check value, and the client's bit-by-bit sum of random bytes."""
    assert checksum(b"123456789") == 0x6C40DF5F0B497347 and checksum(b"") == 0
    data = rng.bytes(999)
    assert struct.pack(">Q", checksum(data)) == message("A", "b", data)[50:58]


@pytest.mark.parametrize(
    ("sent", "code"),
    [
        (message("STRING", "Query", text("a"), crc=1), "file_damaged"),
        (message("STRING", "Query", text("a"), version=2)[:58] + b"\xff" * 19, "file_damaged"),
        (as_version(2, message("STRING", "Query", struct.pack(">HHII", 12, 9, 9, 1) + b"\0" * 4)), "bad_header"),
        (as_version(2, message("STRING", "Query", b"short")), "bad_header"),
        (message("TRANSFORM", "Query", bytes(70_000)), "unknown_message"),
        (message("IMAGE", "Scan", bytes(300_000), crc=0), "unknown_message"),
        (message("STRING", "Query", text("fail")), "program_failed"),
    ],
    ids=["checksum", "body", "parts", "short", "long", "unknown", "fails"],
)
def test_a_message_that_cannot_be_used_is_answered_and_passed_over(running, sent, code, caplog):
    """The next one of the same client is answered as if nothing had been."""
    with caplog.at_level(logging.CRITICAL, logger=server.__name__), Talk(running.port) as talk:
        talk.send(sent)
        assert talk.receive().document["code"] == code
        talk.send("STRING", "Query", text("next"))
        assert talk.receive().content == text("next")


@pytest.mark.parametrize(
    "sent",
    [
        b"GET / HTTP/1.1\r\nHost: localhost\r\n\r\n" + b" " * 58,
        as_version(7, message("STRING", "Query", text("a"))),
        message("string", "Query", text("a")),
        message("STRING", "Query", size=2**63),
        message("STRING", "Query", text("half"))[:-2],
        message("STRING", "Query", text("half"))[:31],
        message("IMAGE", "Scan", bytes(10), size=1 << 29),
    ],
    ids=["http", "version", "type", "size", "half_body", "half_header", "half_image"],
)
def test_what_is_no_message_ends_its_connection_with_one_line(running, sent, caplog):
    """Within the time that a message may take; others are answered meanwhile and afterwards."""
    with caplog.at_level(logging.WARNING, logger=server.__name__), Talk(running.port, 3.0) as talk:
        talk.send(sent)
        assert answers_well(running.port)
        assert talk.ended()
    assert answers_well(running.port)
    lines = [record.getMessage() for record in caplog.records]
    assert len([line for line in lines if "disconnected" in line]) == 1
    assert len(lines) <= 2 and all(len(line.splitlines()) == 1 for line in lines)


def test_a_message_whose_time_is_over_is_not_read_on(running, monkeypatch):
    """Not even where its next bytes are there already, as of one that drips they always are."""
    monkeypatch.setattr(server, "MESSAGE_S", -1.0)
    with Talk(running.port) as talk:
        talk.send("STRING", "Query", text("late"))
        assert talk.ended()
    assert not running.planner.begun


def test_random_bytes_never_end_the_server(running):
    """Messages with bytes changed or cut, several in one, and noise: 300 connections."""
    rng = np.random.default_rng(20260101)
    good = [
        message("STRING", "Query", text("ok")),
        message("POINT", "Target", point((1.0, 2.0, 3.0)), version=2, number=3),
        message("TRANSFORM", "Needle", transform(np.eye(4))),
    ]
    for _ in range(300):
        data = bytearray(good[rng.integers(3)] * int(rng.integers(1, 4)))
        for place in rng.integers(len(data), size=int(rng.integers(0, 6))):
            data[place] = rng.integers(256)
        cut = int(rng.integers(1, len(data) + 1))
        with Talk(running.port) as talk:
            talk.send(bytes(data[:cut]) if rng.random() < 0.7 else rng.bytes(200))
    assert answers_well(running.port)
    assert running.thread.is_alive()


def test_the_newest_message_counts_and_nothing_queues(running):
    """A needle at 500 Hz before a planner that takes 50 ms: few answers, and the last one is of the last message."""
    running.planner.waits_s = 0.05
    with Talk(running.port) as talk:
        begun = time.monotonic()
        for number in range(100):
            talk.send("TRANSFORM", "Needle", transform(np.eye(4)), stamp=(0, number))
            time.sleep(0.002)
        sent = time.monotonic()
        stamps = [talk.receive().stamp[1]]
        while stamps[-1] != 99:
            stamps.append(talk.receive().stamp[1])
    ended = time.monotonic()
    assert ended - sent < 2.0
    assert stamps == sorted(set(stamps)) and len(stamps) <= 2 + (ended - begun) / 0.05
    assert [number for _, _, number in running.planner.begun] == stamps


def test_a_target_that_moves_faster_than_its_map_leaves_the_needle_its_turn(running):
    """Both at 500 Hz before a planner that takes 20 ms: they are answered in turns, and the last are the last sent."""
    running.planner.waits_s = 0.02
    with Talk(running.port) as talk:
        reader = threading.Thread(target=talk.ended)
        reader.start()
        for number in range(200):
            for name in ("Target", "Needle"):
                talk.send("TRANSFORM", name, transform(np.eye(4)), stamp=(0, number))
            time.sleep(0.002)
        sent = len(running.planner.begun)
        time.sleep(0.3)
        talk.socket.shutdown(socket.SHUT_RDWR)
        reader.join(5.0)
    numbers = {"target": [], "needle": []}
    for _, subject, number in running.planner.begun:
        numbers[subject].append(number)
    assert all(one == sorted(set(one)) and one[-1] == 199 for one in numbers.values())
    needles = [subject for _, subject, _ in running.planner.begun[:sent]].count("needle")
    assert abs(2 * needles - sent) <= 2 and sent > 6


@contextmanager
def flooded(running, data, count):
    stop = threading.Event()

    def send_on():
        with Talk(running.port) as talk:
            while not stop.is_set():
                talk.send(data)

    floods = [threading.Thread(target=send_on) for _ in range(count)]
    for one in floods:
        one.start()
    try:
        yield
    finally:
        stop.set()
        running.planner.waits_s = 0.0
        for one in floods:
            one.join(10.0)
    assert not any(one.is_alive() for one in floods)


def test_one_client_that_floods_does_not_keep_another_waiting(running):
    """Each has its turn: between two answers to the other there is one to the flood."""
    running.planner.waits_s = 0.01
    with flooded(running, message("TRANSFORM", "Needle", transform(np.eye(4))) * 200, 2):
        time.sleep(0.1)
        with Talk(running.port) as talk:
            for number in range(10):
                begun = time.monotonic()
                talk.send("STRING", "Query", text("me"), stamp=(0, number))
                assert talk.receive().stamp == (0, number) and time.monotonic() - begun < 2.0


def test_a_client_that_reads_nothing_is_let_go_and_takes_little_memory(running):
    """It asks a thousand times for a megabyte; one waits for it, and after a while it is gone."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with socket.socket() as deaf:
        deaf.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        deaf.connect(("127.0.0.1", running.port))
        asked = message("POINT", "Target", point((1.0, 2.0, 3.0)))
        begun = time.monotonic()
        with suppress(ConnectionError):
            deaf.sendall(asked * 1000)
            while time.monotonic() - begun < 60.0:
                assert answers_well(running.port)
                deaf.sendall(asked)
        assert time.monotonic() - begun < 60.0
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000  # KB


@contextmanager
def no_place_left(running):
    """As many clients as have a place, each answered; one more is not heard."""
    with ExitStack() as stack:
        talks = [stack.enter_context(Talk(running.port)) for _ in range(server.MOST_CLIENTS)]
        for talk in talks:
            talk.send("STRING", "Query", text("x"))
            assert talk.receive().content == text("x")
        with Talk(running.port) as late:
            assert late.ended()
        yield talks


def test_one_client_too_many_is_not_heard_and_a_place_is_free_again(running):
    with no_place_left(running) as talks:
        talks[-1].socket.close()
        time.sleep(0.1)
        assert answers_well(running.port)


ACCEPT_NOTHING = struct.pack("HHBBI", 0x06, 0, 0, 0, 0)
"""A filter of one instruction: of every packet that comes to a socket, keep 0 bytes."""


def vanish(talk):
    """Let a client's machine go without a word: nothing that is sent to it arrives, or is acknowledged."""
    code = ctypes.create_string_buffer(ACCEPT_NOTHING)
    program = struct.pack("HL", 1, ctypes.addressof(code))
    talk.socket.setsockopt(socket.SOL_SOCKET, getattr(socket, "SO_ATTACH_FILTER", 26), program)


@pytest.mark.skipif(sys.platform != "linux", reason="a socket filter of Linux")
@pytest.mark.parametrize("waits", [False, True], ids=["silent", "answers_on_their_way"])
def test_clients_that_vanish_leave_their_places(running, monkeypatch, waits):
    """All of them at once, without a last word: others are served after the time in which the system probes them."""
    monkeypatch.setattr(server, "VANISHED_S", 4.0)
    with no_place_left(running) as talks:
        for talk in talks:
            vanish(talk)
            if waits:
                talk.send("STRING", "Query", text("x"))
        begun = time.monotonic()
        while not place_is_free(running.port):
            assert time.monotonic() - begun < 20.0
            time.sleep(0.2)
        assert time.monotonic() - begun > 1.0


def place_is_free(port):
    with suppress(ConnectionError):
        return answers_well(port)
    return False


def test_a_client_that_only_listens_keeps_its_place(running, monkeypatch):
    """Its machine is there: a navigation program says nothing while nobody moves the target."""
    monkeypatch.setattr(server, "VANISHED_S", 1.0)
    with Talk(running.port) as quiet:
        time.sleep(3.5)
        quiet.send("STRING", "Query", text("still here"))
        assert quiet.receive().content == text("still here")


def test_a_tracker_that_stops_leaves_no_verdict_behind():
    """After the time for which a pose counts: once, to its own client alone; a new pose is answered again."""
    running = Running(Slow(), pose_s=0.5)
    try:
        with Talk(running.port) as tracked, Talk(running.port) as other:
            other.send("STRING", "Query", text("x"))
            assert other.receive().content == text("x")
            for turn in range(2):
                for number in range(10):  # for longer than a pose counts
                    tracked.send("TRANSFORM", "Needle", transform(np.eye(4)), stamp=(turn, number))
                    assert tracked.receive().stamp == (turn, number)
                    time.sleep(0.08)
                sent = time.monotonic()
                said = tracked.receive()
                assert said.stamp == (turn, 9) and time.monotonic() - sent < 5.0
                assert said.document == {"subject": "needle", "code": "needle_silent"}
            for talk in (tracked, other):
                talk.socket.settimeout(0.8)
                with pytest.raises(TimeoutError):
                    talk.receive()
    finally:
        running.stop()


def test_a_flood_of_others_does_not_hide_that_a_tracker_stopped():
    """And a pose that still waits when it counts no longer is not answered as if it were new."""
    running = Running(Slow(), pose_s=0.3)
    running.planner.waits_s = 0.05
    try:
        with flooded(running, message("STRING", "Query", text("flood")), 3), Talk(running.port) as tracked:
            tracked.send("TRANSFORM", "Needle", transform(np.eye(4)), stamp=(0, 1))
            assert tracked.until("Refused").document["code"] == "needle_silent"
            running.planner.waits_s = 0.5
            time.sleep(0.1)
            tracked.send("TRANSFORM", "Needle", transform(np.eye(4)), stamp=(0, 2))
            said = tracked.receive()
            assert (said.name, said.stamp) == ("Refused", (0, 2))
    finally:
        running.stop()
    assert ("needle", 2) not in [one[1:] for one in running.planner.begun]


def test_a_log_that_many_write_to_stays_short(running, caplog):
    with caplog.at_level(logging.WARNING, logger=server.__name__):
        for _ in range(50):
            with Talk(running.port) as talk:
                talk.send(b"x" * 58)
                assert talk.ended()
    assert 10 <= len(caplog.records) <= server.MOST_LINES


def test_a_name_cannot_write_lines_of_its_own_into_the_log(running, caplog):
    with caplog.at_level(logging.WARNING, logger=server.__name__), Talk(running.port) as talk:
        talk.send("IMAGE", "\x1b[31m\nlive: client\x07", b"")
        assert talk.receive().document["code"] == "unknown_message"
    assert len(caplog.records) == 1 and caplog.records[0].getMessage().isprintable()


def test_an_address_that_is_not_loopback_is_warned_of(caplog):
    """And one that is taken, or none of this machine's, is refused."""
    with caplog.at_level(logging.WARNING, logger=server.__name__):
        for host in ("127.0.0.1", "localhost"):
            with bound(host, 0) as one, refused("port_not_free"):
                bound(host, one.getsockname()[1])
        assert caplog.records == []
        bound("0.0.0.0", 0).close()
    assert len(caplog.records) == 1
    for host in ("192.0.2.7", "no.such.host.invalid", "", "a\0b", "x" * 300):
        with refused("port_not_free" if host.startswith("192") else "bad_host"):
            bound(host or "no host", 0)


def test_questions_take_turns_and_a_target_comes_before_a_needle():
    exchange = Exchange()
    stamp = (1, 0, 0, 0)
    for client in (1, 2):
        exchange.open(client)
        for subject in ("needle", "target", "needle"):
            exchange.put_question(Question(client, None, subject, stamp))
    exchange.put_question(Question(3, None, "needle", stamp))  # a client that is gone
    taken = [exchange.take() for _ in range(4)]
    assert [(one.client, one.subject) for one in taken] == [(1, "target"), (2, "target"), (1, "needle"), (2, "needle")]
    assert taken[3].stamp == stamp
    exchange.put_question(Question(2, None, "needle", stamp))
    exchange.drop(2)
    exchange.close()
    assert exchange.take() is None


def test_an_answer_too_long_for_a_text_is_refused():
    assert len(text_content("x" * 65_535)) == 65_539
    with pytest.raises(InputError):
        text_content("x" * 65_536)
