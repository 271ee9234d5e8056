"""The schema of a ``*.collision.toml`` file, which states what is expected of directions, windows and plans.

`line_of` finds the line of a table or key in the text, which the TOML reader does not report.
"""

import re
from bisect import bisect_left
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

from pydantic import Field, StringConstraints, ValidationError

from puncture_twin.planning.base.errors import InputError, SchemaError, refuse
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.base.toml_file import parse_toml, read_toml_bytes
from puncture_twin.planning.case.tables import Degrees180, Degrees360, NotNegative, Number, Positive, Section, Text, Yes

ALLOWED = "[[check]], [[window]] or [[plan]] tables"
KEYS = "docs/how-to/collision-cases.md"
DEFAULT_TOLERANCE_MM, MOST_TOLERANCE_MM = 0.01, 10.0
"""A tenth of the 0.1 mm to which a robot repeats itself; a clearance that may be off by more is not checked at all."""
TestName = Annotated[str, StringConstraints(pattern=r"^[^\s:\[\]/\\]([^:\[\]/\\]*[^\s:\[\]/\\])?$", max_length=80)]
"""What pytest can select a test by: without the signs of its own names."""
Mark = Annotated[str, StringConstraints(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=80)]
Chance = Annotated[Number, Field(ge=0, le=1)]


class Expectation(Section):
    """Keys of every table: the case, and the test's name."""

    case: Text | None = None
    name: TestName | None = None
    why: str = ""
    marks: tuple[Mark, ...] = ()


class CheckSection(Expectation):
    """Expectation of one direction."""

    theta_deg: Degrees180
    beta_deg: Degrees360
    verdict: str = Field(pattern="^(safe|rejected)$")
    reason: Reason | None = None
    structure: str | None = None
    clearance_mm: dict[str, Number] = Field(default_factory=dict)
    tolerance_mm: Annotated[NotNegative, Field(le=MOST_TOLERANCE_MM)] = DEFAULT_TOLERANCE_MM
    min_clearance_mm: Number | None = None
    max_touch: Chance | None = None
    arm: Yes = False


class WindowSection(Expectation):
    """Expectation of the window that contains one direction."""

    theta_deg: Degrees180
    beta_deg: Degrees360
    min_square_deg: Positive
    arm: Yes = False


class PlanSection(Expectation):
    """Expectation of a plan that must still be valid."""

    file: Text


class ChecksFile(Section):
    """Schema of a whole file of expectations."""

    case: Text | None = None
    check: tuple[CheckSection, ...] = ()
    window: tuple[WindowSection, ...] = ()
    plan: tuple[PlanSection, ...] = ()

    def _problems(self) -> Iterator[SchemaError]:
        if not (self.check or self.window or self.plan):
            yield SchemaError(f"the file expects nothing; it has no {ALLOWED}", "missing_key")

    def tables(self) -> dict[str, tuple[Expectation, ...]]:
        """Kind of table to the tables, in the file's order."""
        return {"check": self.check, "window": self.window, "plan": self.plan}


class CheckedFile(NamedTuple):
    """A validated file of expectations, and its bytes."""

    content: ChecksFile
    data: bytes


def read_checks(path: Path) -> CheckedFile:
    """Read and validate a file of expectations; the line of what is refused is named."""
    data = read_toml_bytes(path, ALLOWED)
    try:
        content = parse_toml(data, path, ChecksFile, allowed=ALLOWED, keys=KEYS)
    except InputError as error:
        if not isinstance(error.__cause__, ValidationError):
            raise
        raise error.at(_where(data, path, error.__cause__.errors(include_url=False)[0]["loc"])) from error
    for kind, expectations in content.tables().items():
        for at, table in enumerate(expectations):
            if (table.case or content.case) is None:
                allowed = "case = FILE, in the file or in the table"
                refuse("no case", _where(data, path, (kind, at)), allowed, "missing_case")
    return CheckedFile(content, data)


def _where(data: bytes, path: Path, place: tuple[Any, ...]) -> str:
    line = line_of(data.decode("utf-8"), place)
    return str(path) if line is None else f"{path}:{line}"


TOKENS = re.compile(
    r'"""(?:\\.|[^\\])*?"""'
    r"|'''.*?'''"
    r'|"(?:\\.|[^"\\\n])*"'
    r"|'[^'\n]*'|\#[^\n]*"
    r"|^[ \t]*\[\[[ \t]*(?P<kind>[A-Za-z0-9_-]+)[ \t]*\]\]",
    re.MULTILINE | re.DOTALL,
)
"""Strings and comments, so that what is in them is passed over, and the heads of tables in arrays."""


def line_of(text: str, place: Sequence[str | int]) -> int | None:
    """The line of a place such as ("check", 2, "verdict"), from 1 on; that of its table where it has no own.

    The array's name, the number of the table from 0 on, and keys; or keys of the file.
    """
    heads = [match for match in TOKENS.finditer(text) if match["kind"]]
    if len(place) < 2:
        first = heads[0].start() if heads else len(text)
        key = _key(text, str(place[0]), 0, first) if place else None
        return None if key is None else _line(text, key)
    own = [at for at, match in enumerate(heads) if match["kind"] == place[0]]
    number = int(place[1])
    if number >= len(own):
        return None
    start = heads[own[number]].end()
    end = heads[own[number] + 1].start() if own[number] + 1 < len(heads) else len(text)
    key = _key(text, str(place[2]), start, end) if len(place) > 2 else None
    return _line(text, start if key is None else key)


def table_lines(text: str, kind: str) -> list[int]:
    """The lines of all ``[[kind]]``, counted from 1."""
    breaks = [match.start() for match in re.finditer("\n", text)]
    return [1 + bisect_left(breaks, match.end()) for match in TOKENS.finditer(text) if match["kind"] == kind]


def _key(text: str, key: str, start: int, end: int) -> int | None:
    match = re.compile(rf"^[ \t]*[\"']?({re.escape(key)})\b", re.MULTILINE).search(text, start, end)
    return None if match is None else match.start(1)


def _line(text: str, at: int) -> int:
    return 1 + text.count("\n", 0, at)
