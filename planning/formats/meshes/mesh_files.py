"""Mesh files of other programs, as guarded meshes in mm: STL, OBJ, PLY, GLB, VTP and legacy VTK.

Each format has its own strict reader, because a lost triangle makes a path "free": a file must hold what it promises to
the byte. General loaders are made to show something. trimesh 5.2, measured on a box of 12 triangles: half an ASCII STL
loads as 6, one misspelt ``vertex`` as 11, an ASCII PLY without its last line as 11, and relative OBJ indices put every
face on the last vertices; none with an exception. The tests compare our readers with trimesh on whole files.
`mesh_warnings` names triangles without area, open surfaces and inverted normals.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import InputError, refuse
from puncture_twin.planning.base.files import read_input
from puncture_twin.planning.formats.mesh_guard import guard_mesh
from puncture_twin.planning.formats.meshes.obj import read_obj
from puncture_twin.planning.formats.meshes.ply import read_ply
from puncture_twin.planning.formats.meshes.stl import read_stl
from puncture_twin.planning.formats.meshes.vtk_legacy import read_vtk
from puncture_twin.planning.formats.meshes.vtp import read_vtp
from puncture_twin.planning.formats.raw_mesh import RawMesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up, to_lps

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

    The caller declares the unit, also for GLB, whose standard says metres, and the space. A file that Slicer wrote
    states its space, which must be the declared one. All parts of a file become one surface, placed by their node
    transforms, in the file's order; nothing is welded and no triangle dropped. Axes of a file whose y is up are rotated
    about x, so that z is; of a GLB it must be stated.

    Args:
        path: An STL, OBJ, PLY, GLB, VTP or VTK file.
        unit: The unit of its coordinates.
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

    Args:
        path: Its name, whose ending says the format.
        unit: The unit of its coordinates.
        stretch: Shape (3,): factors of the file's axes on top of its unit, as a URDF states them.

    Raises:
        InputError: As `read_mesh`, but for reading.
    """
    name = str(path)
    reader = _reader(path)
    with np.errstate(over="ignore", invalid="ignore"):  # what becomes infinite or NaN here, the guard refuses
        in_text = _stated_space(data)
        raw = reader(data, name)
        stated = raw.space or in_text
        actual = space if stated is None else _actual_space(stated, space, default=space_is_default, where=name)
        vertices = to_lps(_z_up(raw.vertices, up, path), actual) * (unit.mm if stretch is None else unit.mm * stretch)
    return guard_mesh(vertices, raw.faces, where=name)


def _z_up(vertices: NDArray[np.float64], up: Up | None, path: Path) -> NDArray[np.float64]:
    """Points (n, 3) of a file, rotated by a quarter about x where its y is up."""
    if up is None and path.suffix.lower() == ".glb":
        allowed = 'up = "y" (rotated to z up) or up = "z" (kept as it is), or another format'
        refuse(UP_NOT_STATED, path, allowed, "up_not_stated")
    return vertices if up is not Up.Y else vertices[:, [0, 2, 1]] * [1.0, -1.0, 1.0]


def _stated_space(data: bytes) -> Space | None:
    found = _STATEMENT.search(data[:_STATEMENT_BYTES])
    return None if found is None else Space(found[1].decode())


def _actual_space(stated: Space, space: Space, *, default: bool, where: str) -> Space:
    """The space of a file that states one; that of a frame of its own may be declared local."""
    if stated is space or (space is Space.LOCAL and not default):
        return space
    if default and space is not Space.LOCAL:
        return stated
    allowed = 'space = "local" if intended' if space is Space.LOCAL else f'space = "{stated}"'
    what = f"the file states SPACE={stated}, the case {space}"
    raise InputError(what, where=where, allowed=allowed, code="other_space")


class MeshExtent(NamedTuple):
    """Box and space of a mesh file before its unit is known.

    Attributes:
        box: Its lowest and highest corner in its own unit, whatever that is, shape (2, 3).
        space: What it states of its axes, or None.
    """

    box: NDArray[np.float64]
    space: Space | None


def mesh_extent(path: Path) -> MeshExtent:
    """The box of a mesh file in its own unit, and the space that it states.

    Raises:
        InputError: As `read_mesh`, but for the guard.
    """
    reader = _reader(path)
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
    """Warnings about a structure's mesh, one sentence each.

    Args:
        mesh: The structure's surface, mm.
    """
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

    def found() -> Arrays:
        lines = [line for name, mesh in meshes.items() for line in mesh_warnings(mesh, name)]
        facts = [(mesh.closed, mesh.wound_alike) for mesh in meshes.values()]
        return {"lines": np.array(lines, np.str_), "facts": np.array(facts, np.bool_).reshape(-1, 2)}

    def check(cached: Arrays) -> None:
        lines, facts = cached["lines"], cached["facts"]
        if lines.dtype.kind != "U" or lines.ndim != 1 or facts.dtype != np.bool_ or facts.shape != (len(meshes), 2):
            raise ValueError("no lines, or not of these meshes")

    cached = cache.arrays(made_from, found, by=__name__, check=check)
    for mesh, (closed, wound_alike) in zip(meshes.values(), cached["facts"].tolist(), strict=True):
        mesh.known(closed=closed, wound_alike=wound_alike)
    return tuple(cached["lines"].tolist())
