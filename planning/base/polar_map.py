"""A map of directions as SVG: θ is the radius, β the angle, counter-clockwise from the right.

What is mapped are cells, rectangles in (θ, β), each with a verdict. They are painted on bins of at least `FINEST`; a
bin takes the verdict that comes last in the legend's order among the cells that touch it, so that a legend from the
best to the most cautious never shows more as safe than is safe.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.reasons import Rgb, css
from puncture_twin.planning.base.text import escape

FINEST = np.radians(0.5)
"""rad: a smaller bin is smaller than a pixel at the rim."""

MOST_BINS = 720
"""Around the circle, and from the pole to the rim."""

SLACK = 1e-6
"""Share of a bin by which rounding may move a cell's edge."""

SIZE = 320.0
"""Width and height of the drawing, in the SVG's own units."""

RADIUS = 126.0
"""Of the rim, in the same units."""

LETTERS = 10.0
"""Height of the labels."""


class Sectors(NamedTuple):
    """n cells and what they are."""

    theta: Floats
    """Shape (n, 2), lowest and highest, rad."""
    beta: Floats
    """Shape (n, 2), lowest and highest, rad; from 0 on, at most a turn wide."""
    code: Ints
    """Shape (n,): row of the legend."""


class Entry(NamedTuple):
    """One line of the legend."""

    text: str
    colour: Rgb


def polar_map(cells: Sectors, legend: Sequence[Entry], bin_rad: float = FINEST) -> str:
    """The map with its legend, as one ``svg`` element.

    Args:
        cells: What is mapped.
        legend: From the best to the most cautious.
        bin_rad: Wanted size of a bin; it is made no smaller than `FINEST`.
    """
    rim = float(cells.theta.max(initial=0.0))
    if rim <= 0.0:
        return ""
    bins = _painted(cells, rim, max(bin_rad, FINEST))
    used = [row for row in range(len(legend)) if (bins == row).any()]
    shapes = [_shape(css(legend[row].colour), _outline(bins == row)) for row in used]
    height = SIZE + (len(used) + 1) * 1.5 * LETTERS
    parts = [*shapes, *_rings(rim), *_rays(), *_legend([legend[row] for row in used])]
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {SIZE:g} {height:g}" width="{SIZE:g}" '
        f'height="{height:g}" role="img" font-family="system-ui,sans-serif" font-size="{LETTERS:g}">'
        f"<title>Verdict by direction</title>{''.join(parts)}</svg>"
    )


def _shape(colour: str, outline: str) -> str:
    """A filled path; its own thin rim closes the hairlines between sectors."""
    return f'<path fill="{colour}" stroke="{colour}" stroke-width="0.3" d="{outline}"/>'


def _painted(cells: Sectors, rim: float, size: float) -> Ints:
    """The row of the legend of every bin, shape (rings, bins around); -1 where no cell is."""
    rings = int(np.clip(round(rim / size), 1, MOST_BINS))
    around = int(np.clip(round(2 * np.pi / size), 8, MOST_BINS))
    bins = np.full((rings, around), -1, dtype=np.int64)
    t_first, t_last = _touched(cells.theta / rim * rings)
    b_first, b_last = _touched(cells.beta / (2 * np.pi) * around)
    for row in np.argsort(cells.code, kind="stable"):
        ring = slice(t_first[row], min(t_last[row], rings))
        turn = np.arange(b_first[row], min(b_last[row], b_first[row] + around)) % around
        bins[ring, turn] = cells.code[row]
    return bins


def _touched(edges: Floats) -> tuple[Ints, Ints]:
    """First bin, and the one after the last, that cells with these edges (n, 2) touch."""
    first = np.floor(edges[:, 0] + SLACK).astype(np.int64)
    return first, np.maximum(np.ceil(edges[:, 1] - SLACK).astype(np.int64), first + 1)


def _outline(chosen: np.ndarray) -> str:
    """The path around the chosen bins: one annular sector for each run of neighbours in a ring."""
    rings, around = chosen.shape
    parts, turn = [], 2 * np.pi / around
    for ring in range(rings):
        inner, outer = RADIUS * ring / rings, RADIUS * (ring + 1) / rings
        edges = np.diff(np.concatenate([[0], chosen[ring].astype(np.int8), [0]]))
        for first, last in zip(np.flatnonzero(edges == 1), np.flatnonzero(edges == -1), strict=True):
            cuts = [*range(first, last, around // 4), last]  # the centre of a longer arc would follow from rounding
            parts += [_sector(inner, outer, turn * a, turn * b) for a, b in itertools.pairwise(cuts)]
    return "".join(parts)


def _point(radius: float, angle: float) -> str:
    return f"{SIZE / 2 + radius * np.cos(angle):.1f} {SIZE / 2 - radius * np.sin(angle):.1f}"


def _sector(inner: float, outer: float, first: float, last: float) -> str:
    """An annular sector of less than half a turn; the picture's y axis points down: counter-clockwise is sweep 0."""
    start = f"M{_point(outer, first)}A{outer:.1f} {outer:.1f} 0 0 0 {_point(outer, last)}"
    if inner <= 0.0:
        return f"{start}L{_point(0.0, 0.0)}Z"
    return f"{start}L{_point(inner, last)}A{inner:.1f} {inner:.1f} 0 0 1 {_point(inner, first)}Z"


def _rings(rim: float) -> list[str]:
    """Circles of equal θ with their labels, and the rim."""
    degrees = np.degrees(rim)
    step = next((wide for wide in (5.0, 10.0, 15.0, 30.0, 45.0) if degrees / wide <= 5.0), 60.0)
    parts = []
    labelled = np.arange(step, degrees + 1e-6, step)
    for theta in (*labelled, degrees):
        radius = RADIUS * theta / degrees
        parts.append(
            f'<circle cx="{SIZE / 2:g}" cy="{SIZE / 2:g}" r="{radius:.1f}" fill="none" stroke="#1b1e23" '
            f'stroke-opacity="0.45" stroke-width="0.6"/>'
        )
    parts += [_text(f"{theta:g}°", RADIUS * theta / degrees, np.radians(52.0), "start") for theta in labelled]
    return parts


def _rays() -> list[str]:
    """Lines of equal β every 90 degrees, with their labels at the rim."""
    parts = []
    for degrees, anchor in ((0, "start"), (90, "middle"), (180, "end"), (270, "middle")):
        angle = np.radians(degrees)
        parts.append(
            f'<path d="M{_point(0.0, 0.0)}L{_point(RADIUS, angle)}" stroke="#1b1e23" stroke-opacity="0.45" '
            f'stroke-width="0.6"/>'
        )
        parts.append(_text(f"β {degrees}°" if degrees == 0 else f"{degrees}°", RADIUS + 4.0, angle, anchor))
    return parts


def _text(text: str, radius: float, angle: float, anchor: str) -> str:
    x, y = _point(radius, angle).split()
    return (
        f'<text x="{x}" y="{y}" dy="0.35em" text-anchor="{anchor}" fill="#1b1e23" stroke="#fff" stroke-width="2.5" '
        f'paint-order="stroke">{escape(text)}</text>'
    )


def _legend(entries: Sequence[Entry]) -> list[str]:
    parts = []
    for line, entry in enumerate(entries):
        y = SIZE + (line + 0.6) * 1.5 * LETTERS
        parts.append(
            f'<rect x="8" y="{y - LETTERS:g}" width="{LETTERS:g}" height="{LETTERS:g}" fill="{css(entry.colour)}" '
            f'stroke="#5a616b" stroke-width="0.6"/>'
        )
        parts.append(f'<text x="{8 + 1.6 * LETTERS:g}" y="{y - 1:g}" fill="#1b1e23">{escape(entry.text)}</text>')
    return parts
