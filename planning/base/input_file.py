"""The bytes of an input file: it must be there, be a file, have a plausible size, and end a list with a whole line."""

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
            other = _other_case(path)
            raise InputError(
                f"no such file; there is '{other}'" if other else "no such file", where=where, allowed=allowed
            )
        if not path.is_file():
            raise InputError("not a file but a directory or device", where=where, allowed=allowed)
        size = path.stat().st_size
        if not 0 < size <= max_bytes:
            raise InputError(f"file of {size} bytes", where=where, allowed=allowed)
        return path.read_bytes()
    except (OSError, ValueError) as error:  # unreadable, or a path with a NUL in it
        raise InputError(f"cannot be read ({error})", where=where, allowed=allowed) from error


def absence(path: Path) -> str:
    """Why there is no plain file at a path, as it is: "is a folder", or "is not there", and what is there instead."""
    try:
        if path.is_dir():
            return "is a folder"
        if path.exists():
            return "is no plain file"
        if path.is_symlink():
            return "is a link to a file that is not there"
        other = _other_case(path)
    except PermissionError as error:
        return f"cannot be looked up ({error.strerror})"
    except (OSError, ValueError):  # a name that no file system takes
        return "is not there"
    return f"is not there; there is '{other}'" if other else "is not there"


def _other_case(path: Path) -> str:
    """A name beside it that differs in upper and lower case alone; "" without one."""
    if not path.parent.is_dir():
        return ""
    names = sorted(one.name for one in path.parent.iterdir() if one.name.lower() == path.name.lower())
    return names[0] if names and names[0].isprintable() else ""


def unfinished_warnings(content: bytes, name: str) -> tuple[str, ...]:
    """What to say of a list whose last line does not end with a line break; spaces after it are no line.

    Args:
        content: The whole file.
        name: What the warning calls it.
    """
    if content.rstrip(b" \t").endswith((b"\n", b"\r")):
        return ()
    return (f"{name}: its last line does not end with a line break; was the file cut?",)


def decode_text(data: bytes, where: str) -> str:
    """The text of a file in UTF-8.

    Raises:
        InputError: If it is anything else.
    """
    try:
        return data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise InputError(f"byte {error.start} is not text", where=where, allowed="text in UTF-8") from error
