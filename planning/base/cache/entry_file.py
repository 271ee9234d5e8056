"""One entry of the cache as bytes: named arrays behind a digest of all that follows, and of what they were made from.

The digest is checked before anything is parsed, so a file that is cut, damaged or another's is never looked into.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

Arrays = dict[str, NDArray[Any]]

MAGIC = b"puncture-twin arrays 3".ljust(31) + b"\n"
"""With the digest behind it 64 bytes: arrays lie in the file as in its body, and are read where they are."""
DIGEST_BYTES = 32
ALIGNED = 64
"""Arrays start at multiples of this within the file's body: compiled code reads them as they lie."""


class DamagedError(Exception):
    """An entry that is not what was written under its name."""


def packed(arrays: Arrays, key: str) -> bytes:
    """The file that holds these arrays.

    Args:
        arrays: Of numbers, truth values or text.
        key: What they were made from.
    """
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    header = json.dumps([[name, array.dtype.str, array.shape] for name, array in whole.items()]).encode() + b"\n"
    body = bytearray(header)
    for array in whole.values():
        body += bytes(-len(body) % ALIGNED) + array.tobytes()
    return MAGIC + _digest(body, key) + bytes(body)


def unpacked(content: bytes, key: str) -> Arrays:
    """The arrays of a file, read-only.

    Raises:
        DamagedError: It is not the file that was written for this key.
    """
    start = len(MAGIC) + DIGEST_BYTES
    body = memoryview(content)[start:]
    if not content.startswith(MAGIC) or content[len(MAGIC) : start] != _digest(body, key):
        raise DamagedError("is cut, damaged, or another's")
    try:
        return _arrays(content, start)
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise DamagedError(f"cannot be understood ({error})") from error


def read_plain_file(path: Path) -> bytes:
    """The content of a file that is really one; a pipe is not waited for.

    Raises:
        FileNotFoundError: It is not there.
        DamagedError: It is something else than a file, or cannot be read.
    """
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):
            raise DamagedError("is no plain file")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(path) from None
    except OSError as error:
        raise DamagedError(f"cannot be read ({error.strerror})") from error


def _digest(body: bytes | bytearray | memoryview, key: str) -> bytes:
    digest = hashlib.sha256(key.encode() + b"\n")
    digest.update(body)
    return digest.digest()


def _arrays(content: bytes, start: int) -> Arrays:
    at = content.index(b"\n", start) + 1
    arrays: Arrays = {}
    for name, dtype, shape in json.loads(content[start:at]):
        at += -at % ALIGNED
        kind, count = np.dtype(dtype), int(np.prod(shape, dtype=np.int64))
        if kind.hasobject:
            raise ValueError("objects")
        arrays[name] = np.frombuffer(content, kind, count, at).reshape(shape)
        at += count * kind.itemsize
    return arrays
