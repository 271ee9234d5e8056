"""OpenIGTLink messages as bytes: read strictly, and written. Points and axes are RAS, mm, as they travel.

Source: the OpenIGTLink protocol, versions 1 to 3 (openigtlink.org). Numbers are big-endian. A header of 58 bytes
precedes the body; with header version 2 that is an extended header, the content, and metadata. The checksum is the
CRC-64 of ECMA-182. pyigtl (0.3.4) verifies none, and cannot read a POLYDATA: the tests speak with it.
"""

import re
import struct
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import nb

HEADER = struct.Struct(">H12s20sIIQQ")
EXTENDED = struct.Struct(">HHII")  # sizes of this header, of the metadata's index and the metadata; number
NO_METADATA = b"\0\0"
VERSIONS = (1, 2)
MOST_BODY = 1 << 30  # bytes that a header may claim: nonsense is not waited for, an image is passed over
KIND = re.compile(rb"[A-Z][A-Z0-9_]*\0*")
MOST_TEXT = 65_535  # bytes of a STRING: its length has two
ASCII, UTF8 = 3, 106  # a text's encoding, by its number at IANA
ORTHOGONAL = 1e-3  # how far R^T R may be from 1: a tracker's own rounding; only the axis is used
POINT = struct.Struct(">64s32s4B3ff20s")
TRACKED = struct.Struct(">20sBB48s")
IMAGE = struct.Struct(">HBBBB3H12f6H")
UINT16, LITTLE, RAS = 5, 2, 1  # an image's type of numbers, their order, and its space
MESH = struct.Struct(">10I")
SCALAR = struct.Struct(">BBI")
POINT_SCALAR = 0x00
STATUS = struct.Struct(">Hq20s")
READY, TIMED_OUT = 1, 7  # codes of a STATUS


class Stamp(NamedTuple):
    """Identity of a message, which its answer repeats: version of the header, time, number."""

    version: int
    seconds: int
    fraction: int  # of a second, in 2^-32
    number: int

    @property
    def time_s(self) -> float:
        """Seconds since 1970."""
        return self.seconds + self.fraction / 2**32


class Header(NamedTuple):
    """Header of a message, before its body has come."""

    kind: str
    name: str
    stamp: Stamp  # without the number, which the body has
    size: int
    checksum: int


class Message(NamedTuple):
    """A whole message; its content without extended header and metadata."""

    kind: str
    name: str
    stamp: Stamp
    content: bytes


def read_header(data: bytes) -> Header:
    """A header of 58 bytes; none is refused: whatever follows it cannot be told apart any more."""
    version, kind, name, seconds, fraction, size, code = HEADER.unpack(data)
    if version not in VERSIONS or not KIND.fullmatch(kind):
        what = f"no header of a message (version {version}, type {kind!r})"
        refuse(what, "OpenIGTLink", f"version {' or '.join(map(str, VERSIONS))}, a type in capitals", "bad_header")
    if size > MOST_BODY:
        refuse(f"a body of {size} bytes", "OpenIGTLink", f"at most {MOST_BODY}", "too_large")
    return Header(_word(kind), _word(name), Stamp(version, seconds, fraction, 0), size, code)


def read_message(header: Header, body: bytes) -> Message:
    """The message of a header and its body; another checksum, or parts that do not fit, are refused."""
    if checksum(body) != header.checksum:
        refuse("its checksum is another", f"{header.kind} {header.name}", "the CRC-64 of its body", "file_damaged")
    if header.stamp.version == 1:
        return Message(header.kind, header.name, header.stamp, body)
    first, index, metadata, number = EXTENDED.unpack(body[: EXTENDED.size].ljust(EXTENDED.size, b"\0"))
    if not EXTENDED.size <= first <= len(body) - index - metadata:
        what = f"parts of {first}, {index} and {metadata} bytes in a body of {len(body)}"
        refuse(what, f"{header.kind} {header.name}", "parts that fit", "bad_header")
    content = body[first : len(body) - index - metadata]
    return Message(header.kind, header.name, header.stamp._replace(number=number), content)


def read_place(message: Message) -> Floats:
    """The point (3,) of a POINT, or the origin of a TRANSFORM; an `InputError` if not one point, or not finite."""
    if message.kind == "TRANSFORM":
        return _finite(_matrix(message.content, message)[:, 3], message)
    if len(message.content) != POINT.size:
        _refuse_content(message, f"{len(message.content) / POINT.size:g} points", "one point", "wrong_count")
    return _finite(np.array(POINT.unpack(message.content)[6:9], float), message)


def read_pose(message: Message, name: str) -> tuple[Floats, Floats]:
    """Origin (3,) and z-axis (3,), unit, of a TRANSFORM, or of the tool of this name of a TDATA.

    Raises InputError: No such tool, a number that is not finite, or axes that no rotation has.
    """
    content = message.content
    if message.kind == "TDATA":
        if len(content) % TRACKED.size:
            _refuse_content(message, f"{len(content)} bytes", f"{TRACKED.size} bytes a tool", "wrong_shape")
        tools = {_word(tool): pose for tool, _, _, pose in TRACKED.iter_unpack(content)}
        if name not in tools:
            _refuse_content(message, f"no tool '{name}' among {len(tools)}", f"a tool '{name}'", "unknown_name")
        content = tools[name]
    matrix = _finite(_matrix(content, message), message)
    R, size = matrix[:, :3], np.abs(matrix[:, :3]).max()
    if not size < 2.0 or np.abs(R.T @ R - np.eye(3)).max() > ORTHOGONAL or np.linalg.det(R) < 0.0:
        _refuse_content(message, "axes that no rotation has", "three unit vectors, right-handed", "not_rigid")
    return matrix[:, 3], R[:, 2] / np.linalg.norm(R[:, 2])


def _matrix(content: bytes, message: Message) -> Floats:
    """Shape (3, 4): rotation and translation; it travels column by column."""
    if len(content) != 48:
        _refuse_content(message, f"{len(content)} bytes", "12 numbers of 4 bytes", "wrong_shape")
    with np.errstate(invalid="ignore"):  # of a signalling NaN, which is refused later
        return np.frombuffer(content, ">f4").astype(float).reshape(4, 3).T


def _finite(values: Floats, message: Message) -> Floats:
    if not np.isfinite(values).all():
        _refuse_content(message, "a number that is not finite", "finite numbers", "not_finite")
    return values


def _refuse_content(message: Message, what: str, allowed: str, code: str) -> None:
    refuse(what, f"{message.kind} {message.name}", allowed, code)


def _word(field: bytes) -> str:
    return field.split(b"\0", 1)[0].decode("ascii", "replace")


def packed(kind: str, name: str, stamp: Stamp, content: bytes) -> bytes:
    """A whole message that answers one of this stamp."""
    body = content
    if stamp.version == 2:
        body = EXTENDED.pack(EXTENDED.size, len(NO_METADATA), 0, stamp.number) + content + NO_METADATA
    head = (stamp.version, kind.encode(), name.encode(), stamp.seconds, stamp.fraction, len(body), checksum(body))
    return HEADER.pack(*head) + body


def text_content(text: str) -> bytes:
    """Content of a STRING; one too long is refused."""
    data = text.encode()
    if len(data) > MOST_TEXT:
        refuse(f"an answer of {len(data)} bytes", "STRING", f"at most {MOST_TEXT} bytes", "too_large")
    return struct.pack(">HH", ASCII if data.isascii() else UTF8, len(data)) + data


def point_content(point: Sequence[float] | Floats | None, name: str) -> bytes:
    """Content of a POINT with this one point; None has no point, which takes an earlier one from a screen."""
    if point is None:
        return b""
    return POINT.pack(name.encode()[:63], b"", *(255, 255, 0, 255), *point, 0.0, b"")


def image_content(values: NDArray[np.uint16], first: tuple[float, float], step: float) -> bytes:
    """Content of an IMAGE of one slice; `first` are coordinates along a row and along a column."""
    rows, columns = values.shape
    middle = first[0] + step * (columns - 1) / 2.0, first[1] + step * (rows - 1) / 2.0
    axes = (step, 0.0, 0.0, 0.0, step, 0.0, 0.0, 0.0, 1.0, *middle, 0.0)
    size = (columns, rows, 1)
    return IMAGE.pack(1, 1, UINT16, LITTLE, RAS, *size, *axes, 0, 0, 0, *size) + values.astype("<u2").tobytes()


def mesh_content(points: Floats, cells: bytes, scalars: Mapping[str, NDArray[Any]]) -> bytes:
    """Content of a POLYDATA of points (p, 3), quads as of `quad_bytes`, and scalars (p,) by name."""
    count = len(cells) // (5 * 4)
    names = b"".join(name.encode() + b"\0" for name in scalars)
    head = MESH.pack(len(points), 0, 0, 0, 0, count, len(cells), 0, 0, len(scalars))
    kinds = SCALAR.pack(POINT_SCALAR, 1, len(points)) * len(scalars)
    data = b"".join(np.asarray(values, ">f4").tobytes() for values in scalars.values())
    return head + np.asarray(points, ">f4").tobytes() + cells + kinds + names + b"\0" * (len(names) % 2) + data


def quad_bytes(quads: Ints) -> bytes:
    """Quads, shape (n, 4), rows of points, as a POLYDATA holds them: each after its number of points."""
    return np.insert(quads, 0, 4, axis=1).astype(">u4").tobytes()


def status_content(code: int, text: str) -> bytes:
    """Content of a STATUS."""
    return STATUS.pack(code, 0, b"") + text.encode() + b"\0"


def checksum(data: bytes) -> int:
    """The CRC-64 of ECMA-182.

    >>> hex(checksum(b"123456789"))
    '0x6c40df5f0b497347'
    """
    return int(_crc64(np.frombuffer(data, np.uint8), _TABLE))


def _table() -> NDArray[np.uint64]:
    """The remainder of each byte x^64, by x^64 + ... of 0x42F0E1EBA9EA3693."""
    rest = np.arange(256, dtype=np.uint64) << np.uint64(56)
    for _ in range(8):
        top = rest >> np.uint64(63)
        rest = (rest << np.uint64(1)) ^ (top * np.uint64(0x42F0E1EBA9EA3693))
    return rest


_TABLE = _table()


@nb.njit(cache=True, nogil=True)
def _crc64(data: Any, table: Any) -> Any:
    crc = np.uint64(0)
    for byte in data:
        crc = table[(crc >> np.uint64(56)) ^ np.uint64(byte)] ^ (crc << np.uint64(8))
    return crc
