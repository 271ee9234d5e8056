"""NRRD headers, checked before any voxel is looked at.

Layout and meaning of the fields: "Definition of NRRD File Format" (Teem project).
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.base.files import absence, is_plain_file
from puncture_twin.planning.formats.volumes.volume_header import VolumeHeader, VoxelLayout, check_affine, check_shape

MAX_HEADER_BYTES = 4_000_000
"""A .seg.nrrd with a thousand segments stays below 1 MB."""
KNOWN_FIELDS = frozenset(
    (
        *("type", "dimension", "space", "spacedimension", "sizes", "spacedirections", "spaceorigin", "spaceunits"),
        *("kinds", "endian", "encoding", "datafile", "centers", "centerings", "content", "measurementframe"),
        *("byteskip", "lineskip", "thicknesses", "units", "labels", "min", "max", "oldmin", "oldmax", "number"),
        *("axismins", "axismaxs", "sampleunits"),
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
    """The header at the beginning of a file."""
    head = content[:MAX_HEADER_BYTES]
    if re.match(rb"NRRD000[1-5]\r?\n", head) is None:
        refuse("not a NRRD header (magic NRRD0001 to NRRD0005)", path, "a .nrrd or .nhdr file", "wrong_format")
    end = re.search(rb"\n\r?\n", head)
    if end is None and len(head) == MAX_HEADER_BYTES:
        refuse("the header has no end", path, f"at most {MAX_HEADER_BYTES} bytes", "bad_header")
    with refusing(UnicodeDecodeError, "the header is not text", path, "UTF-8", "not_text"):
        lines = head[: end.start() if end else None].decode("utf-8").split("\n")[1:]
    fields, remarks = dict[str, str](), dict[str, str]()
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
            refuse(f"unknown header line {line[:60]!r}", where, ", ".join(sorted(KNOWN_FIELDS)), "unknown_line")
        if key in fields:
            refuse(f"the field {field!r} appears twice", where, "each field once", "duplicate_key")
        fields[key] = value.strip()
    if "datafile" in fields:
        name = re.sub(r"^(\./+)+", "", fields["datafile"])  # as teem writes it
        allowed = "the name of one file in the same folder"
        if not name or re.search(r"[/\\%\0]|[^\S ]", name) or name in (".", "..") or name.upper().startswith("LIST"):
            refuse(f"data file {name[:80]!r}", path, allowed, "outside_folder")
        data_path = path.parent / name
        if not is_plain_file(data_path):
            refuse(f"data file {name!r} {absence(data_path)}", path, allowed, "no_such_file")
        if data_path.resolve().parent != path.parent.resolve():
            refuse(f"data file {name!r} is a link to another folder", path, allowed, "outside_folder")
        if data_path.resolve() == path.resolve():
            refuse("the data file is the header itself", path, allowed, "data_elsewhere")
        return NrrdText(fields, remarks, data_path, 0)
    if end is None:
        refuse("the file ends inside the header", path, "a complete file", "file_cut")
    return NrrdText(fields, remarks, path, end.end())


def stated_field(fields: dict[str, str], key: str, path: Path) -> str:
    """A field that a header must have."""
    if not fields.get(key):
        refuse(f"the header has no field {key!r}", path, "a complete NRRD header", "missing_key")
    return fields[key]


def whole_number(text: str, path: Path) -> int:
    """A field's text as a count."""
    if not (text.isascii() and text.isdigit() and len(text) < 19):
        refuse(f"size {text[:30]!r}", path, "positive whole numbers", "not_whole")
    return int(text)


LPS_SIGNS = {
    **dict.fromkeys(("left-posterior-superior", "lps"), (1.0, 1.0, 1.0)),
    **dict.fromkeys(("right-anterior-superior", "ras"), (-1.0, -1.0, 1.0)),
    **dict.fromkeys(("left-anterior-superior", "las"), (1.0, -1.0, 1.0)),
}
TYPES = {
    **dict.fromkeys(("signed char", "int8", "int8_t"), "i1"),
    **dict.fromkeys(("uchar", "unsigned char", "uint8", "uint8_t"), "u1"),
    **dict.fromkeys(("short", "short int", "signed short", "signed short int", "int16", "int16_t"), "i2"),
    **dict.fromkeys(("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"), "u2"),
    **dict.fromkeys(("int", "signed int", "int32", "int32_t"), "i4"),
    **dict.fromkeys(("uint", "unsigned int", "uint32", "uint32_t"), "u4"),
    **dict.fromkeys(("longlong", "long long", "long long int", "signed long long", "int64", "int64_t"), "i8"),
    **dict.fromkeys(("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"), "u8"),
    "float": "f4",
    "double": "f8",
}
SKIPS = {"byteskip": ("0", "-1"), "lineskip": ("0",)}
"""-1: the data are the file's last bytes, which here all of them must be: after a cut others would be the last."""
GZIP = frozenset(("gzip", "gz"))
AXIS_KINDS = frozenset(("domain", "space", "time", "none", "???"))
"""Kinds of an axis that runs through space; others (vector, list, color) hold several values per voxel."""
VECTOR = re.compile(r"\(([^()]*)\)")
LAYER_KINDS = frozenset(("list", "vector"))
"""Kinds that Slicer gives the axis of its layers: "list"; older versions "vector"."""
MAX_LAYERS = 1000
"""A layer more is needed only where another segment overlaps all the layers before."""
UNNAMED_SPACE = "its header states no patient space; read as LPS, as in ITK and Slicer"


def parse_nrrd_header(content: bytes, path: Path) -> VolumeHeader:
    """The header of a volume in three dimensions. Raises InputError: damaged, no patient space, or data elsewhere."""
    return _header(_without_last(split_header(content, path)), path)


def parse_layered_header(content: bytes, path: Path) -> VolumeHeader:
    """The header of a segmentation whose segments may overlap: one volume, or several as layers.

    Layers are the first axis, which runs fastest in the file (Slicer, "Segmentations", file format).
    """
    raw = _without_last(split_header(content, path))
    if raw.fields.get("dimension") != "4":
        return _header(raw, path)
    fields = dict(raw.fields)
    for key in ("sizes", "spacedirections", "kinds"):
        fields[key] = stated_field(fields, key, path).partition(" ")[2].strip()
    for key in ("spaceunits", "units"):
        fields[key] = fields.get(key, "").replace('""', "").replace("???", "").strip()
    one_layer = {key: value for key, value in fields.items() if value} | {"dimension": "3"}
    sizes, kinds = raw.fields["sizes"].split(), raw.fields["kinds"].lower().split()
    if not (kinds and kinds[0] in LAYER_KINDS and sizes and raw.fields["spacedirections"].startswith("none")):
        allowed = "kinds: list domain domain domain, space directions: none (...)"
        refuse("dimension 4, but the first axis is not one of layers", path, allowed, "wrong_dimension")
    layers = whole_number(sizes[0], path)
    if not 1 <= layers <= MAX_LAYERS:
        refuse(f"{layers} layers", path, f"1 to {MAX_LAYERS}", "out_of_range")
    return _header(replace(raw, fields=one_layer), path, layers)


def is_layered(content: bytes, path: Path) -> bool:
    """Whether a file has a fourth axis, of Slicer's layers of overlapping segments. Raises InputError: no NRRD."""
    return _without_last(split_header(content, path)).fields.get("dimension") == "4"


def _without_last(raw: NrrdText) -> NrrdText:
    """The header without a fourth axis of length 1 behind the three of space."""
    fields = dict(raw.fields)
    sizes, directions = fields.get("sizes", "").split(), fields.get("spacedirections", "")
    if fields.get("dimension") != "4" or sizes[3:] != ["1"] or not directions.endswith("none"):
        return raw
    for key in fields.keys() & {"sizes", "kinds", "spaceunits", "units", "axismins", "axismaxs", "spacedirections"}:
        if len(fields[key].split()) == 4:
            fields[key] = fields[key].rpartition(" ")[0].strip()
    return replace(raw, fields={**fields, "dimension": "3"})


def _header(raw: NrrdText, path: Path, layers: int = 1) -> VolumeHeader:
    fields = raw.fields
    if (stated := fields.get("dimension")) == "4":
        what = 'dimension 4: overlapping segments are in layers; give such a file in [[structures]] seg = "FILE"'
        refuse(what, path, "dimension: 3, or a .seg.nrrd as seg", "wrong_dimension")
    if stated != "3":
        refuse(f"dimension {stated}", path, "dimension: 3", "wrong_dimension")
    sizes = [whole_number(text, path) for text in stated_field(fields, "sizes", path).split()]
    shape = check_shape(tuple(sizes), where=path)
    for key in ("spaceunits", "units"):
        named = set(re.findall(r'"([^"]*)"', fields.get(key, ""))) - {""}
        if (fields.get(key) and not named and key == "spaceunits") or named - {"mm"}:
            refuse(f"{key} {fields[key]!r}", path, '"mm" "mm" "mm"', "unknown_unit")
    kinds = fields.get("kinds", "domain domain domain").lower().split()
    if len(kinds) != 3 or not AXIS_KINDS.issuperset(kinds):
        refuse(f"kinds {fields['kinds'][:80]!r}", path, "domain domain domain", "unsupported_feature")
    for key in ("axismins", "axismaxs"):
        if set(fields.get(key, "nan").lower().split()) != {"nan"}:
            refuse(f"{key} together with a space", path, "only space origin and space directions", "stated_twice")
    notes = () if "space" in fields else (f"{path.name}: {UNNAMED_SPACE}",)
    T_ct_index = check_affine(_affine(dict(fields), path), where=path)
    return VolumeHeader(shape, T_ct_index, raw.remarks, _cells(raw, path), raw.data_path, layers, notes)


def data_file(content: bytes, path: Path) -> str | None:
    """The name of the file beside a detached header that holds its data; None where header and data are one file.

    Raises InputError: a damaged header, or data elsewhere than in the file or beside it.
    """
    raw = split_header(content, path)
    return None if raw.data_path == path else raw.data_path.name


def _affine(fields: dict[str, str], path: Path) -> NDArray[np.float64]:
    if "spacedimension" in fields:
        if "space" in fields:
            refuse("both space and space dimension", path, "one of the two", "stated_twice")
        if fields["spacedimension"] != "3":
            refuse(f"space dimension {fields['spacedimension'][:20]!r}", path, "3", "wrong_dimension")
        fields["space"] = "lps"  # a header that counts its axes instead is LPS, as to ITK
    space = stated_field(fields, "space", path).lower()
    if space not in LPS_SIGNS:
        allowed = "left-posterior-superior, right-anterior-superior, left-anterior-superior"
        refuse(f"space {space!r} is not a patient space", path, allowed, "unknown_space")
    directions = _vectors(stated_field(fields, "spacedirections", path), 3, path)
    origin = _vectors(stated_field(fields, "spaceorigin", path), 1, path)
    T = np.eye(4)
    T[:3, :3] = directions.T
    T[:3, 3] = origin[0]
    T[:3] *= np.array(LPS_SIGNS[space])[:, None]
    return T


def _vectors(text: str, count: int, path: Path) -> NDArray[np.float64]:
    allowed = f"{count} of (x,y,z) in mm"
    rows = VECTOR.findall(text)
    if len(rows) != count or VECTOR.sub("", text).strip():
        refuse(f"{text[:80]!r}", path, allowed, "not_a_number")
    with refusing(ValueError, f"{text[:80]!r}", path, allowed, "not_a_number"):
        vectors = np.array([[float(cell) for cell in row.split(",")] for row in rows])
    if vectors.shape != (count, 3):
        refuse(f"{text[:80]!r}", path, allowed, "not_a_number")
    return vectors


def _cells(raw: NrrdText, path: Path) -> VoxelLayout:
    fields = raw.fields
    for key, allowed in SKIPS.items():
        if fields.get(key, "0") not in allowed:
            refuse(f"{key} {fields[key]!r}", path, " or ".join(allowed), "unsupported_feature")
    stated = stated_field(fields, "encoding", path).lower()
    encoding = "gzip" if stated in GZIP else stated
    if encoding not in {"raw", "gzip"}:
        refuse(f"encoding {stated!r}", path, "raw, gzip", "unsupported_feature")
    name = TYPES.get(stated_field(fields, "type", path).lower())
    if name is None:
        refuse(f"type {fields['type']!r}", path, "an integer type, float or double", "unknown_type")
    order = {"little": "<", "big": ">"}.get(fields.get("endian", "").lower(), "")
    if not order and np.dtype(name).itemsize > 1:
        refuse("the byte order is not stated", path, "endian: little or big", "missing_key")
    return VoxelLayout(np.dtype(order + name), encoding, start=raw.data_offset)
