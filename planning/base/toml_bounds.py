"""What no TOML file written by hand holds, looked for before a parser sees the text.

Such a text costs a parser more than its size: brackets nested 5,000 deep end in a recursion error, one dotted key of
20,000 parts took 41 s and 1.5 GB, and a number of 5,000 digits is an error of another kind than the parser's own.
"""

from __future__ import annotations

import re
from pathlib import Path

from puncture_twin.planning.base.errors import InputError

MAX_DEPTH = 20
"""Brackets inside brackets; a case has four."""

MAX_KEY_PARTS = 8
"""Parts of a dotted key or table name; a case has three."""

MAX_WORD = 100
"""Characters of a number, a bare key or any other word outside of strings."""

MAX_LINE = 20_000
"""Characters of a line: a rule for each of a thousand organs fits."""

MAX_TABLES = 20_000
"""Lines that begin with a bracket: each may be a table of eight levels."""

_TOKEN = re.compile(
    r'(?P<text>"""(?:[^\\]|\\.)*?(?:"""|\Z)|\'\'\'.*?(?:\'\'\'|\Z)|"(?:[^"\\\n]|\\.)*"?|\'[^\'\n]*\'?)'
    r"|(?P<comment>#[^\n]*)|(?P<open>[\[{])|(?P<close>[\]}])|(?P<dot>\.)|(?P<word>[^\s\"'#\[\]{}.=,]+)"
    r"|(?P<space>[ \t]+)|(?P<other>.)",
    re.DOTALL,
)


def check_toml_bounds(text: str, where: Path | str, allowed: str) -> None:
    """Refuse a text that is nested too deep, or has a key, a number or a line too long; it need not be TOML.

    Args:
        text: The whole file.
        where: The file, for the error.
        allowed: What would have been accepted in its place, for the error.

    Raises:
        InputError: Says which line goes beyond which bound.
    """
    tables = 0
    for number, line in enumerate(text.split("\n"), start=1):
        tables += line.lstrip().startswith("[")
        if len(line) > MAX_LINE:
            _refuse(f"has {len(line)} characters, more than {MAX_LINE}", where, number, allowed)
        if tables > MAX_TABLES:
            _refuse(f"begins more than {MAX_TABLES} tables", where, number, allowed)
    depth = parts = 0
    for token in _TOKEN.finditer(text):
        kind, found = str(token.lastgroup), token.group()
        depth += (kind == "open") - (kind == "close")
        parts = _parts(parts, kind)
        wrong = _beyond(kind, found, depth, parts)
        if wrong:
            _refuse(wrong, where, text.count("\n", 0, token.start()) + 1, allowed)


def _parts(parts: int, kind: str) -> int:
    """Parts of the key that the text is in after a token: dots join, spaces do not part, all else ends it."""
    if kind == "dot":
        return parts + 1
    return parts if kind in {"word", "text", "space"} else 0


def _beyond(kind: str, found: str, depth: int, parts: int) -> str:
    """Which bound a token breaks, in words; the empty string where none."""
    if depth > MAX_DEPTH:
        return f"is nested more than {MAX_DEPTH} deep"
    if parts > MAX_KEY_PARTS:
        return f"has a dotted key of more than {MAX_KEY_PARTS} parts"
    if kind == "word" and len(found) > MAX_WORD:
        return f"has a number or a key of {len(found)} characters, more than {MAX_WORD}"
    return ""


def _refuse(wrong: str, where: Path | str, line: int, allowed: str) -> None:
    raise InputError(f"line {line} {wrong}", where=where, allowed=allowed)
