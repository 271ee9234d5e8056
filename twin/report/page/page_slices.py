"""The page's slices: CT and overlay apart, so that a page can show the CT in every window."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from typing import Any

from PIL import Image

from puncture_twin.planning.base.reasons import css
from puncture_twin.twin.report.slices.panel import Panel
from puncture_twin.twin.report.slices.sheet import Slices
from puncture_twin.twin.report.slices.tones import TONES, stored, table

MOST_BYTES = 2_900_000
"""Of all slices on a page: the directions beyond it are left out, the last windows first."""

QUALITY, COLOURS = 72, 128
"""Of the CT as JPEG, and of the overlay's palette: both were looked at."""

OVERLAY_LEVEL = 6
"""How hard overlays are packed: at 9 they take seven times as long and are a fifteenth smaller."""

SHOWN_TONES = ("abdomen", "lung", "bone")


def slices_data(shown: Sequence[Slices]) -> dict[str, Any]:
    """What the page's script shows, of as many directions as `MOST_BYTES` takes; the first always."""
    directions: list[dict[str, Any]] = []
    size = 0
    for one in shown:
        data = _direction(one)
        size += sum(len(part) for panel in data["panels"] for part in (panel["ct"], panel["over"])) + len(data["units"])
        if directions and size > MOST_BYTES:
            break
        directions.append(data)
    return {"directions": directions, "tones": {name: table(TONES[name]) for name in SHOWN_TONES}}


def _direction(one: Slices) -> dict[str, Any]:
    pick = one.subject.pick
    return {
        **({} if pick is None else pick.candidates.at(pick.row)),
        "panels": [_panel(panel) for panel in one.panels],
        "units": "" if one.units is None else _png(one.units.quantize(COLOURS)),
        "legend": [[name.replace("_", " "), css(colour)] for name, colour in one.legend],
        "notes": list(one.notes),
    }


def _panel(panel: Panel) -> dict[str, str]:
    ct = ""
    if panel.hu is not None:
        stream = io.BytesIO()
        Image.fromarray(stored(panel.hu)).save(stream, format="JPEG", quality=QUALITY)
        ct = "data:image/jpeg;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
    return {"name": panel.plane.name, "ct": ct, "over": _png(Image.fromarray(panel.overlay).quantize(COLOURS))}


def _png(image: Image.Image) -> str:
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=OVERLAY_LEVEL)
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
