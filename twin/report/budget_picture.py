"""What each source of the needle's error costs, and what a change of scan, markers or arm leaves of it, drawn."""

from __future__ import annotations

from collections.abc import Mapping
from io import BytesIO
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from puncture_twin.planning.base.files import atomic
from puncture_twin.twin.report.palette import PNG_LEVEL

WIDTH_INCHES, HEAD_INCHES, ROW_INCHES, DPI = 13.2, 1.6, 0.25, 110
LEAST_ROWS = 16
"""Of changes; more of them make the picture higher."""

ROOM_FOR_NUMBERS = 1.12
"""Beside the longest bar."""

ALONE, BETTER, WORSE = "#0072b2", "#009e73", "#d55e00"
"""Okabe and Ito's blue, green and vermilion; better and worse lie on two sides of a line besides."""

SHOWN_MM = 0.005


def draw_budget(facts: Mapping[str, Any], path: Path) -> None:
    """Write the picture.

    Args:
        facts: As ``register --json`` has them under ``budget``.
        path: The PNG to write; it appears whole or not at all.
    """
    with atomic(path) as temporary:
        temporary.write_bytes(budget_png(facts))


def budget_png(facts: Mapping[str, Any]) -> bytes:
    """The picture as a PNG.

    Args:
        facts: As of `draw_budget`.
    """
    inches = (WIDTH_INCHES, HEAD_INCHES + ROW_INCHES * max(LEAST_ROWS, len(facts["changes"])))
    figure = Figure(figsize=inches, dpi=DPI, facecolor="white", layout="constrained")
    sources, what_if = figure.subplots(1, 2)
    _sources(sources, facts)
    _changes(what_if, facts)
    best = facts["best"]
    figure.suptitle(
        f"expected tip error {facts['expected_mm']:.2f} mm (rms); least with {best['text']}: "
        f"{best['expected_mm']:.2f} mm",
        fontsize=11.5,
    )
    FigureCanvasAgg(figure)
    held = BytesIO()
    figure.savefig(held, format="png", pil_kwargs={"compress_level": PNG_LEVEL})
    return held.getvalue()


def _sources(axes: Axes, facts: Mapping[str, Any]) -> None:
    rows = [one for one in facts["sources"] if one["alone_mm"] >= SHOWN_MM]
    axes.barh([one["text"] for one in rows], [one["alone_mm"] for one in rows], color=ALONE)
    for at, one in enumerate(rows):
        axes.text(one["alone_mm"], at, f" {one['alone_mm']:.2f}", va="center", fontsize=9)
    axes.invert_yaxis()
    axes.set_xlim(right=ROOM_FOR_NUMBERS * max(one["alone_mm"] for one in rows))
    axes.set_xlabel("the tip's error (rms), were there no other source, mm")
    axes.set_title("each source alone: their squares add up", fontsize=10)
    _plain(axes)


def _changes(axes: Axes, facts: Mapping[str, Any]) -> None:
    now, rows = facts["expected_mm"], facts["changes"]
    left = [one["expected_mm"] for one in rows]
    axes.hlines(range(len(rows)), now, left, color=[BETTER if mm <= now else WORSE for mm in left], linewidth=2)
    axes.scatter(left, range(len(rows)), color=[BETTER if mm <= now else WORSE for mm in left], zorder=3)
    axes.axvline(now, color="black", linewidth=1)
    axes.text(now, -0.9, " as it is", fontsize=9, va="center")
    axes.set_yticks(range(len(rows)), [one["text"] for one in rows])
    axes.set_ylim(len(rows) - 0.4, -1.4)
    axes.set_xlabel("the tip's error (rms) with this one change, mm")
    axes.set_title("what if: one change, all else as it is", fontsize=10)
    _plain(axes)


def _plain(axes: Axes) -> None:
    axes.set_xlim(left=0)
    axes.grid(axis="x", alpha=0.3)
    axes.tick_params(labelsize=9)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
