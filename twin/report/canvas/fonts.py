"""DejaVu Sans as matplotlib ships it, so that no system font is needed; matplotlib itself is not loaded for it."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Literal

from PIL import ImageFont

Face = Literal["plain", "bold", "slanted"]

Anchor = Literal["lm", "rm", "mm", "la", "ra", "ma", "lb", "mb", "ls", "rs", "ms"]
"""Which point of a line of text stands at its place, as Pillow names it."""


@cache
def font(size: float, face: Face = "plain") -> ImageFont.FreeTypeFont:
    """A font of a height in pixels."""
    suffix = {"plain": "", "bold": "-Bold", "slanted": "-Oblique"}[face]
    return ImageFont.truetype(str(_folder() / f"DejaVuSans{suffix}.ttf"), size)


@cache
def _folder() -> Path:
    found = find_spec("matplotlib")
    assert found is not None and found.origin is not None, "matplotlib is not installed"
    return Path(found.origin).parent / "mpl-data" / "fonts" / "ttf"
