"""The other end of OpenIGTLink, for tests: a plain socket, and messages packed and read by the protocol's own tables.

It shares no code with the server; its checksum goes bit by bit.
"""

import json
import socket
import struct
from typing import NamedTuple

import numpy as np

HEADER = struct.Struct(">H12s20sIIQQ")


class Received(NamedTuple):
    """A message as it came."""

    version: int
    kind: str
    name: str
    stamp: tuple[int, int]
    number: int
    content: bytes

    @property
    def document(self):
        encoding, size = struct.unpack(">HH", self.content[:4])
        assert encoding in (3, 106) and size == len(self.content) - 4
        return json.loads(self.content[4:])


def crc64(data):
    """ECMA-182, bit by bit."""
    crc = 0
    for byte in data:
        crc ^= byte << 56
        for _ in range(8):
            crc = ((crc << 1) ^ (0x42F0E1EBA9EA3693 if crc >> 63 else 0)) & (2**64 - 1)
    return crc


def message(kind, name, content=b"", *, version=1, stamp=(0, 0), number=0, crc=None, size=None):
    """A whole message; a checksum or size that is stated is the header's, whatever the body."""
    body = content if version == 1 else struct.pack(">HHII", 12, 2, 0, number) + content + b"\0\0"
    size, crc = len(body) if size is None else size, crc64(body) if crc is None else crc
    return HEADER.pack(version, kind.encode(), name.encode(), *stamp, size, crc) + body


def transform(matrix):
    return np.asarray(matrix, float)[:3].T.astype(">f4").tobytes()


def point(*places):
    return b"".join(struct.pack(">64s32s4B3ff20s", b"P", b"", 1, 2, 3, 4, *place, 0.0, b"") for place in places)


def tools(**matrices):
    return b"".join(struct.pack(">20sBB", name.encode(), 2, 0) + transform(T) for name, T in matrices.items())


def text(words):
    return struct.pack(">HH", 3, len(words)) + words.encode()


class Talk:
    """A connection to a server."""

    def __init__(self, port, timeout_s=20.0):
        self.socket = socket.create_connection(("127.0.0.1", port), timeout=timeout_s)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self.socket.close()

    def send(self, *parts, **named):
        self.socket.sendall(parts[0] if isinstance(parts[0], bytes) else message(*parts, **named))

    def exactly(self, count):
        data = bytearray()
        while len(data) < count:
            more = self.socket.recv(count - len(data))
            if not more:
                raise ConnectionError(f"ended after {len(data)} of {count} bytes")
            data += more
        return bytes(data)

    def receive(self):
        version, kind, name, *stamp, size, crc = HEADER.unpack(self.exactly(58))
        body = self.exactly(size)
        assert size > 10_000 or crc64(body) == crc  # of long ones the library's client verifies it
        number = 0
        if version == 2:
            first, index, metadata, number = struct.unpack(">HHII", body[:12])
            body = body[first : len(body) - index - metadata]
        words = (field.rstrip(b"\0").decode() for field in (kind, name))
        return Received(version, *words, tuple(stamp), number, body)

    def until(self, name):
        while (found := self.receive()).name != name:
            pass
        return found

    def ended(self):
        """Whether the other end has hung up, whatever it said before."""
        try:
            while self.socket.recv(65536):
                pass
        except ConnectionError:
            pass
        except TimeoutError:
            return False
        return True
