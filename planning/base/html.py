"""How a value shows itself in a notebook: a small piece of HTML that needs nothing from outside, and never raises."""

from __future__ import annotations

import functools
import html
from collections.abc import Callable, Iterable
from typing import TypeVar

Facts = Iterable[tuple[str, str]]
"""Names and values, as plain text."""

Value = TypeVar("Value")

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
    """A title, a table of facts and, beside it, a picture.

    Args:
        title: Plain text.
        facts: Names and values, plain text.
        picture: HTML, such as an SVG; "" for none.
    """
    rows = "".join(
        f'<tr style="{ROW}"><th style="{NAME}">{escape(name)}</th><td style="{CELL}">{escape(value)}</td></tr>'
        for name, value in facts
    )
    table = f'<table style="border-collapse:collapse;margin:0;border:0"><tbody>{rows}</tbody></table>'
    head = f'<div style="font-weight:600;font-size:15px;margin-bottom:4px">{escape(title)}</div>'
    return f'<div style="{STYLE}"><div style="flex:1 1 320px">{head}{table}</div>{picture}</div>'


def never_raises(make: Callable[[Value], str]) -> Callable[[Value], str]:
    """What a notebook calls: where a value cannot be shown, its class and the error are."""

    @functools.wraps(make)
    def shown(value: Value) -> str:
        try:
            return make(value)
        except Exception as error:  # a notebook must not lose the value to its picture
            return f"<pre>{escape(object.__repr__(value))}\n{escape(type(error).__name__)}</pre>"

    return shown
