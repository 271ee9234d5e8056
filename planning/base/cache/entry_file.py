"""One entry of the cache as bytes: named arrays behind a digest of all that follows, and of what they were made from.

The digest is checked before anything is parsed, so a file that is cut, damaged or another's is never looked into. It is
no signature: who may write into the cache can make an entry that passes. So nothing is read that another user owns, or
may write.
"""

import hashlib
import json
import os
import stat
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import InputError

Arrays = dict[str, NDArray[Any]]
MAGIC = b"puncture-twin arrays 3".ljust(31) + b"\n"
"""With the digest behind it 64 bytes: arrays lie in the file as in its body, and are read where they are."""
DIGEST_BYTES = 32
ALIGNED = 64
"""Arrays start at multiples of this within the file's body: compiled code reads them as they lie."""


class DamagedError(Exception):
    """Raised for an entry whose content is not what was written under its name."""


def packed(arrays: Arrays, key: str) -> bytes:
    """Bytes of the entry file that holds these arrays."""
    whole = {name: np.asarray(array, order="C") for name, array in arrays.items()}
    header = json.dumps([[name, array.dtype.str, array.shape] for name, array in whole.items()]).encode() + b"\n"
    body = bytearray(header)
    for array in whole.values():
        body += bytes(-len(body) % ALIGNED) + array.tobytes()
    return MAGIC + _digest(body, key) + bytes(body)


def unpacked(content: bytes, key: str) -> Arrays:
    """The arrays of an entry file, read-only. Raises DamagedError: it is not the file that was written for this key."""
    start = len(MAGIC) + DIGEST_BYTES
    body = memoryview(content)[start:]
    if not content.startswith(MAGIC) or content[len(MAGIC) : start] != _digest(body, key):
        raise DamagedError("is truncated, damaged, or foreign")
    try:
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
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError) as error:
        raise DamagedError(f"cannot be read ({error})") from error


def check_own(path: Path) -> None:
    """Refuse a file of a cache, there or not, that is another user's or that others may write, and such a folder of it.

    Folders are followed to the root, or to one of which the user lets nobody in: what lies below is out of reach. In
    one that all may write to, as ``/tmp``, nobody can replace what is another's if its sticky bit is set. Where users
    have no numbers (Windows) nothing is refused.
    """
    if not hasattr(os, "geteuid"):
        return
    in_reach = _in_reach(path.parent.resolve())
    try:
        status = path.lstat()
    except OSError:
        return
    _refuse_foreign(path, status)
    if in_reach and not stat.S_ISLNK(status.st_mode):
        _refuse_writable(path, status)


def check_own_folder(folder: Path) -> None:
    """Refuse a folder of compiled code that is a link, another user's, or that others may write: see `check_own`."""
    check_own(folder)  # and those around it, where others could lay another in its place
    status = folder.lstat()
    if stat.S_ISLNK(status.st_mode):
        raise _refusal(folder, "is a link")
    if hasattr(os, "geteuid") and status.st_mode & (stat.S_IWGRP | stat.S_IWOTH):
        _refuse_writable(folder, status)


def _in_reach(folder: Path) -> bool:
    """Whether others can come to what is in a folder, which is found to be the user's own."""
    try:
        status = folder.stat()
    except OSError:
        return _in_reach(folder.parent)  # it is made there, by the user
    return _known_in_reach(folder, status.st_uid, status.st_gid, status.st_mode)


@cache
def _known_in_reach(folder: Path, uid: int, gid: int, mode: int) -> bool:
    """`_in_reach` of a folder of this owner and mode; the folders around it are looked at once in a process."""
    status = folder.stat()
    _refuse_foreign(folder, status)
    if not _open_to_others(status, stat.S_IXGRP, stat.S_IXOTH):
        return False
    in_reach = folder == folder.parent or _in_reach(folder.parent)
    if in_reach and not mode & stat.S_ISVTX:
        _refuse_writable(folder, status)
    return in_reach


def trusted_owners() -> frozenset[int]:
    """The user, the system's, and whoever owns this code: who can change it needs no cache."""
    return frozenset((os.geteuid(), 0, Path(__file__).stat().st_uid))


def _refuse_foreign(path: Path, status: os.stat_result) -> None:
    if status.st_uid not in trusted_owners():
        raise _refusal(path, f"belongs to another user (uid {status.st_uid})")


def _refuse_writable(path: Path, status: os.stat_result) -> None:
    if _open_to_others(status, stat.S_IWGRP, stat.S_IWOTH):
        raise _refusal(path, f"is writable by others (mode {stat.S_IMODE(status.st_mode):03o})")


def _open_to_others(status: os.stat_result, of_group: int, of_all: int) -> bool:
    """Whether a permission is given to all, or to a group that has other members than the user."""
    return bool(status.st_mode & of_all) or (bool(status.st_mode & of_group) and not _alone_in(status.st_gid))


@cache
def _alone_in(gid: int) -> bool:
    """Whether a group is one of the user's own, named after them, as many systems make one for each."""
    import grp
    import pwd

    try:
        user, group = pwd.getpwuid(os.geteuid()), grp.getgrgid(gid)
    except KeyError:
        return False
    return user.pw_gid == gid and group.gr_name == user.pw_name and set(group.gr_mem) <= {user.pw_name}


def _refusal(path: Path, what: str) -> InputError:
    allowed = (
        "a cache folder that only you can write to: use chown, chmod go-w, or another folder in $PUNCTURE_TWIN_CACHE "
        "or $NUMBA_CACHE_DIR"
    )
    return InputError(f"the cache {what}; it is not used", where=path, allowed=allowed, code="cache_not_own")


def read_plain_file(path: Path) -> bytes:
    """The bytes of a regular file; a pipe is not waited for. Raises FileNotFoundError, DamagedError: it is none."""
    try:
        if not stat.S_ISREG(os.lstat(path).st_mode):
            raise DamagedError("is not a regular file")
        return path.read_bytes()
    except (FileNotFoundError, NotADirectoryError):
        raise FileNotFoundError(path) from None
    except OSError as error:
        raise DamagedError(f"cannot be read ({error.strerror})") from error


def _digest(body: bytes | bytearray | memoryview, key: str) -> bytes:
    digest = hashlib.sha256(key.encode() + b"\n")
    digest.update(body)
    return digest.digest()
