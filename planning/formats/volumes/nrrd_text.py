"""The text of a NRRD header, taken apart: fields, remarks, and where the data lie.

A NRRD header may name any file of the machine as its data; here it may only name one beside it. Source: "Definition of
NRRD File Format" (Teem project).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.base.files import is_plain_file
from puncture_twin.planning.base.input_file import absence

MAX_HEADER_BYTES = 4_000_000
"""A .seg.nrrd with a thousand segments stays below 1 MB."""
KNOWN_FIELDS = frozenset(
    (
        "type",
        "dimension",
        "space",
        "spacedimension",
        "sizes",
        "spacedirections",
        "spaceorigin",
        "spaceunits",
        "kinds",
        "endian",
        "encoding",
        "datafile",
        "centers",
        "centerings",
        "content",
        "measurementframe",
        "byteskip",
        "lineskip",
        "thicknesses",
        "units",
        "labels",
        "min",
        "max",
        "oldmin",
        "oldmax",
        "number",
        "axismins",
        "axismaxs",
        "sampleunits",
    )
)


@dataclass(frozen=True)
class NrrdText:
    """The header as text, and where the data lie."""

    fields: dict[str, str]
    remarks: dict[str, str]
    data_path: Path
    data_offset: int


def split_header(content: bytes, path: Path) -> NrrdText:
    """The header at the beginning of a file.

    Raises:
        InputError: No header, one without an end, an unknown field, or data elsewhere than in the file or beside it.
    """
    head = content[:MAX_HEADER_BYTES]
    if re.match(rb"NRRD000[1-5]\r?\n", head) is None:
        raise InputError("no NRRD header (magic NRRD0001 to NRRD0005)", where=path, allowed="a .nrrd or .nhdr file")
    end = re.search(rb"\n\r?\n", head)
    if end is None and len(head) == MAX_HEADER_BYTES:
        raise InputError("the header has no end", where=path, allowed=f"at most {MAX_HEADER_BYTES} bytes")
    try:
        lines = head[: end.start() if end else None].decode("utf-8").split("\n")[1:]
    except UnicodeDecodeError as error:
        raise InputError(f"the header is not text ({error})", where=path, allowed="UTF-8") from error
    fields, remarks = _lines(lines, path)
    if "datafile" in fields:
        return NrrdText(fields, remarks, _beside(fields["datafile"], path), 0)
    if end is None:
        raise InputError("the file ends inside the header", where=path, allowed="a complete file")
    return NrrdText(fields, remarks, path, end.end())


def _lines(lines: list[str], path: Path) -> tuple[dict[str, str], dict[str, str]]:
    fields: dict[str, str] = {}
    remarks: dict[str, str] = {}
    for number, line in enumerate((text.rstrip("\r") for text in lines), start=2):
        where = f"{path}, line {number}"
        if line.startswith("#") or not line:
            continue
        field, mark, value = re.match(r"([^:]*)(:=|: |:|$)(.*)", line, re.DOTALL).groups()  # type: ignore[union-attr] # matches every line
        if mark == ":=":
            remarks[field.strip()] = value.strip()
            continue
        key = field.lower().replace(" ", "")
        if not mark or key not in KNOWN_FIELDS:
            raise InputError(f"unknown header line {line[:60]!r}", where=where, allowed=", ".join(sorted(KNOWN_FIELDS)))
        if key in fields:
            raise InputError(f"the field {field!r} stands twice", where=where, allowed="each field once")
        fields[key] = value.strip()
    return fields, remarks


def stated_field(fields: dict[str, str], key: str, path: Path) -> str:
    """A field that a header must have.

    Raises:
        InputError: It has not.
    """
    if not fields.get(key):
        raise InputError(f"the header has no field {key!r}", where=path, allowed="a complete NRRD header")
    return fields[key]


def whole_number(text: str, path: Path) -> int:
    """A count.

    Raises:
        InputError: Anything but digits.
    """
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise InputError(f"size {text[:30]!r}", where=path, allowed="positive whole numbers")
    return int(text)


def _beside(name: str, path: Path) -> Path:
    """The data file of a detached header: a plain name in the same folder, or nothing."""
    allowed = "the name of one file in the same folder"
    if not name or re.search(r"[/\\%\s\0]", name) or name in (".", "..") or name.upper().startswith("LIST"):
        raise InputError(f"data file {name[:80]!r}", where=path, allowed=allowed)
    data_path = path.parent / name
    if not is_plain_file(data_path):
        raise InputError(f"data file {name!r} {absence(data_path)}", where=path, allowed=allowed)
    if data_path.resolve().parent != path.parent.resolve():
        raise InputError(f"data file {name!r} is a link to another folder", where=path, allowed=allowed)
    if data_path.resolve() == path.resolve():
        raise InputError("the data file is the header itself", where=path, allowed=allowed)
    return data_path
