"""How one number is distributed over the cases, as a small picture of lines and text that a page holds."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
from markupsafe import Markup

from puncture_twin.twin.report.page.page_tables import joined

BARS = 30
WIDTH, HEIGHT, LEFT, TOP, BOTTOM = 460, 220, 46, 34, 36
"""Of the picture and its edges, in its own units."""


def histogram(values: Sequence[float], text: str) -> Markup:
    """An SVG with the count of cases over a number.

    Args:
        values: At least one, finite.
        text: What it is, with its unit.
    """
    counts, edges = np.histogram(np.asarray(values, dtype=np.float64), BARS)
    head = f"{text}: {len(values)} case{'s' if len(values) != 1 else ''}, median {_plain(float(np.median(values)))}"
    bars = joined(
        '<rect x="{}" y="{}" width="{}" height="{}" fill="#00684a"><title>{}</title></rect>', _bars(counts, edges)
    )
    form = (
        '<svg viewBox="0 0 {} {}" role="img" aria-label="{}"><text x="{}" y="18" font-weight="600">{}</text>{}{}</svg>'
    )
    return Markup(form).format(WIDTH, HEIGHT, head, LEFT, head, _axes(int(counts.max()), edges), bars)


def _plain(value: float) -> str:
    """A number without an exponent, to three digits or more."""
    return f"{value:,.0f}" if abs(value) >= 1000.0 else f"{value:.3g}"


def _bars(counts: np.ndarray, edges: np.ndarray) -> Iterator[tuple[str, ...]]:
    step, high = (WIDTH - LEFT) / BARS, HEIGHT - TOP - BOTTOM
    for number, count in enumerate(counts):
        tall = high * count / counts.max()
        label = f"{_plain(edges[number])} to {_plain(edges[number + 1])}: {count}"
        left, top = LEFT + number * step + 0.5, HEIGHT - BOTTOM - tall
        yield f"{left:.1f}", f"{top:.1f}", f"{step - 1:.1f}", f"{tall:.1f}", label


def _axes(most: int, edges: np.ndarray) -> Markup:
    """The base line with three numbers, and the greatest count."""
    base = HEIGHT - BOTTOM
    line = Markup('<line x1="{}" y1="{}" x2="{}" y2="{}" stroke="#5b616b"/>').format(LEFT, base, WIDTH, base)
    middle = (edges[0] + edges[-1]) / 2
    marks = [
        (LEFT, base + 18, "start", _plain(edges[0])),
        ((LEFT + WIDTH) // 2, base + 18, "middle", _plain(middle)),
        (WIDTH, base + 18, "end", _plain(edges[-1])),
        (LEFT - 6, TOP + 10, "end", str(most)),
        (LEFT - 6, base, "end", "0"),
    ]
    cells = ((str(x), str(y), anchor, text) for x, y, anchor, text in marks)
    return line + joined('<text x="{}" y="{}" text-anchor="{}" fill="#5b616b">{}</text>', cells)
