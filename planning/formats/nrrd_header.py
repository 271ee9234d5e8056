"""NRRD headers, read by ourselves before any library opens the file.

Layout and meaning of the fields: "Definition of NRRD File Format" (Teem project). A NRRD header may name any
file of the machine as its data; here it may only name one beside it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from planning.errors import InputError
from planning.formats.volume_header import (
    CHUNK_BYTES,
    VolumeHeader,
    check_affine,
    check_exact_size,
    check_inflated_size,
    check_shape,
)

MAX_HEADER_BYTES = 4_000_000
"""A .seg.nrrd with a thousand segments stays below 1 MB."""
KNOWN_FIELDS = frozenset(
    (
        "type",
        "dimension",
        "space",
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
LPS_SIGNS = {
    "left-posterior-superior": (1.0, 1.0, 1.0),
    "lps": (1.0, 1.0, 1.0),
    "right-anterior-superior": (-1.0, -1.0, 1.0),
    "ras": (-1.0, -1.0, 1.0),
    "left-anterior-superior": (1.0, -1.0, 1.0),
    "las": (1.0, -1.0, 1.0),
}
BYTES_OF_TYPE = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), 1),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), 1),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), 2),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), 2),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), 4),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), 4),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"), 8),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), 8),
    "float": 4,
    "double": 8,
}
GZIP = frozenset(("gzip", "gz"))
ASCII = frozenset(("ascii", "text", "txt"))
INTEGER_TEXT = re.compile(rb"[0-9+\-\s]*")
FLOAT_TEXT = re.compile(rb"[0-9+\-.eE\s]*")
VECTOR = re.compile(r"\(([^()]*)\)")


@dataclass(frozen=True)
class _Raw:
    """The header as text, and where the data lie."""

    fields: dict[str, str]
    remarks: dict[str, str]
    data_path: Path
    data_offset: int


def read_nrrd_header(path: Path) -> VolumeHeader:
    """What the header says, held against the real size of its data.

    Raises:
        InputError: A damaged header, an unknown field, a space that is not patient space, data elsewhere than
            in the file or beside it, or data shorter or longer than promised.
    """
    with path.open("rb") as stream:
        raw = _split(stream.read(MAX_HEADER_BYTES), path)
    fields = raw.fields
    if fields.get("dimension") != "3":
        layers = " (segments that overlap are stored in layers: export them as separate label maps)"
        what = f"dimension {fields.get('dimension')}{layers if fields.get('dimension') == '4' else ''}"
        raise InputError(what, where=path, allowed="dimension: 3")
    shape = check_shape(tuple(_whole(text, path) for text in _need(fields, "sizes", path).split()), where=path)
    itemsize = BYTES_OF_TYPE.get(_need(fields, "type", path).lower())
    if itemsize is None:
        raise InputError(f"type {fields['type']!r}", where=path, allowed="an integer type, float or double")
    _check_units(fields, path)
    T_ct_index = check_affine(_affine(fields, path), where=path)
    _check_data(raw, shape, itemsize, path)
    return VolumeHeader(shape, T_ct_index, raw.remarks)


def data_file(content: bytes, path: Path) -> str | None:
    """The name of the file beside a detached header that holds its data; None where header and data are one file.

    Args:
        content: The file, or its beginning.
        path: Its name.

    Raises:
        InputError: A damaged header, or data elsewhere than in the file or beside it.
    """
    raw = _split(content[:MAX_HEADER_BYTES], path)
    return None if raw.data_path == path else raw.data_path.name


def _split(head: bytes, path: Path) -> _Raw:
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
        return _Raw(fields, remarks, _beside(fields["datafile"], path), 0)
    if end is None:
        raise InputError("the file ends inside the header", where=path, allowed="a complete file")
    return _Raw(fields, remarks, path, end.end())


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


def _need(fields: dict[str, str], key: str, path: Path) -> str:
    if not fields.get(key):
        raise InputError(f"the header has no field {key!r}", where=path, allowed="a complete NRRD header")
    return fields[key]


def _whole(text: str, path: Path) -> int:
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        raise InputError(f"size {text[:30]!r}", where=path, allowed="positive whole numbers")
    return int(text)


def _beside(name: str, path: Path) -> Path:
    """The data file of a detached header: a plain name in the same folder, or nothing."""
    allowed = "the name of one file in the same folder"
    if not name or re.search(r"[/\\%\s\0]", name) or name in (".", "..") or name.upper().startswith("LIST"):
        raise InputError(f"data file {name[:80]!r}", where=path, allowed=allowed)
    data_path = path.parent / name
    if not data_path.is_file():
        raise InputError(f"data file {name!r} does not exist", where=path, allowed=allowed)
    if data_path.resolve().parent != path.parent.resolve():
        raise InputError(f"data file {name!r} is a link to another folder", where=path, allowed=allowed)
    if data_path.resolve() == path.resolve():
        raise InputError("the data file is the header itself", where=path, allowed=allowed)
    return data_path


def _check_units(fields: dict[str, str], path: Path) -> None:
    for key in ("spaceunits", "units"):
        named = set(re.findall(r'"([^"]*)"', fields.get(key, ""))) - {""}
        if (fields.get(key) and not named and key == "spaceunits") or named - {"mm"}:
            raise InputError(f"{key} {fields[key]!r}", where=path, allowed='"mm" "mm" "mm"')


def _affine(fields: dict[str, str], path: Path) -> NDArray[np.float64]:
    space = _need(fields, "space", path).lower()
    if space not in LPS_SIGNS:
        allowed = "left-posterior-superior, right-anterior-superior, left-anterior-superior"
        raise InputError(f"space {space!r} is not patient space", where=path, allowed=allowed)
    directions = _vectors(_need(fields, "spacedirections", path), 3, path)
    origin = _vectors(_need(fields, "spaceorigin", path), 1, path)
    T = np.eye(4)
    T[:3, :3] = directions.T
    T[:3, 3] = origin[0]
    T[:3] *= np.array(LPS_SIGNS[space])[:, None]
    return T


def _vectors(text: str, count: int, path: Path) -> NDArray[np.float64]:
    allowed = f"{count} of (x,y,z) in mm"
    rows = VECTOR.findall(text)
    if len(rows) != count or VECTOR.sub("", text).strip():
        raise InputError(f"{text[:80]!r}", where=path, allowed=allowed)
    try:
        vectors = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    except ValueError as error:
        raise InputError(f"{text[:80]!r} ({error})", where=path, allowed=allowed) from error
    if vectors.shape != (count, 3):
        raise InputError(f"{text[:80]!r}", where=path, allowed=allowed)
    return vectors


def _check_data(raw: _Raw, shape: tuple[int, int, int], itemsize: int, path: Path) -> None:
    for key in ("byteskip", "lineskip"):
        if raw.fields.get(key, "0") != "0":
            raise InputError(f"{key} {raw.fields[key]!r}", where=path, allowed="0")
    encoding = _need(raw.fields, "encoding", path).lower()
    if encoding not in GZIP | ASCII | {"raw"}:
        raise InputError(f"encoding {encoding!r}", where=path, allowed="raw, gzip, ascii")
    if encoding not in ASCII and itemsize > 1 and raw.fields.get("endian", "").lower() not in ("little", "big"):
        raise InputError("the byte order is not said", where=path, allowed="endian: little or big")
    count = shape[0] * shape[1] * shape[2]
    available = raw.data_path.stat().st_size - raw.data_offset
    if encoding == "raw":
        check_exact_size(available, count * itemsize, where=raw.data_path)
        return
    with raw.data_path.open("rb") as stream:
        stream.seek(raw.data_offset)
        if encoding in GZIP:
            check_inflated_size(stream, available, count * itemsize, where=raw.data_path)
        else:
            _check_numbers(stream, count, raw.fields["type"].lower() in ("float", "double"), raw.data_path)


def _check_numbers(stream: BinaryIO, count: int, decimals: bool, path: Path) -> None:
    """Counts the numbers of an ascii encoding."""
    pattern = FLOAT_TEXT if decimals else INTEGER_TEXT
    found, inside = 0, False
    while chunk := stream.read(CHUNK_BYTES):
        if pattern.fullmatch(chunk) is None:
            raise InputError("the data hold something else than numbers", where=path, allowed="plain numbers")
        found += len(chunk.split()) - int(inside and not chunk[:1].isspace())
        inside = not chunk[-1:].isspace()
    check_exact_size(found, count, where=path)
