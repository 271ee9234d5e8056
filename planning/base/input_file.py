"""The bytes of an input file: it must be there, be a file, and have a plausible size before anything is read."""

from __future__ import annotations

from pathlib import Path

from puncture_twin.planning.base.errors import InputError


def read_input(path: Path, *, max_bytes: int, where: str) -> bytes:
    """All bytes of a file.

    Args:
        path: The file.
        max_bytes: A larger one is refused before it is read.
        where: How the error names it.

    Raises:
        InputError: If it is missing, no regular file, empty, too large, or not readable.
    """
    allowed = f"a readable file of 1 to {max_bytes} bytes"
    try:
        if not path.exists():
            raise InputError("no such file", where=where, allowed=allowed)
        if not path.is_file():
            raise InputError("not a file but a directory or device", where=where, allowed=allowed)
        size = path.stat().st_size
        if not 0 < size <= max_bytes:
            raise InputError(f"file of {size} bytes", where=where, allowed=allowed)
        return path.read_bytes()
    except (OSError, ValueError) as error:  # unreadable, or a path with a NUL in it
        raise InputError(f"cannot be read ({error})", where=where, allowed=allowed) from error
