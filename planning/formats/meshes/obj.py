"""Wavefront OBJ: vertices and faces, every line understood or refused.

OBJ states no counts and has no end mark, so that a file cut between two face lines is itself a valid OBJ. What can be
detected is refused: a last line without its end, a vertex that no face uses, fewer faces than a comment counts. What
remains shows as an open mesh, of which ``mesh_warnings`` tells. Material files are never opened.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.files import decode_text
from puncture_twin.planning.formats.raw_mesh import RawMesh, triangulate

_IGNORED = frozenset({"vt", "vn", "vp", "o", "g", "s", "mg", "usemtl", "mtllib", "l", "p", "usemap", "maplib"})
"""Lines without a surface in them: texture, normals, names, groups, materials, polylines, points."""
_ALLOWED = "lines v, f, and " + ", ".join(sorted(_IGNORED))
_STATED_COUNT = re.compile(r"#\s*faces\s*:\s*(\d+)|#\s*(\d+)\s+(?:faces|triangles)\b", re.IGNORECASE)


@dataclass
class _Content:
    vertices: list[tuple[float, float, float]] = field(default_factory=list)
    corners: list[int] = field(default_factory=list)
    counts: list[int] = field(default_factory=list)


def read_obj(data: bytes, where: str) -> RawMesh:
    """The faces of an OBJ file, of all its objects and groups; polygons are cut into fans.

    Raises:
        InputError: If a line is not understood, an index is out of range, or the file shows that it was cut.
    """
    text = decode_text(data, where)
    if not text.endswith("\n"):
        refuse(
            "the last line has no line end: the file may be truncated", where, "a line end after every line", "file_cut"
        )
    content = _Content()
    text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    for number, line in enumerate(text.split("\n"), start=1):
        _read_line(line, content, f"{where}, line {number}")
    faces = triangulate(np.array(content.corners, dtype=np.int64), np.array(content.counts, np.int64), where)
    _check_complete(content, text, where)
    return RawMesh(np.array(content.vertices, dtype=np.float64), faces)


def _read_line(line: str, content: _Content, where: str) -> None:
    tokens = line.split("#", 1)[0].split()
    if not tokens or tokens[0] in _IGNORED:
        return
    if tokens[0] == "v":
        content.vertices.append(_vertex(tokens[1:], where))
    elif tokens[0] == "f":
        content.corners.extend(_corner(token, len(content.vertices), where) for token in tokens[1:])
        content.counts.append(len(tokens) - 1)
    else:
        refuse(f"line starts with {tokens[0][:20]!r}", where, _ALLOWED, "unknown_line")


def _vertex(tokens: list[str], where: str) -> tuple[float, float, float]:
    allowed = "v x y z, then nothing, a weight of 1, or a colour of three numbers"
    try:
        numbers = [float(token) for token in tokens]
    except ValueError:
        refuse(f"vertex {' '.join(tokens)[:60]!r}", where, allowed, "not_a_number")
    if len(numbers) not in (3, 4, 6, 7) or (len(numbers) in (4, 7) and numbers[3] != 1.0):
        refuse(f"vertex of {len(numbers)} numbers {tokens[:7]}", where, allowed, "wrong_count")
    return numbers[0], numbers[1], numbers[2]


def _corner(token: str, n_vertices: int, where: str) -> int:
    """The vertex of ``v``, ``v/vt``, ``v/vt/vn`` or ``v//vn``, from 0; negative ones count back from this line."""
    allowed = "v, v/vt, v/vt/vn or v//vn of a vertex above this line, counted from 1, or back from -1"
    if not re.fullmatch(r"-?\d{1,18}(/(-?\d{1,18})?){0,2}", token, re.ASCII):
        refuse(f"face corner {token[:40]!r}", where, allowed, "not_a_number")
    index = int(token.split("/")[0])
    if index == 0 or abs(index) > n_vertices:
        refuse(f"face uses vertex {index} of {n_vertices}, out of range", where, allowed, "index_out_of_range")
    return index - 1 if index > 0 else n_vertices + index


def _check_complete(content: _Content, text: str, where: str) -> None:
    unused = len(content.vertices) - len(set(content.corners))
    if unused:
        what = f"{unused} vertices are not used by any face: the face list may be truncated"
        allowed = "an OBJ whose faces use every vertex, or a format that states its counts"
        refuse(what, where, allowed, "unused_vertices")
    stated = sum(int(first or second) for first, second in _STATED_COUNT.findall(text))
    if stated > len(content.counts):
        what = f"comments state {stated} faces, but there are {len(content.counts)}"
        refuse(what, where, "as many as stated", "size_mismatch")
