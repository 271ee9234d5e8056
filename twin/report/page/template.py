"""The pages' one shell: jinja2 templates that escape every text which is not marked as HTML.

``base.html`` holds the head, the cards, the inputs and the scripts; each page extends it. What a page is given by name
is text, escaped, or `Markup`, HTML already. A template that names what it is not given is an error.

The page's charts of a rehearsal over time, as plotly figures.
"""

from __future__ import annotations

import base64
import gzip
import io
import json
import math
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from puncture_twin.planning.base.files import atomic

PLOTLY = "plotly_js/plotly-gl3d.min.js"
"""Plotly 4.1.1's own bundle, as its makers publish it; beside it lie licence, source and hash."""


PACKED = 4
"""Of gzip's levels: at 6 it takes two and a half times as long for six parts in a hundred."""


class Card(NamedTuple):
    """One of the boxes below a page's title: plain texts, and whether it tells of a failure."""

    name: str
    value: str
    detail: str
    bad: bool = False


def write_html(template: str, path: Path, **parts: object) -> None:
    """Fill a template and write the page, whole or not at all.

    Args:
        template: Its file name.
        path: The HTML to write.
        parts: What the template names: plain text, or `Markup`.

    Raises:
        jinja2.UndefinedError: The template names a part that is not given.
    """
    text = _environment().get_template(template).render(parts)
    with atomic(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(_asset), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["asset"] = lambda name: Markup(_asset(name))  # our own style and script
    return environment


def _asset(name: str) -> str:
    """A file of ``twin/report/templates``."""
    return (files("puncture_twin.twin.report") / "templates" / name).read_text(encoding="utf-8")


@cache
def plotly_script() -> Markup:
    """Plotly's script, packed: its bundle with meshes and curves and no maps, a third of the whole."""
    return packed((files("puncture_twin.twin.report") / PLOTLY).read_text(encoding="utf-8"))


def script_json(data: Any) -> Markup:
    """JSON, packed."""
    return packed(json.dumps(data, allow_nan=False, separators=(",", ":")))


def packed(text: str) -> Markup:
    """Text as gzip in base64, the same bytes every time; no tag can begin in it. ``unpack.js`` reads it."""
    return Markup(base64.b64encode(gzip.compress(text.encode("utf-8"), PACKED, mtime=0)).decode("ascii"))


def data_address(picture: Path) -> str:
    """A PNG as an address that carries it."""
    return png_address(picture.read_bytes())


def png_address(picture: bytes) -> str:
    """Data address of a PNG in memory."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


def image_address(image: Image.Image, compress_level: int) -> str:
    """Data address of an image, encoded as PNG."""
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=compress_level)
    return png_address(stream.getvalue())


MOST_STRUCTURES = 6
"""Curves of clearance: so many of the nearest structures; the table has the rest."""

MOST_POINTS = 600

NAMED_PHASE = 0.07
"""Fraction of the time that a phase must last to carry its name; shorter ones would overlap."""


COLOURS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
"""Okabe and Ito's, one for each curve."""


def rehearsal_charts(rehearsal: Any, keep_away: frozenset[str]) -> dict[str, Any]:
    """Two figures as plain values: ``distance`` (tip to target) and ``clearance`` (needle to structures)."""
    every = max(1, len(rehearsal.times_s) // MOST_POINTS)
    times = rehearsal.times_s[::every]
    away = np.linalg.norm(rehearsal.tip_true_ct[::every] - rehearsal.target_true_ct, axis=1)
    distance = curve("tip to target", times, np.round(away, 3)) | {"line": {"color": "#00684a"}}
    names = [name for name in rehearsal.clearance_mm if name in keep_away]
    nearest = sorted(names, key=lambda n: float(np.min(rehearsal.clearance_mm[n], initial=np.inf)))
    curves = [
        curve(name.replace("_", " "), rehearsal.clearance_times_s, np.round(rehearsal.clearance_mm[name], 2))
        for name in nearest[:MOST_STRUCTURES]
    ]
    return {
        "distance": {
            "data": [distance],
            "layout": _layout("true tip to true target, mm") | _phase_marks(rehearsal),
        },
        "clearance": {
            "data": curves,
            "layout": _layout("true needle to true structure, mm") | {"shapes": [_contact_line()]},
        },
    }


def curve(name: str, x: Any, y: Any, mode: str = "lines") -> dict[str, Any]:
    """One trace of a flat chart, as plotly's script reads it; what is no finite number is a gap."""
    heights = [float(value) if math.isfinite(value) else None for value in y]
    return {"type": "scatter", "name": name, "mode": mode, "x": np.asarray(x).tolist(), "y": heights}


def _phase_marks(rehearsal: Any) -> dict[str, Any]:
    """A dotted line where each phase begins, and its name where there is room."""
    long = NAMED_PHASE * rehearsal.times_s[-1]
    shapes, names = [], []
    for phase, start, length in _phases(rehearsal):
        line = {"color": "#999999", "width": 1, "dash": "dot"}
        shapes.append({"type": "line", "x0": start, "x1": start, "y0": 0, "y1": 1, "yref": "paper", "line": line})
        at = {"x": start, "y": 1, "yref": "paper", "xanchor": "left", "yanchor": "top", "showarrow": False}
        names += [at | {"text": phase}] if length > long else []
    return {"shapes": shapes, "annotations": names}


def _contact_line() -> dict[str, Any]:
    """Across the chart at 0 mm."""
    ends = {"x0": 0, "x1": 1, "xref": "paper", "y0": 0, "y1": 0}
    return {"type": "line", **ends, "line": {"color": "#d6001e", "width": 1}}


def _phases(rehearsal: Any) -> list[tuple[str, float, float]]:
    """Name, start and length of each phase, s."""
    phase, times = rehearsal.phase, rehearsal.times_s
    starts = np.concatenate([[0], np.flatnonzero(phase[1:] != phase[:-1]) + 1])
    ends = np.append(starts[1:], len(times) - 1)
    return [(str(phase[i]), float(times[i]), float(times[j] - times[i])) for i, j in zip(starts, ends, strict=True)]


def _layout(title: str) -> dict[str, Any]:
    return {
        "height": 330,
        "margin": {"l": 55, "r": 15, "t": 46, "b": 45},
        "xaxis": {"title": {"text": "time, s"}},
        "yaxis": {"title": {"text": title}, "rangemode": "tozero"},
        "legend": {"orientation": "h", "y": 1.22},
        "hovermode": "x unified",
        "colorway": list(COLOURS),
        "plot_bgcolor": "#fbfbfc",
        "paper_bgcolor": "#ffffff",
    }
