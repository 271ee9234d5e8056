"""Mesh files of other programs, as guarded meshes in mm: STL, OBJ, PLY, GLB, VTP and legacy VTK.

Each format has its own strict reader, because a lost triangle makes a path "free": a file must hold what it promises to
the byte. General loaders are made to show something. trimesh 5.2, measured on a box of 12 triangles: half an ASCII STL
loads as 6, one misspelt ``vertex`` as 11, an ASCII PLY without its last line as 11, and relative OBJ indices put every
face on the last vertices; none with an exception. The tests compare our readers with trimesh on whole files.

STL: the binary form states its number of facets, so its size must fit to the byte. The ASCII form states nothing: every
facet must be complete and the one solid must be closed by ``endsolid``. OBJ states no counts and has no end mark, so
that a file cut between two face lines is itself a valid OBJ. What can be detected is refused: a last line without its
end, a vertex that no face uses, fewer faces than a comment counts. What remains shows as an open mesh, of which
``mesh_warnings`` tells. Material files are never opened.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import refuse, refusing
from puncture_twin.planning.base.files import decode_text, read_input
from puncture_twin.planning.formats.guard import RawMesh, guard_mesh, triangulate
from puncture_twin.planning.formats.meshes.ply import read_ply
from puncture_twin.planning.formats.meshes.vtk_legacy import read_vtk
from puncture_twin.planning.formats.meshes.vtp import read_vtp
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up, to_lps

_IGNORED = frozenset(
    (
        *("vt", "vn", "vp", "o", "g", "s", "mg", "usemtl", "mtllib", "usemap", "maplib", "shadow_obj", "trace_obj"),
        *("bevel", "c_interp", "d_interp", "lod", "cstype", "deg", "bmat", "step", "ctech", "parm", "curv2", "end"),
    )
)
"""Lines without a surface in them: texture, normals, names, groups, materials, drawing, numbers of curves."""
_VERTEX_LISTS = {"f": 1, "l": 1, "p": 1, "curv": 3}
"""Lines that name vertices, from which word on: faces, polylines, points, and curves after their range."""
_ALLOWED = "lines v, f, l, p, curv, and " + ", ".join(sorted(_IGNORED))
_STATED_COUNT = re.compile(r"#\s*faces\s*:\s*(\d+)|#\s*(\d+)\s+(?:faces|triangles)\b", re.IGNORECASE)
_LAST_LINE = "\n# End of File"  # MeshLab writes it without a line end


def read_obj(data: bytes, where: str) -> RawMesh:
    """The faces of an OBJ file, of all its objects and groups; polygons are cut into fans."""
    text = decode_text(data, where)
    if not text.endswith(("\n", _LAST_LINE)):
        what = "the last line has no line end: the file may be truncated"
        refuse(what, where, "a line end after every line", "file_cut")
    text = text.replace("\\\r\n", " ").replace("\\\n", " ")
    vertices, corners, counts, used = list[tuple[float, float, float]](), list[int](), list[int](), set[int]()
    for number, line in enumerate(text.split("\n"), start=1):
        tokens, place = line.split("#", 1)[0].split(), f"{where}, line {number}"
        if not tokens or tokens[0] in _IGNORED:
            continue
        if tokens[0] == "v":
            vertices.append(_vertex(tokens[1:], place))
        elif tokens[0] in _VERTEX_LISTS:
            named = [_corner(token, len(vertices), place) for token in tokens[_VERTEX_LISTS[tokens[0]] :]]
            used.update(named)
            if tokens[0] == "f":
                corners += named
                counts.append(len(named))
        else:
            refuse(f"line starts with {tokens[0][:20]!r}", place, _ALLOWED, "unknown_line")
    faces = triangulate(np.array(corners, dtype=np.int64), np.array(counts, np.int64), where)
    if unused := len(vertices) - len(used):
        what = f"{unused} vertices are not used by any face: the face list may be truncated"
        allowed = "an OBJ whose faces use every vertex, or a format that states its counts"
        refuse(what, where, allowed, "unused_vertices")
    # As floats: `int` refuses a text of 5,000 digits.
    by_form = [sum(float(count) for count in form if count) for form in zip(*_STATED_COUNT.findall(text), strict=True)]
    stated, there = max(by_form, default=0.0), len(counts)  # MeshLab states all its faces in both forms
    if stated > there:
        refuse(f"comments state {stated:.0f} faces, but there are {there}", where, "as many as stated", "size_mismatch")
    return RawMesh(np.array(vertices, dtype=np.float64), faces)


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
        refuse(f"the line names vertex {index} of {n_vertices}, out of range", where, allowed, "index_out_of_range")
    return index - 1 if index > 0 else n_vertices + index


_HEADER_BYTES = 84
_MAX_NAME_BYTES = 100_000
_FACET = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])
_BINARY_ALLOWED = "a binary STL of 84 + 50 n bytes, n as its header states it, at least 1"
_ASCII_ALLOWED = "one solid of complete facets, closed by endsolid"
_KEYWORDS = {
    0: "facet", 1: "normal", 5: "outer", 6: "loop", 7: "vertex", 11: "vertex", 15: "vertex", 19: "endloop",
    20: "endfacet",
}  # fmt: skip
_TOKENS_PER_FACET = 21
_COORDINATE_TOKENS = [8, 9, 10, 12, 13, 14, 16, 17, 18]


def read_stl(data: bytes, where: str) -> RawMesh:
    """The triangles of an STL file, three vertices of their own each."""
    stated = int.from_bytes(data[80:84], "little")
    needed = _HEADER_BYTES + 50 * stated
    name = re.match(rb"(?:\xef\xbb\xbf)?\s*solid[^\r\n]*", data[:_MAX_NAME_BYTES], re.IGNORECASE)
    looks_ascii = name is not None and b"facet" in data[: name.end() + 2048].lower()
    if looks_ascii and (len(data) < _HEADER_BYTES or len(data) != needed):
        return _read_ascii(data, where)
    if len(data) < _HEADER_BYTES:
        refuse(f"STL of {len(data)} bytes is shorter than its header", where, _BINARY_ALLOWED, "file_cut")
    if len(data) != needed or stated == 0:
        what = f"header states {stated} triangles, which take {needed} bytes, but the file has {len(data)}"
        refuse(what, where, _BINARY_ALLOWED, "size_mismatch")
    return _from_corners(np.frombuffer(data, _FACET, offset=_HEADER_BYTES)["corners"].astype(np.float64))


def _read_ascii(data: bytes, where: str) -> RawMesh:
    lines = decode_text(data, where).strip().splitlines()
    if lines[-1].split()[0].lower() != "endsolid":
        refuse(f"the last line is {lines[-1][:40]!r}: the file is cut", where, _ASCII_ALLOWED, "file_cut")
    tokens = " ".join(lines[1:-1]).lower().split()
    if "endsolid" in tokens:
        refuse("several solids: a truncated file could lose some", where, _ASCII_ALLOWED, "several_solids")
    if len(tokens) == 0:
        refuse("the solid has no facet", where, _ASCII_ALLOWED, "empty")
    for at, word in enumerate(tokens):
        facet, place = divmod(at, _TOKENS_PER_FACET)
        keyword = _KEYWORDS.get(place, word)
        if word != keyword:
            refuse(f"facet {facet}: {word[:20]!r} instead of {keyword!r}", where, _ASCII_ALLOWED, "unknown_line")
    if len(tokens) % _TOKENS_PER_FACET:
        refuse(f"facet {len(tokens) // _TOKENS_PER_FACET} is not complete", where, _ASCII_ALLOWED, "file_cut")
    columns = [tokens[column::_TOKENS_PER_FACET] for column in _COORDINATE_TOKENS]
    with refusing(ValueError, "a coordinate is not a number", where, _ASCII_ALLOWED, "not_a_number"):
        corners = np.array([[float(token) for token in column] for column in columns])
    return _from_corners(corners.T.reshape(-1, 3, 3))


def _from_corners(corners: NDArray[np.float64]) -> RawMesh:
    return RawMesh(corners.reshape(-1, 3), np.arange(3 * len(corners), dtype=np.int64).reshape(-1, 3))


MAX_FILE_BYTES = 2_000_000_000
"""Twenty million triangles of binary STL are 1 GB; a file beyond twice that is refused before it is read."""


def _read_glb(data: bytes, where: str) -> RawMesh:
    from puncture_twin.planning.formats.meshes.glb import read_glb  # here: its schema costs all others 0.02 s

    return read_glb(data, where)


_READERS: Mapping[str, Callable[[bytes, str], RawMesh]] = MappingProxyType(
    {".stl": read_stl, ".obj": read_obj, ".ply": read_ply, ".glb": _read_glb, ".vtp": read_vtp, ".vtk": read_vtk}
)
UP_NOT_STATED = "the glTF standard says y is up, some programs write z up, and the file does not state it"
_STATEMENT = re.compile(rb"\bSPACE=(LPS|RAS)\b")
_STATEMENT_BYTES = 1000
"""Slicer writes what space a mesh is in into its header or first comment; a VTP has a field for it."""
MESH_SUFFIXES: tuple[str, ...] = tuple(_READERS)
"""The file name endings that ``read_mesh`` takes, in lower case; upper case is the same."""


def read_mesh(
    path: Path, *, unit: Unit, space: Space, space_is_default: bool = False, up: Up | None = None
) -> TriangleMesh:
    """One mesh file, checked against its own promises, in mm and LPS (or its own local frame).

    A file that Slicer wrote states its space, which must be the declared one. All parts of a file become one surface,
    placed by their node transforms, in the file's order; nothing is welded and no triangle dropped. Axes of a file
    whose y is up are rotated about x, so that z is; of a GLB it must be stated.

    Args:
        unit: Of its coordinates, also for GLB, whose standard says metres.
        space_is_default: Whether a patient space that the file states holds instead of ``space``.
        up: Its axis that is up in the file; without it, z of all but GLB.

    Raises:
        InputError: If it is missing, cut, contradicts itself or the caller, is empty, or fails the guard.
    """
    _reader(path)  # an unknown ending is refused before anything is read
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    return parse_mesh(data, path, unit=unit, space=space, space_is_default=space_is_default, up=up)


def parse_mesh(
    data: bytes,
    path: Path,
    *,
    unit: Unit,
    space: Space,
    space_is_default: bool = False,
    up: Up | None = None,
    stretch: NDArray[np.float64] | None = None,
) -> TriangleMesh:
    """Parse a mesh file that has been read, like `read_mesh`; it is not opened again.

    ``stretch``, shape (3,): factors of the file's axes on top of its unit, as a URDF states them.
    """
    name, actual, header_space = str(path), space, _stated_space(data)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite or NaN here, the guard refuses
        raw = _reader(path)(data, name)
        stated = raw.space or header_space
        if stated is not None and space_is_default and space is not Space.LOCAL:
            actual = stated
        elif stated not in (None, space) and (space is not Space.LOCAL or space_is_default):  # local is of its own
            allowed = 'space = "local" if intended' if space is Space.LOCAL else f'space = "{stated}"'
            refuse(f"the file states SPACE={stated}, the case {space}", name, allowed, "other_space")
        if up is None and path.suffix.lower() == ".glb":
            allowed = 'up = "y" (rotated to z up) or up = "z" (kept as it is), or another format'
            refuse(UP_NOT_STATED, path, allowed, "up_not_stated")
        z_up = raw.vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0] if up is Up.Y else raw.vertices
        vertices = to_lps(z_up, actual) * (unit.mm if stretch is None else unit.mm * stretch)
    return guard_mesh(vertices, raw.faces, where=name)


def _stated_space(data: bytes) -> Space | None:
    match = _STATEMENT.search(data[:_STATEMENT_BYTES])
    return None if match is None else Space(match[1].decode())


class MeshExtent(NamedTuple):
    """Box and space of a mesh file before its unit is known."""

    box: NDArray[np.float64]  # its lowest and highest corner in its own unit, whatever that is, shape (2, 3)
    space: Space | None  # what it states of its axes, or None


def mesh_extent(path: Path) -> MeshExtent:
    """The box of a mesh file in its own unit, and the space that it states; refused as by `read_mesh`."""
    reader = _reader(path)  # an unknown ending is refused before anything is read
    data = read_input(path, max_bytes=MAX_FILE_BYTES, where=str(path))
    raw = reader(data, str(path))
    if not np.isfinite(raw.vertices).all() or len(raw.vertices) == 0:
        refuse("no vertex, or one that is not finite", path, "finite vertices", "not_finite")
    box = np.stack([raw.vertices.min(axis=0), raw.vertices.max(axis=0)]).astype(np.float64)
    return MeshExtent(box, raw.space or _stated_space(data))


def _reader(path: Path) -> Callable[[bytes, str], RawMesh]:
    suffix = path.suffix.lower()
    if suffix not in _READERS:
        allowed = "a file ending in " + ", ".join(MESH_SUFFIXES)
        refuse(f"unknown mesh format {path.suffix!r}", path, allowed, "unknown_format")
    return _READERS[suffix]


def mesh_warnings(mesh: TriangleMesh, name: str) -> tuple[str, ...]:
    """Warnings about a structure's mesh, mm, one sentence each."""
    warnings = []
    flat = np.count_nonzero(mesh.areas == 0.0)
    if flat:
        warnings.append(f"{name}: {flat} of {len(mesh.faces)} triangles have no area (kept)")
    if not mesh.closed:
        warnings.append(
            f"{name}: open mesh: only the distance to its surface is known, not inside or outside; if it should be "
            "closed, the file may be incomplete"
        )
    elif not mesh.wound_alike:
        warnings.append(
            f"{name}: duplicate triangles, or triangles wound against their neighbours: inside is found with rays"
        )
    elif mesh.volume < 0.0:
        warnings.append(f"{name}: inverted normals, pointing inward (was it mirrored?); inside is found without them")
    return tuple(warnings)


def cached_mesh_warnings(meshes: Mapping[str, TriangleMesh], cache: Cache) -> tuple[str, ...]:
    """`mesh_warnings` of each mesh, by name, from the cache for meshes seen before.

    The meshes know then whether they are closed and wound alike, see `TriangleMesh.known`.
    """
    made_from = {"what": "mesh warnings", "meshes": [(name, mesh.digest) for name, mesh in meshes.items()]}

    def checked() -> Arrays:
        lines = [line for name, mesh in meshes.items() for line in mesh_warnings(mesh, name)]
        facts = [(mesh.closed, mesh.wound_alike) for mesh in meshes.values()]
        return {"lines": np.array(lines, np.str_), "facts": np.array(facts, np.bool_).reshape(-1, 2)}

    def check(cached: Arrays) -> None:
        lines, facts = cached["lines"], cached["facts"]
        if lines.dtype.kind != "U" or lines.ndim != 1 or facts.dtype != np.bool_ or facts.shape != (len(meshes), 2):
            raise ValueError("no lines, or not of these meshes")

    cached = cache.arrays(made_from, checked, by=__name__, check=check)
    for mesh, (closed, wound_alike) in zip(meshes.values(), cached["facts"].tolist(), strict=True):
        mesh.known(closed=closed, wound_alike=wound_alike)
    return tuple(cached["lines"].tolist())
