"""The column beside the map: what its colours and marks mean, and the chosen direction in numbers."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.reasons import NOT_SEARCHED_TEXT, UNSEEN_AIR, Reason, Rgb
from puncture_twin.planning.search.candidates import Candidates
from puncture_twin.planning.search.choice import Pick, best_pick
from puncture_twin.planning.search.uncertainty_breakdown import chance_text
from puncture_twin.twin.report.canvas import Anchor, Canvas, Face, Words, rounded
from puncture_twin.twin.report.map.chance_layer import chance_legend, mark_dot, mark_ring, mark_star
from puncture_twin.twin.report.map.map_raster import (
    HATCH,
    HATCH_AIR,
    POINT,
    SCALE_DIGITS,
    SIDE_HEIGHT,
    SIDE_WIDTH,
    ClearanceScale,
    clearance_scale,
    shown_front,
    side_pixels,
)
from puncture_twin.twin.report.map_view import BEYOND, MapView, step_of
from puncture_twin.twin.report.numbers import ReasonCount, arm_text, nearest_text, number, percent, reason_counts
from puncture_twin.twin.report.palette import safe_shades

MOST_LEGEND, LINE, GAP = 0.45, 0.0215, 0.6
"""Heights: of the legend's entries together, of the column's; of a line; between two entries, of a line."""

GREY: Rgb = (64, 64, 64)
SMALL, HEAD = Words(9.5 * POINT), Words(9 * POINT, colour=(89, 89, 89))
HOW_TO_READ = Words(9.5 * POINT, colour=GREY, spacing=1.35)
NUMBERS = Words(10 * POINT, spacing=1.4)
NOTHING = Words(13 * POINT, "bold", (160, 32, 0))

PATCH = 0.06
"""Width of a patch of colour, of the column's."""

TEXT_AT, COUNT_ENDS, ENTRY, MOST_LETTERS = 0.085, 0.62, 10.5 * POINT, 19
"""Of the legend's entries: where text begins and the number ends; its height at most, and its letters in a line."""

PADDING = 9.0
"""Pixels about the words in a box."""


def draw_side(canvas: Canvas, candidates: Candidates, view: MapView, pick: Pick | None) -> None:
    """Draw the column: what the colours and marks mean, the chosen direction, and how to read the map."""
    y = _legend(canvas, reason_counts(candidates))
    y = _scale(canvas, candidates, y + 0.01)
    y = chance_legend(canvas, candidates, y)
    y = _mark_legend(canvas, candidates, view, y + 0.05)
    _chosen(canvas, candidates, pick, y + 0.04)
    whole = candidates.grid is None or (candidates.grid.full_circle and candidates.theta.min() < step_of(candidates))
    outside = "" if whole else f"White with lines: {NOT_SEARCHED_TEXT}.\n"
    toward = f"Centre (+), θ = 0: {view.centre}.\n" if view.centre else ""
    if view.theta_max > BEYOND:
        toward += "Beyond the thick ring (θ 90°) it comes from the far side.\n"
    text = (
        "HOW TO READ\nThe target is behind the centre; you look at the body\n"
        "from OUTSIDE, along −z of the entry frame. A point is\n"
        "where the needle comes from: θ grows from the centre\n"
        "to the rim, β runs counter-clockwise.\n"
        f"{outside}{toward}{_folded(arm_text(candidates), 52)}"
    )
    left, bottom = side_pixels(0.0, 0.995)
    high = HOW_TO_READ.size * HOW_TO_READ.spacing * text.count("\n")
    canvas.write((left, bottom - high), text, HOW_TO_READ)


def _legend(canvas: Canvas, counts: Sequence[ReasonCount]) -> float:
    """A patch, a text and numbers for each reason; an entry of more lines is higher."""
    for x, text in ((COUNT_ENDS, "directions"), (0.79, "of grid")):
        canvas.write(side_pixels(x, 0.012), text, HEAD, anchor="rs")
    for line, text in enumerate(("of solid", "angle")):
        canvas.write(side_pixels(1.0, 0.012 - 0.018 * (1 - line)), text, HEAD, anchor="rs")
    texts = [_beside_count(one) for one in counts]
    heights = np.array([text.count("\n") + 1 + GAP for text in texts])
    unit = min(LINE, MOST_LEGEND / float(heights.sum()))
    ends = 0.022 + unit * np.cumsum(heights)
    for one, text, y in zip(counts, texts, (ends - unit * heights / 2).tolist(), strict=True):
        face: Face = "bold" if one.code == "safe" else "plain"
        look = Words(min(ENTRY, unit * SIDE_HEIGHT / 1.08), face, spacing=1.08)
        _patch(canvas, _box(0.0, y - 0.016, PATCH, 0.032 * min(1.0, unit / 0.015)), one)
        canvas.write(side_pixels(TEXT_AT, y), text, look, anchor="lm")
        for x, value in (
            (COUNT_ENDS, f"{one.count:,}"),
            (0.79, percent(one.fraction)),
            (1.0, percent(one.solid_angle)),
        ):
            canvas.write(side_pixels(x, y), value, look, anchor="rm")
    return float(ends[-1])


def _patch(canvas: Canvas, box: tuple[float, float, float, float], one: ReasonCount) -> None:
    """A reason's colour, with the lines that the map has over it."""
    left, top, right, bottom = box
    canvas.rectangle(box, one.colour, 0.8 * POINT)
    if one.code == Reason.UNKNOWN_REGION.value:
        (start, end), colour = ((top, bottom), HATCH_AIR) if one.colour == UNSEEN_AIR else ((bottom, top), HATCH)
        x, y = (left + right) / 2, (top + bottom) / 2
        lines = [((left, start), (right, end)), ((left, y), (x, end)), ((x, start), (right, y))]
        canvas.segments(np.array(lines), POINT, colour)


def _beside_count(one: ReasonCount) -> str:
    """What a reason means, in lines that end before its number."""
    look = Words(ENTRY, "bold" if one.code == "safe" else "plain")
    room = (COUNT_ENDS - TEXT_AT) * SIDE_WIDTH - look.width(f"{one.count:,}") - PADDING
    folded = (_folded(one.text, width) for width in range(MOST_LETTERS, 0, -1))
    return next((text for text in folded if look.width(text) <= room), one.text)


def _box(x: float, y: float, wide: float, high: float) -> tuple[float, float, float, float]:
    """Left, top, right and bottom in pixels."""
    return (*side_pixels(x, y), *side_pixels(x + wide, y + high))


def _folded(text: str, width: int) -> str:
    lines = [""]
    for word in text.split():
        if len(lines[-1]) + len(word) + 1 > width and lines[-1]:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)


def _scale(canvas: Canvas, candidates: Candidates, y: float) -> float:
    """The shades of safe; one shade where one number says it all."""
    if not candidates.safe.any():
        return y
    scale = clearance_scale(candidates)
    safe = "" if candidates.breathing is not None else f"{candidates.safe_text}, "  # too long for one line
    if scale.even:
        canvas.rectangle(_box(0.0, y + 0.02, PATCH, 0.032), _even_shade(scale), 0.8 * POINT)
        canvas.write(side_pixels(0.085, y + 0.036), f"{safe}{_even_text(scale)}", SMALL, anchor="lm")
        return y + 0.06
    left, top, right, bottom = (round(edge) for edge in _box(0.0, y + 0.02, 1.0, 0.025))
    shades = safe_shades(np.linspace(0, 1, right - left))
    canvas.pixels[top:bottom, left:right, :3] = shades
    canvas.rectangle((left, top, right, bottom), None, 0.8 * POINT)
    ends: tuple[tuple[float, str, Anchor], ...] = (
        (0.0, number(scale.low, SCALE_DIGITS, "mm"), "la"),
        (0.5, f"{safe}by least clearance", "ma"),
        (1.0, number(scale.high, SCALE_DIGITS, "mm"), "ra"),
    )
    for x, text, anchor in ends:
        canvas.write(side_pixels(x, y + 0.05), text, SMALL, anchor=anchor)
    return y + 0.06


def _even_shade(scale: ClearanceScale) -> Rgb:
    red, green, blue = scale.shades(np.zeros(1))[0].tolist()
    return red, green, blue


def _even_text(scale: ClearanceScale) -> str:
    """What one shade stands for."""
    if not np.isfinite(scale.low):
        return "no structure has a margin"
    return f"least clearance {number(scale.low, SCALE_DIGITS, 'mm')} everywhere"


def _mark_legend(canvas: Canvas, candidates: Candidates, view: MapView, y: float) -> float:
    if not candidates.safe.any():
        return y
    mark_star(canvas, _place(0.03, y), 7.7 * POINT)
    canvas.write(side_pixels(0.07, y), "chosen", SMALL, anchor="lm")
    mark_ring(canvas, _place(0.225, y))
    canvas.write(side_pixels(0.25, y), "best of a window", SMALL, anchor="lm")
    front = shown_front(candidates, view)
    if front.of:
        mark_dot(canvas, _place(0.575, y))
        canvas.write(side_pixels(0.595, y), front.text, SMALL, anchor="lm")
    return y


def _place(x: float, y: float) -> Floats:
    return np.array(side_pixels(x, y))


def _chosen(canvas: Canvas, candidates: Candidates, pick: Pick | None, y: float) -> None:
    """The chosen direction in a box; or, in a box of warning, that there is none."""
    if pick is None:
        text = "NOTHING IS SAFE\nEvery direction of the grid is refused."
        _boxed(canvas, text, y, NOTHING, ((255, 233, 224), (176, 48, 0)))
        return
    word = "Best" if pick == best_pick(candidates) else "Chosen"
    candidates, row = pick
    theta, beta = np.degrees(candidates.theta[row]), np.degrees(candidates.beta[row])
    lines = (
        f"{word}: θ {theta:.4g}°, β {beta:.4g}°{_chances(candidates, row)}",
        f"path in the body {number(candidates.path.length[row], 1, 'mm')}, "
        f"skin angle {number(float(np.degrees(candidates.path.skin_angle[row])), 0)}°",
        nearest_text(candidates, row),
    )
    _boxed(canvas, "\n".join(lines), y, NUMBERS, ((238, 247, 242), (0, 104, 74)))


def _boxed(canvas: Canvas, text: str, y: float, look: Words, colours: tuple[Rgb, Rgb]) -> None:
    """Words in a box of two colours, ground and edge, whose upper edge is at a height."""
    left, top = side_pixels(0.0, y)
    high = look.size * (1 + look.spacing * text.count("\n"))
    edge = rounded((left, top, left + look.width(text) + 2 * PADDING, top + high + 2 * PADDING), PADDING)
    canvas.fill(edge, colours[0])
    canvas.line(edge, POINT, colours[1])
    canvas.write((left + PADDING, top + PADDING + 0.85 * look.size), text, look)


def _chances(candidates: Candidates, row: int) -> str:
    """The chosen direction's chances, to follow it; nothing where there are none."""
    chances = candidates.chances
    if chances is None or not np.isfinite(chances.hit[row]):
        return ""
    hit, touch = chance_text(float(chances.hit[row])), chance_text(float(chances.touch_any[row]))
    return f"; p(hit) {hit}, p(touch) {touch}{'' if chances.refined[row] else ' to first order'}"
