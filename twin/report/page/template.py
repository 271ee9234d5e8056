"""The pages' one shell: jinja2 templates that escape every text which is not marked as HTML.

``base.html`` holds the head, the cards, the inputs and the scripts; each page extends it. What a page is given by name
is text, escaped, or `Markup`, HTML already. A template that names what it is not given is an error.
"""

import base64
import gzip
import io
import json
from functools import cache
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, FunctionLoader, StrictUndefined
from markupsafe import Markup
from PIL import Image

from puncture_twin.planning.base.files import atomic

PLOTLY = "plotly_js/plotly-gl3d.min.js"
"""Plotly 4.1.1's own bundle, as its makers publish it; beside it lie licence, source and hash."""


PACKED = 4  # of gzip's levels: at 6 it takes two and a half times as long for six parts in a hundred


def write_html(template: str, path: Path, **parts: object) -> None:
    """Fill a template and write the page, whole or not at all; a part that it names and is not given is an error."""
    text = filled(template, **parts)
    with atomic(Path(path)) as temporary:
        temporary.write_text(text, encoding="utf-8")


def filled(template: str, **parts: object) -> str:
    """A template's text, with what it names."""
    return _environment().get_template(template).render(parts)


@cache
def _environment() -> Environment:
    environment = Environment(
        loader=FunctionLoader(_asset), autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    environment.globals["asset"] = lambda name: Markup(_asset(name))  # our own style and script
    return environment


def _asset(name: str) -> str:
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
    return base64_text(gzip.compress(text.encode("utf-8"), PACKED, mtime=0))


def base64_text(content: bytes) -> Markup:
    """Bytes as a script reads them."""
    return Markup(base64.b64encode(content).decode("ascii"))


def png_address(picture: bytes) -> str:
    """Data address of a PNG in memory."""
    return "data:image/png;base64," + base64.b64encode(picture).decode("ascii")


def image_address(image: Image.Image, compress_level: int) -> str:
    """Data address of an image, encoded as PNG."""
    stream = io.BytesIO()
    image.save(stream, format="PNG", compress_level=compress_level)
    return png_address(stream.getvalue())
