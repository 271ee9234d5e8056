"""Lists that are read line by line: one that was cut within a number is another number, and looks whole."""

from __future__ import annotations


def unfinished_warnings(content: bytes, name: str) -> tuple[str, ...]:
    """What to say of a list whose last line does not end with a line break; spaces after it are no line.

    Args:
        content: The whole file.
        name: What the warning calls it.
    """
    if content.rstrip(b" \t").endswith((b"\n", b"\r")):
        return ()
    return (f"{name}: its last line does not end with a line break; was the file cut?",)
