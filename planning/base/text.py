"""Checked names for terminal, page and table, the known name that was likely meant, and values in a notebook.

How a value shows itself: one line for ``print`` and a prompt, a piece of HTML for a notebook; neither ever raises.
"""

import difflib
import functools
import html
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import TypeVar

from puncture_twin.planning.base.errors import one_line, refuse

MAX_NAME = 200
"""Characters of a name; the longest of TotalSegmentator has 29. A longer one is refused, never cut: two names that
differ at their end must not become one."""
ALLOWED_NAME = f"printable characters on one line, {MAX_NAME} at most: no escape sequence, line break or direction mark"


def check_name(name: str, what: str, *, where: str | Path) -> str:
    """Check a name that is printed as it is, and return it; ``what`` it names, as "label 3", is in the error.

    Raises InputError: empty, of more than `MAX_NAME` characters, or with a control or format character.
    """
    if not name.strip():
        refuse(f"{what} has an empty name", where, ALLOWED_NAME, "bad_name")
    if len(name) > MAX_NAME:
        refuse(f"{what} has a name of {len(name)} characters", where, ALLOWED_NAME, "bad_name")
    if not name.isprintable():
        refuse(f"{what} has the name {name!a}", where, ALLOWED_NAME, "bad_name")
    return name


def first_few(names: Sequence[str], most: int = 8) -> str:
    """The first few of a list, and how many more there are.

    >>> first_few(["liver", "colon", "aorta"], 2)
    'liver, colon and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(names[:most]) + more


def plural(count: int, noun: str, more: str = "s") -> str:
    """A count with its noun.

    >>> plural(1, "window"), plural(1200, "window"), plural(2, "mesh", "es")
    ('1 window', '1,200 windows', '2 meshes')
    """
    return f"{count:,} {noun}{more if count != 1 else ''}"


def unprintable_texts(document: object) -> Iterator[str]:
    """Every key and string of a nested document (tables, lists) that holds a control or format character."""
    waiting = [document]
    while waiting:
        one = waiting.pop()
        if isinstance(one, str) and not one.isprintable():
            yield one
        elif isinstance(one, dict):
            waiting += [*one.keys(), *one.values()]
        elif isinstance(one, list | tuple):
            waiting += one


Value = TypeVar("Value")


def brief(describe: Callable[[Value], str]) -> Callable[[Value], str]:
    """Make a ``__repr__`` of a method that says what a value holds; it never raises: a failing test prints values too.

    >>> class Grid:
    ...     @brief
    ...     def __repr__(self) -> str:
    ...         return "3 directions"
    >>> Grid()
    <Grid: 3 directions>
    """

    @functools.wraps(describe)
    def shown(value: Value) -> str:
        try:
            return f"<{type(value).__name__}: {one_line(describe(value))}>"
        except Exception:  # a value that is only half made still has a name
            return object.__repr__(value)

    return shown


LEAST_ALIKE = 0.6
"""Least likeness of two names, by difflib's ratio, without capitals."""


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """A question that names the nearest known name; empty where none is near.

    >>> did_you_mean("arota", ["liver", "aorta"]), did_you_mean("m1", ["M1", "M2"]), did_you_mean("x", ["liver"])
    ("; did you mean 'aorta'?", "; did you mean 'M1'?", '')
    """
    plain = {one.casefold(): one for one in known}
    near = difflib.get_close_matches(name.casefold(), plain, n=1, cutoff=LEAST_ALIKE)
    return f"; did you mean '{plain[near[0]]}'?" if near else ""


Facts = Iterable[tuple[str, str]]
"""Names and values, as plain text."""
STYLE = (
    "font:13px/1.45 system-ui,sans-serif;display:flex;flex-wrap:wrap;gap:16px;align-items:flex-start;padding:10px 12px;"
    "border:1px solid #d9dce1;border-radius:8px;max-width:880px;background:#fff;color:#1b1e23"
)
ROW = "background:none"
NAME = "text-align:left;padding:1px 14px 1px 0;font-weight:500;color:#5a616b;vertical-align:top;white-space:nowrap"
CELL = "text-align:left;padding:1px 0;overflow-wrap:anywhere"
"""Colours of text and ground are stated together, so that a dark notebook can read both."""


def escape(value: object) -> str:
    """Text made safe for HTML."""
    return html.escape(str(value), quote=True)


def card(title: str, facts: Facts, picture: str = "") -> str:
    """A title, a table of facts and, beside it, a picture: HTML, such as an image, or ""."""
    rows = "".join(
        f'<tr style="{ROW}"><th style="{NAME}">{escape(name)}</th><td style="{CELL}">{escape(value)}</td></tr>'
        for name, value in facts
    )
    table = f'<table style="border-collapse:collapse;margin:0;border:0"><tbody>{rows}</tbody></table>'
    head = f'<div style="font-weight:600;font-size:15px;margin-bottom:4px">{escape(title)}</div>'
    return f'<div style="{STYLE}"><div style="flex:1 1 320px">{head}{table}</div>{picture}</div>'


class Shown:
    """A value that shows itself in a notebook: by its fields, or by what a class says in place of them."""

    def _title(self) -> str:
        return type(self).__name__

    def _facts(self) -> Facts:
        for name, value in (self.summary() if hasattr(self, "summary") else vars(self)).items():
            if (text := _plain(value)) is not None:
                end, unit = next((one for one in UNITS if name.endswith(one[0])), ("", ""))
                yield name.removesuffix(end).replace("_", " "), f"{text} {unit}".strip()

    def _picture(self) -> str:
        return ""

    @brief
    def __repr__(self) -> str:
        return ", ".join(f"{name} {value}" for name, value in self._facts() if len(value) <= SHORT)

    def _repr_html_(self) -> str:
        """HTML for a notebook."""
        try:
            return card(self._title(), self._facts(), self._picture())
        except Exception as error:  # a notebook must not lose the value to its picture
            return f"<pre>{escape(object.__repr__(self))}\n{escape(type(error).__name__)}</pre>"


SHORT = 40
"""Most characters of a fact in the one line of ``repr``."""
UNITS = (("_mm", "mm"), ("_cm2", "cm²"), ("_deg", "°"), ("_s", "s"), ("_n", "N"))
"""Endings of names, and the units that they stand for."""


def _plain(value: object) -> str | None:
    """A value for a table of facts; None for what is no number, text or list of them."""
    if isinstance(value, bool | None):
        return {True: "yes", False: "no", None: "–"}[value]
    if isinstance(value, int | str):
        return str(value)
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        texts = [_plain(one) for one in value]
        return None if None in texts else first_few([str(one) for one in texts]) or "none"
    if (shape := getattr(value, "shape", None)) is not None:
        return f"an array of shape {shape}"
    return str(value) if isinstance(value, Path) else None
