"""The one presenter: results as blocks, stated once, for a terminal and for a page.

A job lists its facts as fields: a name, where the value is found, digits and unit. Fields make a table of many rows, or
the names and values of one; tables and sentences make sections; `text` and `html` show the same sections.

>>> facts = [{"seed": 1, "error_mm": -0.25}, {"seed": 2, "error_mm": None}]
>>> print(text([Section("errors", [grid((Field("seed", "seed"), Field("error", "error_mm", 2, "mm")), facts)])]))
errors
  seed  error, mm
  1         -0.25
  2             -
"""

import math
import platform
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from importlib.metadata import PackageNotFoundError, requires, version
from pathlib import Path
from textwrap import wrap
from typing import Any, NamedTuple

from markupsafe import Markup

from puncture_twin.planning.base.provenance import Input

PROJECT = "puncture-twin"
NOTHING = "–"  # where there is no number

PLAIN = str.maketrans({"−": "-", "–": "-", "θ": "theta", "β": "beta", "°": " deg", "²": "2", "₂": "2", "₁": "1",
                       "χ": "chi", "σ": "sigma", "’": "'", "≥": ">=", "“": "'", "”": "'", "×": "x"})  # fmt: skip
"""Text of a terminal in place of a page's letters, in tables and sentences; titles and paths stay as they are."""
FOLDED = 10  # letters: a shorter head is not folded
TIMES = Markup('<p class="faint">Date and duration of each stage: <a href="timings.json">timings.json</a>.</p>')


def number(value: float | None, digits: int = 1, unit: str = "") -> str:
    """A number for people; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return NOTHING
    text = f"{value:.{digits}f}".replace("-", "−")
    return f"{text} {unit}" if unit else text


def percent(fraction: float) -> str:
    """A fraction 0..1 in percent; what is there never reads as zero, nor what lacks something as all."""
    if 0 < fraction < 0.0005:
        return "<0.1 %"
    return ">99.9 %" if 0.9995 <= fraction < 1 else f"{100 * fraction:.1f} %"


def vector(values: Iterable[float | None], digits: int, unit: str = "") -> str:
    """A point or axis in brackets; "" of no values."""
    inside = ", ".join(number(value, digits) for value in values)
    return f"({inside}) {unit}".rstrip() if inside else ""


class Field(NamedTuple):
    """One fact of a row."""

    name: str
    value: str | Callable[[Any], Any]
    """A key, with dots for keys within (of which each may be missing or None), or what finds it in a row."""
    digits: int | None = None  # of a number; None shows the value as it is
    unit: str = ""

    def of(self, row: Any, *, unit: bool = False) -> str:
        """The value as it is shown, `Markup` as it is; with its unit, where that stands in no head."""
        value = self._cell(row)
        if value is None:
            return NOTHING
        if isinstance(value, str) or self.digits is None:
            return value if isinstance(value, str) else f"{value:,}" if isinstance(value, int) else f"{value:g}"
        return number(float(value), self.digits, self.unit if unit else "")

    def _cell(self, row: Any) -> Any:
        if not isinstance(self.value, str):
            return self.value(row)
        first, *within = self.value.split(".")
        value = row[first]
        for key in within:
            value = None if value is None else value.get(key)
        return value

    def known(self, row: Any) -> bool:
        """Whether a row has a value of this field."""
        try:
            return self._cell(row) not in (None, "", ())
        except KeyError:
            return False


class Table(NamedTuple):
    """Cells below a head; without a head, names and values."""

    head: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    kind: str = "numbers"


class Warn(NamedTuple):
    """Lines that a reader must not miss, letter by letter; folded where they are worth less."""

    lines: tuple[str, ...]
    folded: str = ""


Block = Table | Warn | str | tuple[Any, ...]
"""A table, warnings, a sentence, or `Markup` (a picture, a chart), which a page alone shows; a plain tuple of blocks
stands side by side."""


class Section(NamedTuple):
    """Blocks below a title."""

    title: str
    blocks: Sequence[Block]


class Card(NamedTuple):
    """One of the boxes below a page's title: plain texts, and whether it tells of a failure."""

    name: str
    value: str
    detail: str
    bad: bool = False


def grid(fields: Iterable[Field], rows: Iterable[Any], kind: str = "numbers") -> Table:
    """A row for each of many; units stand in the head."""
    fields = tuple(fields)
    head = tuple(f"{one.name}, {one.unit}" if one.unit else one.name for one in fields)
    return Table(head, tuple(tuple(one.of(row) for one in fields) for row in rows), kind)


def facts(fields: Iterable[Field | tuple[str, ...]], row: Any = None) -> Table:
    """The names and values of one, without those that it has not; pairs of texts stand as they are."""
    known = (one for one in fields if not isinstance(one, Field) or one.known(row))
    shown = ((one.name, one.of(row, unit=True)) if isinstance(one, Field) else one for one in known)
    return Table((), tuple(shown), "pairs")


def text(sections: Iterable[Section]) -> str:
    """Text of sections for a terminal."""
    return "\n".join(line for section in sections for line in _lines(section))


def _lines(section: Section) -> Iterator[str]:
    body = [f"  {line}".rstrip() for block in section.blocks for line in _block_lines(block)]
    if body or not section.blocks:
        yield from [section.title] * bool(section.title)
        yield from body


def _block_lines(block: Block) -> Iterator[str]:
    if isinstance(block, Table):
        yield from _table_lines(block)
    elif isinstance(block, Warn):
        yield from block.lines
    elif isinstance(block, tuple):
        for one in block:
            yield from _block_lines(one)
    elif not isinstance(block, Markup):
        yield _plain(block)


def _table_lines(table: Table) -> Iterator[str]:
    """Columns as wide as their widest cell, heads folded to it; all but the first end below each other if numbers."""
    body = [tuple(map(_plain, row)) for row in table.rows]
    if not body:
        return
    heads = [_plain(one) for one in table.head] or [""] * len(body[0])
    cells = [max(len(row[at]) for row in body) for at in range(len(heads))]
    widths = [max(w, *map(len, head.split()), min(len(head), FOLDED)) for w, head in zip(cells, heads, strict=True)]
    folded = [wrap(head, max(width, 1)) for head, width in zip(heads, widths, strict=True)]
    height = max(map(len, folded))
    top = zip(*([*[""] * (height - len(one)), *one] for one in folded), strict=True)
    numeric = [
        all(not row[at] or row[at][0] in "-+<>" or row[at][0].isdigit() for row in body) for at in range(len(heads))
    ]
    to_right = [at > 0 and any(heads) and each for at, each in enumerate(numeric)]
    for row in (*top, *body):
        each = zip(row, widths, to_right, strict=True)
        yield "  ".join(cell.rjust(width) if right else cell.ljust(width) for cell, width, right in each)


def _plain(cell: str) -> str:
    return (cell.striptags() if isinstance(cell, Markup) else cell).translate(PLAIN).replace("  deg", " deg")


def html(sections: Iterable[Section]) -> Markup:
    """HTML of sections for a page; text is escaped, `Markup` is not."""
    from puncture_twin.twin.report.page.template import filled

    kinds = ((Table, "table"), (Warn, "warn"), (tuple, "beside"), (Markup, "markup"), (str, "sentence"))

    def kind_of(block: Block) -> str:
        return next(kind for shape, kind in kinds if isinstance(block, shape))

    return Markup(filled("blocks.html", sections=sections, kind_of=kind_of))


def blocks_html(blocks: Sequence[Block]) -> Markup:
    """Blocks below one another, without a title."""
    return html([Section("", blocks)])


def bold(text: str) -> Markup:
    """Text that a page shows in bold."""
    return Markup("<b>{}</b>").format(text)


def picture(png: Path | bytes, alt: str) -> Markup:
    """A PNG that the page holds; a terminal names the file instead."""
    from puncture_twin.twin.report.page.template import png_address

    data = png if isinstance(png, bytes) else png.read_bytes()
    return Markup('<figure><img class="wide" alt="{}" src="{}"></figure>').format(alt, png_address(data))


def write_page(path: Path, title: str, under: str, cards: Sequence[Card], sections: Iterable[Section],
               inputs: Iterable[Input], **parts: object) -> Path:  # fmt: skip
    """Write a job's page, whole or not at all; `parts` are ``origin``, and ``data``, ``plotly`` and ``script``."""
    from puncture_twin.twin.report.page.template import write_html

    shown = {"under": under, "cards": cards, "sections": html(sections), "inputs": inputs_table(inputs)}
    write_html("job.html", path, title=title, **shown, **parts)
    return path


def inputs_table(inputs: Iterable[Input]) -> Markup:
    """Every input with its role and hash."""
    rows = ((one.role, one.path, Markup("<code>{}</code>").format(one.sha256)) for one in inputs)
    table = blocks_html([Table(("role", "file", "SHA-256"), tuple(rows), "")])
    return Markup("<details><summary>Files, each with its SHA-256</summary>{}</details>").format(table)


def origin_section(seed: int | None) -> Markup:
    """Versions and seed, and where the times are: they differ from run to run, and the page does not."""
    versions = [] if seed is None else [("Python", platform.python_version())]
    for name in () if seed is None else parts():
        try:
            versions.append((name, version(name)))
        except PackageNotFoundError:
            versions.append((name, "not installed as a package"))
    seeded = "none: no random numbers" if seed is None else str(seed)
    return blocks_html([facts([("seed", seeded), *versions]), TIMES])


def parts() -> list[str]:
    """The packages that stand behind a result: this one and what its metadata requires, extras apart."""
    try:
        stated = requires(PROJECT) or []
    except PackageNotFoundError:  # run from a checkout that nobody installed
        stated = []
    return [PROJECT, *sorted(re.split(r"[^\w.-]", line, maxsplit=1)[0] for line in stated if "extra ==" not in line)]


def footer(
    files: Iterable[str | Path], warnings: Iterable[str] = (), seconds: Mapping[str, float] | None = None
) -> list[Section]:
    """End of every command's text: warnings, how long each stage took, and the files."""
    said = [Section(f"warning: {one}", []) for one in warnings]
    if seconds is not None:
        said.append(Section("seconds: " + ", ".join(f"{stage} {spent:.1f}" for stage, spent in seconds.items()), []))
    shown = Warn(tuple(map(str, files)))
    return [*said, Section("look at:", [shown])] if shown.lines else said
