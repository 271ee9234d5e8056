"""A controller's half of RTDE, protocol version 2, in a process of its own: for tests of whoever reads a robot.

A process, because the library under test holds the interpreter's lock while it waits for an answer.
Source: Universal Robots, "Real-Time Data Exchange (RTDE) Guide". A package is its size (two bytes), its type (one) and
its content, all numbers big-endian.
"""

import json
import selectors
import socket
import struct
import subprocess
import sys
import time
from contextlib import contextmanager

PORT = 30004
OTHER_PORTS = (29999, 30001, 30002, 30003, 30011, 30012, 30013)
"""On which a controller takes commands or programs: the dashboard, the primary, secondary and real-time interfaces."""
PERIOD_S = 1.0 / 125.0
START_S = 1000.0
"""The controller's clock at its first package."""
TYPES = {"timestamp": ("DOUBLE", ">d"), "actual_q": ("VECTOR6D", ">6d")}
"""The two variables that are served: the guide's type, and how it is packed."""
RECIPE = 1
CB3 = (3, 15, 8, 106339)
"""The version of a controller that speaks at 125 Hz."""


class Controller:
    """Serves joint angles at 125 Hz to one reader, and keeps what it is sent."""

    def __init__(self, host: str, rows: list[list[float]]) -> None:
        self.rows, self.sent, self.hangs = rows, 0, False
        self.received: list[tuple[str, str]] = []
        self.knocks: list[int] = []
        self.reader: socket.socket | None = None
        self.waiting, self.names, self.sending = b"", [], False
        self.selector = selectors.DefaultSelector()
        for port in (PORT, *OTHER_PORTS):
            self.selector.register(socket.create_server((host, port)), selectors.EVENT_READ, port)
        self.selector.register(sys.stdin, selectors.EVENT_READ, "stdin")

    def run(self) -> None:
        """Serve until standard input says ``end``: then tell what came, as JSON."""
        self.report("ready")
        due = time.monotonic()
        while True:
            for key, _ in self.selector.select(max(0.0, due - time.monotonic())):
                if key.data == "stdin":
                    order = sys.stdin.readline().strip()
                    if order in ("end", ""):
                        self.report(json.dumps({"received": self.received, "knocks": self.knocks}))
                        return
                    self.obey(order)
                elif key.data == "reader":
                    self.listen()
                else:
                    self.welcome(key.fileobj.accept()[0], key.data)
            if time.monotonic() >= due:
                due += PERIOD_S
                if self.sending and not self.hangs:
                    self.say("U", self.package())

    @staticmethod
    def report(line: str) -> None:
        sys.stdout.write(line + "\n")
        sys.stdout.flush()

    def obey(self, order: str) -> None:
        """``hang``: no package comes any more, and the line stays open. ``hang up``: the line is closed."""
        if order == "hang":
            self.hangs = True
        elif order == "hang up":
            self.leave()

    def welcome(self, caller: socket.socket, port: int) -> None:
        """A reader on RTDE's port; anyone on another port is noted and sent away."""
        if port != PORT:
            self.knocks.append(port)
            caller.close()
            return
        self.leave()
        self.reader = caller
        self.selector.register(caller, selectors.EVENT_READ, "reader")

    def leave(self) -> None:
        if self.reader is not None:
            self.selector.unregister(self.reader)
            self.reader.close()
        self.reader, self.waiting, self.sending = None, b"", False

    def listen(self) -> None:
        try:
            some = self.reader.recv(4096)
        except ConnectionError:
            some = b""
        if not some:
            self.leave()
            return
        self.waiting += some
        while len(self.waiting) >= 3 and len(self.waiting) >= (size := struct.unpack(">H", self.waiting[:2])[0]):
            kind, content, self.waiting = chr(self.waiting[2]), self.waiting[3:size], self.waiting[size:]
            self.received.append((kind, content.hex()))
            self.say(kind, self.reply(kind, content))

    def reply(self, kind: str, content: bytes) -> bytes:
        if kind == "V":
            return struct.pack(">B", content == struct.pack(">H", 2))
        if kind == "v":
            return struct.pack(">4I", *CB3)
        if kind == "O":
            self.names = [name for name in content[8:].decode().split(",") if name]
            return struct.pack(">B", RECIPE) + ",".join(TYPES.get(n, ("NOT_FOUND",))[0] for n in self.names).encode()
        if kind in "SP":
            self.sending = kind == "S"
            return b"\1"
        return b"\0"  # anything else is refused

    def package(self) -> bytes:
        row = self.rows[min(self.sent, len(self.rows) - 1)]
        values = {"timestamp": [START_S + self.sent * PERIOD_S], "actual_q": row}
        self.sent += 1
        return struct.pack(">B", RECIPE) + b"".join(struct.pack(TYPES[n][1], *values[n]) for n in self.names)

    def say(self, kind: str, content: bytes) -> None:
        try:
            self.reader.sendall(struct.pack(">HB", 3 + len(content), ord(kind)) + content)
        except ConnectionError:
            self.leave()


class Heard:
    """What a controller was sent, and whose orders it takes."""

    def __init__(self, process: subprocess.Popen) -> None:
        self._process = process
        self.received: list[tuple[str, bytes]] = []
        self.knocks: list[int] = []

    def order(self, what: str) -> None:
        """``hang`` or ``hang up``, see :meth:`Controller.obey`."""
        self._process.stdin.write(what + "\n")
        self._process.stdin.flush()

    def end(self) -> None:
        if self._process.poll() is None:
            said = json.loads(self._process.communicate("end\n", timeout=20)[0])
            self.received = [(kind, bytes.fromhex(content)) for kind, content in said["received"]]
            self.knocks = said["knocks"]


@contextmanager
def rtde_server(host: str, rows):
    """A running controller on a loopback address; on leaving, what it heard is known."""
    command = [sys.executable, __file__, host]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    heard = Heard(process)
    try:
        heard.order(json.dumps([[float(q) for q in row] for row in rows]))
        assert process.stdout.readline() == "ready\n"
        yield heard
        heard.end()
    finally:
        process.kill()
        process.wait()


if __name__ == "__main__":
    Controller(sys.argv[1], json.loads(sys.stdin.readline())).run()
