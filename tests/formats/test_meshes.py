"""Mesh files: whole ones give every triangle, broken ones give one clear line, never a smaller mesh."""

import struct
import sys
from collections.abc import Callable
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
import trimesh
from mesh_bytes import GLTF_BINARY, TRIANGLE, glb, gltf_document, vtp
from places import DATA, TESTS
from refusals import refused
from scipy.spatial import cKDTree
from slicer_files import vtk_model

from puncture_twin.planning.base.cache.array_cache import Cache
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.formats.meshes.mesh_files import cached_mesh_warnings, mesh_warnings, read_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.spaces import Space, Unit, Up

BALL = trimesh.creation.icosphere(1, 30.0)
BALL.apply_translation([5.0, -7.0, 11.0])
VH_MALE = DATA / "hubmap_vh_male"


def read(folder: Path, suffix: str, data: bytes, unit: Unit = Unit.MM, space: Space = Space.LPS) -> TriangleMesh:
    path = folder / f"mesh{suffix}"
    path.write_bytes(data)
    return read_mesh(path, unit=unit, space=space, up=Up.Z if suffix == ".glb" else None)


def test_a_glb_says_nothing_of_its_axes_so_the_case_must(tmp_path: Path) -> None:
    """By glTF's rule y is up, and trimesh writes any axes; a quarter about x makes them one."""
    for suffix, kind in ((".glb", "glb"), (".stl", "stl")):
        path = tmp_path / f"mesh{suffix}"
        path.write_bytes(BALL.export(file_type=kind))
        kept, turned = (read_mesh(path, unit=Unit.MM, space=Space.LPS, up=up).vertices for up in (Up.Z, Up.Y))
        x, y, z = kept.T
        assert np.array_equal(turned, np.stack([x, -z, y], axis=1))
        ras = read_mesh(path, unit=Unit.MM, space=Space.RAS, up=Up.Y).vertices
        assert np.array_equal(ras, turned * [-1.0, -1.0, 1.0])
    assert np.array_equal(kept, read_mesh(path, unit=Unit.MM, space=Space.LPS).vertices)
    with refused("up_not_stated"):
        read_mesh(tmp_path / "mesh.glb", unit=Unit.MM, space=Space.LPS)


def same_triangles(mesh: TriangleMesh, corners: np.ndarray, tolerance: float = 1e-5) -> bool:
    return mesh.triangles.shape == corners.shape and np.abs(mesh.triangles - corners).max() < tolerance


# ---- whole files of each kind, and how they are written ------------------------------------------------------------


def replaced(data: bytes, old: bytes, new: bytes) -> bytes:
    assert old in data
    return data.replace(old, new, 1)


def obj_text(vertices: np.ndarray, polygons: list[list[int]]) -> bytes:
    lines = [f"v {x} {y} {z}\n" for x, y, z in vertices]
    return "".join([*lines, *(f"f {' '.join(f'{i + 1}//1' for i in one)}\n" for one in polygons)]).encode()


def stl_text(triangles: np.ndarray) -> bytes:
    corners = [[f"vertex {x} {y} {z}\n" for x, y, z in one] for one in triangles]
    facets = [f"facet normal 0 0 0\nouter loop\n{''.join(one)}endloop\nendfacet\n" for one in corners]
    return f"{''.join(facets)}endsolid\n".encode()


def ply_mixed(vertices: np.ndarray, faces: list[list[int]], order: str = "<") -> bytes:
    name = {"<": "little", ">": "big"}[order]
    header = f"""ply\nformat binary_{name}_endian 1.0\ncomment made for a test\nelement vertex {len(vertices)}
property double x\nproperty double y\nproperty double z\nproperty uchar red\nelement face {len(faces)}
property uchar quality\nproperty list uchar int vertex_indices\nelement other 2\nproperty short s\nend_header\n"""
    rows = [struct.pack(f"{order}3dB", *row, 7) for row in vertices]
    rows += [struct.pack(f"{order}BB{len(face)}i", 9, len(face), *face) for face in faces]
    return header.encode() + b"".join(rows) + struct.pack(f"{order}2h", 1, 2)


FACES = BALL.faces.tolist()
WHOLE: dict[str, tuple[str, bytes]] = {
    "stl-binary": (".stl", BALL.export(file_type="stl")),
    "stl-ascii": (".stl", BALL.export(file_type="stl_ascii").encode()),
    "obj": (".obj", BALL.export(file_type="obj", digits=17).encode()),
    "ply-binary": (".ply", BALL.export(file_type="ply")),
    "ply-ascii": (".ply", trimesh.exchange.ply.export_ply(BALL, encoding="ascii")),
    "ply-little": (".ply", ply_mixed(BALL.vertices, FACES)),
    "ply-big": (".ply", ply_mixed(BALL.vertices, FACES, ">")),
    "glb": (".glb", BALL.export(file_type="glb")),
    "vtp-ascii": (".vtp", vtp(BALL.vertices, FACES)),
    "vtp-binary": (".vtp", vtp(BALL.vertices, FACES, "binary")),
    "vtp-binary-zlib": (".vtp", vtp(BALL.vertices, FACES, "binary", compressed=True, header="UInt64")),
    "vtp-raw": (".VTP", vtp(BALL.vertices, FACES, "raw", header="UInt64")),
    "vtp-raw-zlib": (".vtp", vtp(BALL.vertices, FACES, "raw", compressed=True)),
    "vtp-base64": (".vtp", vtp(BALL.vertices, FACES, "base64")),
    "vtp-base64-zlib": (".vtp", vtp(BALL.vertices, FACES, "base64", compressed=True)),
    "vtk-binary": (".vtk", vtk_model(BALL.vertices, FACES)),
    "vtk-ascii": (".vtk", vtk_model(BALL.vertices, FACES, binary=False)),
    "vtk-9-binary": (".vtk", vtk_model(BALL.vertices, FACES, version="5.1")),
    "vtk-9-ascii": (".vtk", vtk_model(BALL.vertices, FACES, version="5.1", binary=False)),
}


@pytest.mark.parametrize("kind", WHOLE)
def test_a_whole_file_gives_every_triangle_in_its_order(tmp_path: Path, kind: str) -> None:
    """All forms of one ball give its triangles, closed, facing outward, with nothing to warn of."""
    mesh = read(tmp_path, *WHOLE[kind])
    assert same_triangles(mesh, BALL.triangles)
    assert mesh.closed and mesh_warnings(mesh, "ball") == ()


def test_unit_and_space_are_the_declared_ones(tmp_path: Path) -> None:
    """Metres in RAS become mm in LPS: times 1000, x and y negated, still facing outward."""
    data = (BALL.copy().apply_scale(0.001)).export(file_type="stl")
    mesh = read(tmp_path, ".stl", data, Unit.M, Space.RAS)
    assert same_triangles(mesh, BALL.triangles * [-1, -1, 1], 1e-4)
    assert mesh_warnings(mesh, "ball") == ()
    with refused("implausible_size"):
        read(tmp_path, ".stl", data, Unit.MM)
    with refused("implausible_size"):
        read(tmp_path, *WHOLE["obj"], Unit.M)


PENTAGON = np.array([[0, 0, 0], [10, 0, 0], [15, 10, 0], [5, 20, 0], [-5, 10, 0], [0, 0, 9]], dtype=float)
POLYGONS = [[0, 1, 2, 3, 4], [0, 1, 5], [1, 2, 3, 5]]
FAN = [[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 1, 5], [1, 2, 3], [1, 3, 5]]


def test_polygons_become_fans(tmp_path: Path) -> None:
    """Polygons of 3, 4 and 5 corners in one file: count - 2 triangles each, from the first corner."""
    for suffix, data in (
        (".ply", ply_mixed(PENTAGON, POLYGONS)),
        (".ply", ply_mixed(PENTAGON, POLYGONS, ">")),
        (".vtp", vtp(PENTAGON, POLYGONS, "raw")),
        (".vtk", vtk_model(PENTAGON, POLYGONS)),
        (".vtk", vtk_model(PENTAGON, POLYGONS, binary=False)),
        (".vtk", vtk_model(PENTAGON, POLYGONS, version="5.1")),
        (".obj", obj_text(PENTAGON, POLYGONS)),
    ):
        assert same_triangles(read(tmp_path, suffix, data), PENTAGON[FAN])
    two = read(tmp_path, ".vtp", vtp(PENTAGON, POLYGONS, pieces=2))
    assert same_triangles(two, np.concatenate([PENTAGON[FAN]] * 2))


def test_relative_obj_indices_count_back_from_their_own_line(tmp_path: Path) -> None:
    """Two faces written after their own vertices lie in different planes (a general loader puts both in one)."""
    text = "".join(f"v 0 0 {z}\nv 9 0 {z}\nv 0 9 {z}\nf -3 -2 \\\n-1\n" for z in (0, 5))
    assert read(tmp_path, ".obj", text.encode()).triangles[:, :, 2].tolist() == [[0.0] * 3, [5.0] * 3]


def test_obj_normals_colours_groups_and_materials_are_passed_over(tmp_path: Path) -> None:
    """Lines that hold no surface change nothing, and a material library is never opened."""
    text = """mtllib /etc/passwd\no a\nv 0 0 0 0.5 0.5 0.5\nv 9 0 0 1\nv 0 9 0 # corner\nvn 0 0 1\nvt 0 0
g one\nusemtl x\ns off\nf 1/1/1 2/1/1 3/1/1\nl 1 2\n# Faces: 1\n"""
    assert len(read(tmp_path, ".obj", text.encode()).faces) == 1


def test_an_obj_of_meshlab_is_whole(tmp_path: Path) -> None:
    """Its faces are stated above and below, and its last line has no line end; no other may lack it."""
    text = b"# Vertices: 3\n# Faces: 1\n" + OBJ_CORNERS + b"f 1 2 3\n# 1 faces, 0 coords texture\n\n# End of File"
    assert len(read(tmp_path, ".obj", text).faces) == 1
    with refused("file_cut"):
        read(tmp_path, ".obj", text[:-1])
    for stated in (b"# 1 faces", b"# Faces: 1"):
        with refused("size_mismatch", 2):
            read(tmp_path, ".obj", text.replace(stated, stated.replace(b"1", b"2")))


def test_a_model_as_slicer_saves_it() -> None:
    """What VTK 9.3.1's own writer makes of a sphere: appended base64, zlib, normals, the field SPACE, empty cells.

    Volume and box are those that VTK says of the same surface.
    """
    path = TESTS / "formats" / "slicer_model.vtp"
    mesh = read_mesh(path, unit=Unit.MM, space=Space.RAS, space_is_default=True)
    assert (len(mesh.vertices), len(mesh.faces)) == (86, 168)
    assert mesh.closed and mesh.wound_alike
    assert trimesh.Trimesh(mesh.vertices, mesh.faces).volume == pytest.approx(30782.0746, abs=0.01)
    assert mesh.vertices.min(axis=0) == pytest.approx([-15, -50, 50], abs=1e-4)
    assert mesh.vertices.max(axis=0) == pytest.approx([25, -10, 90], abs=1e-4)
    with refused("other_space", "SPACE=LPS", "RAS"):
        read_mesh(path, unit=Unit.MM, space=Space.RAS)


def stl_header(space: str) -> bytes:
    return f"3D Slicer output. SPACE={space}".encode().ljust(80, b"\0") + WHOLE["stl-binary"][1][80:]


def vtp_field(space: str) -> bytes:
    codes = " ".join(str(code) for code in (*space.encode(), 0))
    field = (
        f'<FieldData><Array type="String" Name="SPACE" NumberOfTuples="1" format="ascii">{codes}</Array></FieldData>'
    )
    return WHOLE["vtp-ascii"][1].replace(b"<PolyData>", b"<PolyData>" + field.encode(), 1)


STATING = {
    ".vtk": lambda space: vtk_model(BALL.vertices, FACES, space=space),
    ".stl": stl_header,
    ".obj": lambda space: f"# 3D Slicer output. SPACE={space}\n".encode() + WHOLE["obj"][1],
    ".ply": lambda space: WHOLE["ply-ascii"][1].replace(
        b"comment ", f"comment 3D Slicer output. SPACE={space}\ncomment ".encode(), 1
    ),
    ".vtp": vtp_field,
}


@pytest.mark.parametrize("suffix", STATING)
def test_what_slicer_states_of_the_space_is_held(tmp_path: Path, suffix: str) -> None:
    """A stated space that the caller contradicts is refused; where nobody declared one, the file's own holds."""
    path = tmp_path / f"mesh{suffix}"
    path.write_bytes(STATING[suffix]("RAS"))
    turned = BALL.triangles * [-1, -1, 1]
    assert same_triangles(read_mesh(path, unit=Unit.MM, space=Space.RAS), turned)
    assert same_triangles(read_mesh(path, unit=Unit.MM, space=Space.LPS, space_is_default=True), turned)
    assert same_triangles(read_mesh(path, unit=Unit.MM, space=Space.LOCAL), BALL.triangles)
    with refused("other_space", "SPACE=RAS", "RAS"):
        read_mesh(path, unit=Unit.MM, space=Space.LPS)
    with refused("other_space", "SPACE=RAS"):
        read_mesh(path, unit=Unit.MM, space=Space.LOCAL, space_is_default=True)


def test_fields_and_lines_beside_the_polygons_are_passed_over(tmp_path: Path) -> None:
    """Arrays of other things, lone points and what VTK notes of arrays carry no surface."""
    extra = "FIELD FieldData 2\nTime 1 1 double\n0.5 \nName 1 1 string\nliver%20left\n"
    extra += "METADATA\nINFORMATION 0\n\nVERTICES 1 2\n1 0 \nLINES 1 3\n2 0 1 \n"
    data = vtk_model(PENTAGON, POLYGONS, binary=False, extra=extra)
    assert same_triangles(read(tmp_path, ".vtk", data), PENTAGON[FAN])


STRIPPED = [[0, 1, 2], [2, 1, 3], [2, 3, 4], [3, 4, 5]]


def test_strips_are_triangles_seen_from_both_sides_in_turn(tmp_path: Path) -> None:
    """As VTK's stripper and Slicer's model maker write them, beside polygons or alone; the order is polygons first."""
    strips = [[0, 1, 2, 3, 4], [3, 4, 5]]
    for binary, version in ((True, "4.2"), (False, "4.2"), (True, "5.1")):
        alone = vtk_model(PENTAGON, strips, binary=binary, version=version)
        mesh = read(tmp_path, ".vtk", replaced(alone, b"POLYGONS", b"TRIANGLE_STRIPS"))
        assert same_triangles(mesh, PENTAGON[STRIPPED])
    text = vtk_model(PENTAGON, POLYGONS, binary=False)
    both = replaced(text, b"\nCELL_DATA", b"TRIANGLE_STRIPS 1 5\n4 0 1 2 3\n\nCELL_DATA")
    assert same_triangles(read(tmp_path, ".vtk", both), PENTAGON[FAN + STRIPPED[:2]])
    piece = vtp(PENTAGON, strips, n_polys="0", n_strips="2").replace(b"Polys>", b"Strips>")
    assert same_triangles(read(tmp_path, ".vtp", piece), PENTAGON[STRIPPED])


def long_text(text: bytes) -> bytes:
    """A text in a binary file of VTK, its length in two bytes."""
    return (len(text) | 0x8000).to_bytes(2, "big") + text


VTK_HEAD = b"# vtk DataFile Version 4.2\n"
LEGAL = {
    "vtk-small-letters": (".vtk", VTK_HEAD + vtk_model(PENTAGON, POLYGONS, binary=False)[len(VTK_HEAD) :].lower()),
    "vtk-9-small-letters": (
        ".vtk",
        VTK_HEAD.replace(b"4.2", b"5.1")
        + vtk_model(PENTAGON, POLYGONS, binary=False, version="5.1")[len(VTK_HEAD) :].lower(),
    ),
    "vtk-points-of-int": (".vtk", replaced(vtk_model(PENTAGON, POLYGONS, binary=False), b"6 float", b"6 int")),
    "vtk-texts": (
        ".vtk",
        replaced(
            vtk_model(PENTAGON, POLYGONS),
            b"POINTS",
            b"FIELD FieldData 1\nSPACE 1 2 string\n\xc3LPS" + long_text(b"POINTS" * 20) + b"\nPOINTS",
        ),
    ),
    "vtk-notes-and-types": (
        ".vtk",
        replaced(
            vtk_model(PENTAGON, POLYGONS),
            b"POINTS",
            b"FIELD FieldData 3\nids 1 2 vtkIdType\n\0\0\0\1\0\0\0\2\nMETADATA\nCOMPONENT_NAMES\nid\n\n\n"
            b"INFORMATION 1\nNAME L2_NORM_RANGE LOCATION vtkDataArray\nDATA 2 0 1\n\nbig 1 1 vtktypeuint64\n"
            b"POLYGONS\nsmall 1 1 signed_char\n\x80\nMETADATA\nINFORMATION 0\n\nPOINTS",
        ),
    ),
    "ply-end-in-a-comment": (
        ".ply",
        replaced(ply_mixed(PENTAGON, POLYGONS), b"comment made", b"comment end_header\ncomment an end_header\ncomment"),
    ),
    "ply-comment-of-an-angstrom": (
        ".ply",
        replaced(ply_mixed(PENTAGON, POLYGONS), b"comment made", "comment by \u00c5sa, in \u00c5".encode()),
    ),
    "stl-byte-order-mark": (
        ".stl",
        "\ufeffsolid K\u00f6rper\r\n".encode() + stl_text(PENTAGON[FAN]).replace(b"\n", b"\r\n"),
    ),
    "stl-endless-name": (".stl", b"solid " + b"name " * 2000 + b"\n" + stl_text(PENTAGON[FAN])),
    "obj-curve": (
        ".obj",
        b"shadow_obj s.obj\ntrace_obj t.obj\nlod 3\nbevel on\nc_interp off\n" + obj_text(PENTAGON, POLYGONS)
        + b"v 1 1 1\nv 2 2 2\nv 3 3 3\nv 4 4 4\ncstype rat bspline\ndeg 1\ncurv 0.0 1.0 -4 -3\nparm u 0 0 1 1\nend\n"
        b"l 9 -1\np 9\n",
    ),
}  # fmt: skip


@pytest.mark.parametrize("kind", LEGAL)
def test_what_a_format_leaves_free_changes_nothing(tmp_path: Path, kind: str) -> None:
    """Letters, types, comments, names and lines without a surface, as their formats allow them."""
    assert same_triangles(read(tmp_path, *LEGAL[kind]), PENTAGON[FAN])


def test_gltf_nodes_place_their_meshes(tmp_path: Path) -> None:
    """A mesh used twice: once moved by its parent, once turned, scaled and mirrored, where the winding turns too."""
    nodes = [
        {"children": [1, 2], "translation": [100, 0, 0]},
        {"mesh": 0, "rotation": [0, 0, np.sqrt(0.5), np.sqrt(0.5)]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, -1, 0, 0, 0, 7, 1]},
    ]
    mesh = read(tmp_path, ".glb", glb(gltf_document(nodes=nodes), GLTF_BINARY))
    turned = [[100, 0, 0], [100, 10, 0], [80, 0, 0]]
    mirrored = [[100, 20, 7], [110, 0, 7], [100, 0, 7]]
    assert same_triangles(mesh, np.array([turned, mirrored], dtype=float))


def test_gltf_interleaved_positions_without_indices(tmp_path: Path) -> None:
    """Positions with a stride of 16 bytes and no indices are three corners per triangle."""
    rows = np.concatenate([TRIANGLE, np.full((3, 1), 99, "<f4")], axis=1).tobytes()
    document = gltf_document(
        meshes=[{"primitives": [{"attributes": {"POSITION": 0}}]}],
        bufferViews=[{"buffer": 0, "byteLength": 48, "byteStride": 16}],
        buffers=[{"byteLength": 48}],
    )
    mesh = read(tmp_path, ".glb", glb(document, rows))
    assert same_triangles(mesh, (TRIANGLE + np.float32([1, 2, 3]))[None].astype(float))


# ---- broken files --------------------------------------------------------------------------------------------------

STL = WHOLE["stl-binary"][1]
ASCII_STL = WHOLE["stl-ascii"][1]
OBJ = WHOLE["obj"][1]
PLY = WHOLE["ply-binary"][1]
ASCII_PLY = WHOLE["ply-ascii"][1]
GLB = WHOLE["glb"][1]
VTP = WHOLE["vtp-ascii"][1]
RAW_VTP = WHOLE["vtp-raw"][1]
VTK = vtk_model(PENTAGON, POLYGONS, binary=False)
NOISE = np.random.default_rng(7).integers(0, 256, 5000, dtype=np.uint8).tobytes()
NAN = struct.pack("<f", np.nan)


def patched(data: bytes, position: int, new: bytes) -> bytes:
    return data[:position] + new + data[position + len(new) :]


def broken_glb(**changes: Any) -> bytes:
    return glb(gltf_document(**changes), GLTF_BINARY)


def primitive(**changes: Any) -> list[dict[str, Any]]:
    return [{"primitives": [{"attributes": {"POSITION": 0}, "indices": 1} | changes]}]


def accessors(index: int, **changes: Any) -> list[dict[str, Any]]:
    both = gltf_document()["accessors"]
    both[index] |= changes
    return both


def ply_text(body: str, vertices: int = 3, faces: int = 1, extra: str = "") -> bytes:
    return f"""ply\nformat ascii 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z
element face {faces}\nproperty list uchar int vertex_indices\n{extra}end_header\n{body}""".encode()


CORNERS = "0 0 0\n9 0 0\n0 9 0\n"
OBJ_CORNERS = b"v 0 0 0\nv 9 0 0\nv 0 9 0\n"
BROKEN = [
    ("any-empty-file", ".stl", b"", "file_size"),
    ("any-unknown-ending", ".step", STL, "unknown_format"),
    ("stl-header-cut", ".stl", STL[:50], "file_cut"),
    ("stl-trailing-bytes", ".stl", STL + b"\0\0", "size_mismatch 4086"),
    ("stl-count-4-billion", ".stl", patched(STL, 80, b"\xff" * 4), "size_mismatch 4294967295"),
    ("stl-nan-vertex", ".stl", patched(STL, 84 + 12, NAN), "not_finite"),
    ("stl-all-zero", ".stl", patched(STL, 84, bytes(len(STL) - 84)), "implausible_size"),
    ("stl-ascii-without-end", ".stl", replaced(ASCII_STL, b"endsolid", b""), "file_cut"),
    ("stl-ascii-cut-but-closed", ".stl", ASCII_STL[:5000] + b"\nendsolid\n", "file_cut"),
    ("stl-ascii-misspelt", ".stl", replaced(ASCII_STL, b"vertex", b"vertx"), "unknown_line vertx"),
    ("stl-ascii-number-broken", ".stl", replaced(ASCII_STL, b"vertex ", b"vertex 1,5x"), "not_a_number"),
    ("stl-ascii-4-corners", ".stl", replaced(ASCII_STL, b"vertex ", b"vertex 0 0 0\nvertex "), "unknown_line"),
    ("stl-ascii-no-facet", ".stl", b"solid x facet\nendsolid x\n", "empty"),
    ("stl-ascii-two-solids", ".stl", ASCII_STL * 2, "several_solids"),
    ("ply-endless-word", ".ply", ply_text("0 " * 8 + "9" * 5000 + "\n3 0 1 2\n"), "word_too_long 5000"),
    ("stl-ascii-not-utf8", ".stl", replaced(ASCII_STL, b"loop", b"\xff\xfe"), "not_text"),
    ("obj-last-line-cut", ".obj", OBJ_CORNERS + b"f 1 2 3", "file_cut"),
    ("obj-faces-cut", ".obj", OBJ[: OBJ.index(b"\n", OBJ.index(b"\nf ") + 99) + 1], "unused_vertices"),
    ("obj-fewer-than-counted", ".obj", OBJ_CORNERS + b"# Faces: 2\nf 1 2 3\n", "size_mismatch"),
    ("obj-endless-count", ".obj", OBJ_CORNERS + b"# Faces: " + b"9" * 5000 + b"\nf 1 2 3\n", "size_mismatch inf"),
    ("obj-index-too-high", ".obj", OBJ_CORNERS + b"f 1 2 4\n", "index_out_of_range"),
    ("obj-index-zero", ".obj", OBJ_CORNERS + b"f 0 1 2\n", "index_out_of_range"),
    ("obj-index-too-negative", ".obj", OBJ_CORNERS + b"f -4 1 2\n", "index_out_of_range -4"),
    ("obj-index-no-number", ".obj", OBJ_CORNERS + b"f 1 2 x\n", "not_a_number"),
    ("obj-index-endless", ".obj", OBJ_CORNERS + b"f 1 2 " + b"9" * 5000 + b"\n", "not_a_number 999"),
    ("obj-two-corners", ".obj", OBJ_CORNERS + b"f 1 2\n", "wrong_count"),
    ("obj-two-coordinates", ".obj", b"v 1 2\n", "wrong_count"),
    ("obj-decimal-comma", ".obj", b"v 1,5 2 3\n", "not_a_number"),
    ("obj-only-vertices", ".obj", OBJ_CORNERS, "empty"),
    ("obj-binary-garbage", ".obj", NOISE, "not_text"),
    ("obj-free-form-surface", ".obj", OBJ_CORNERS + b"surf 0 1 0 1 1 2 3\n", "unknown_line surf"),
    ("ply-cut-in-the-middle", ".ply", PLY[: len(PLY) // 2], "file_cut"),
    ("ply-header-cut", ".ply", PLY[:60], "bad_header"),
    ("ply-trailing-bytes", ".ply", PLY + b"xyz", "size_mismatch"),
    ("ply-count-too-high", ".ply", replaced(PLY, b"face 80", b"face 81"), "file_cut"),
    ("ply-count-huge", ".ply", replaced(PLY, b"vertex 42", b"vertex 4294967295"), "file_cut 4294967295"),
    ("ply-count-beyond-reason", ".ply", replaced(PLY, b"vertex 42", b"vertex " + b"9" * 40), "bad_header"),
    ("ply-no-face", ".ply", ply_text(CORNERS, faces=0), "empty"),
    ("ply-only-points", ".ply", replaced(ply_text(CORNERS, faces=0), b"face", b"edge"), "bad_header"),
    ("ply-index-too-high", ".ply", ply_text(CORNERS + "3 0 1 3\n"), "index_out_of_range"),
    ("ply-index-fraction", ".ply", ply_text(CORNERS + "3 0 1 1.5\n"), "not_whole"),
    ("ply-two-corners", ".ply", ply_text(CORNERS + "2 0 1\n"), "wrong_count"),
    ("ply-negative-corners", ".ply", ply_text(CORNERS + "-3 0 1 2\n"), "out_of_range -3"),
    ("ply-word", ".ply", ply_text("zero 0 0\n9 0 0\n0 9 0\n3 0 1 2\n"), "not_a_number"),
    ("ply-ascii-last-line-missing", ".ply", ASCII_PLY.rstrip()[:-9] + b"\n", "file_cut"),
    ("ply-strips", ".ply", ply_text(CORNERS + "3 0 1 2\n3 0 1 2\n", extra="element tristrips 1\nproperty list int int"
     " vertex_indices\n"), "unsupported_feature"),
    ("ply-no-z", ".ply", replaced(ply_text(CORNERS + "3 0 1 2\n"), b"float z", b"float w"), "bad_header"),
    ("ply-unknown-type", ".ply", replaced(PLY, b"float x", b"quad x"), "unknown_type quad"),
    ("ply-unknown-format", ".ply", replaced(PLY, b"binary_little_endian", b"zipped"), "unsupported_feature zipped"),
    ("glb-cut-in-the-middle", ".glb", GLB[: len(GLB) // 2], "size_mismatch"),
    ("glb-chunk-too-long", ".glb", patched(GLB, 12, b"\xff\xff\xff\x7f"), "file_cut"),
    ("glb-version-1", ".glb", patched(GLB, 4, b"\1"), "wrong_format"),
    ("glb-json-broken", ".glb", patched(GLB, 20, b"x"), "not_json"),
    ("glb-json-of-another-kind", ".glb", glb({"a": 1}, b""), "bad_value asset missing"),
    ("glb-mesh-without-node", ".glb", broken_glb(nodes=[{}]), "mesh_not_placed"),
    ("glb-mesh-outside-of-scene", ".glb", broken_glb(scenes=[{"nodes": []}]), "mesh_not_placed"),
    ("glb-node-missing", ".glb", broken_glb(scenes=[{"nodes": [0, 5]}]), "not_a_tree"),
    ("glb-node-cycle", ".glb", broken_glb(nodes=[{"mesh": 0, "children": [0]}]), "not_a_tree"),
    ("glb-two-scenes", ".glb", broken_glb(scene=None, scenes=[{}, {}]), "several_scenes"),
    ("glb-zero-scale", ".glb", broken_glb(nodes=[{"mesh": 0, "scale": [1, 1, 0]}]), "not_invertible"),
    ("glb-nan-matrix", ".glb", broken_glb(nodes=[{"mesh": 0, "matrix": [float("nan")] * 16}]), "not_json"),
    ("glb-index-out-of-range", ".glb", glb(gltf_document(), GLTF_BINARY[:-2] + b"\3\0"), "index_out_of_range"),
    ("glb-nan-vertex", ".glb", glb(gltf_document(), NAN + GLTF_BINARY[4:]), "not_finite"),
    ("glb-accessor-too-long", ".glb", broken_glb(accessors=accessors(0, count=4)), "size_mismatch 48"),
    ("glb-accessor-huge", ".glb", broken_glb(accessors=accessors(1, count=2**39)), "too_many"),
    ("glb-accessor-sparse", ".glb", broken_glb(accessors=accessors(0, sparse={})), "unsupported_feature"),
    ("glb-accessor-missing", ".glb", broken_glb(meshes=primitive(indices=9)), "index_out_of_range"),
    ("glb-indices-of-floats", ".glb", broken_glb(accessors=accessors(1, componentType=5126)), "wrong_type 5126"),
    ("glb-positions-of-2", ".glb", broken_glb(accessors=accessors(0, type="VEC2")), "wrong_type 5126 VEC2"),
    ("glb-view-beyond-buffer", ".glb", broken_glb(buffers=[{"byteLength": 40}]), "size_mismatch 42"),
    ("glb-buffer-beyond-file", ".glb", broken_glb(buffers=[{"byteLength": 99}]), "size_mismatch 99"),
    ("glb-lines", ".glb", broken_glb(meshes=primitive(mode=1)), "unsupported_feature"),
    ("glb-without-position", ".glb", broken_glb(meshes=primitive(attributes={})), "unsupported_feature"),
    ("glb-morph-targets", ".glb", broken_glb(meshes=primitive(targets=[{"POSITION": 0}])), "unsupported_feature"),
    ("glb-skinned", ".glb", broken_glb(nodes=[{"mesh": 0, "skin": 0}]), "unsupported_feature"),
    ("glb-draco", ".glb", broken_glb(extensionsRequired=["KHR_draco_mesh_compression"]), "unsupported_feature"),
    ("glb-reads-other-files", ".glb", broken_glb(buffers=[{"byteLength": 42, "uri": "x.bin"}]), "data_elsewhere"),
    ("vtp-raw-cut", ".vtp", RAW_VTP[: len(RAW_VTP) * 3 // 4], "file_cut"),
    ("vtp-raw-bytes-missing", ".vtp", RAW_VTP[:-300] + RAW_VTP[-40:], "file_cut"),
    ("vtp-garbage", ".vtp", NOISE, "xml_damaged"),
    ("vtp-other-xml", ".vtp", b"<svg/>", "wrong_format"),
    ("vtp-other-vtk", ".vtp", replaced(VTP, b'"PolyData"', b'"ImageData"'), "wrong_format ImageData"),
    ("vtp-no-polygon", ".vtp", vtp(PENTAGON, POLYGONS, n_polys="0"), "empty"),
    ("vtp-strips-missing", ".vtp", vtp(PENTAGON, POLYGONS, n_strips="2"), "wrong_count Strips"),
    ("vtp-points-too-many", ".vtp", vtp(PENTAGON, POLYGONS, n_points="7"), "size_mismatch 18 21"),
    ("vtp-points-huge", ".vtp", vtp(PENTAGON, POLYGONS, n_points="99999999999"), "too_many 99999999999"),
    ("vtp-polygons-too-many", ".vtp", vtp(PENTAGON, POLYGONS, "raw", n_polys="4"), "size_mismatch 24 32"),
    ("vtp-points-negative", ".vtp", vtp(PENTAGON, POLYGONS, n_points="-6"), "not_whole -6"),
    ("vtp-index-too-high", ".vtp", vtp(PENTAGON, [[0, 1, 6]]), "index_out_of_range"),
    ("vtp-two-corners", ".vtp", vtp(PENTAGON, [[0, 1, 2], [0, 1]]), "bad_offsets"),
    ("vtp-word", ".vtp", replaced(vtp(PENTAGON, POLYGONS), b"15.0 10.0", b"wide 1"), "not_a_number float64"),
    ("vtp-two-components", ".vtp", replaced(VTP, b'Components="3"', b'Components="2"'), "wrong_shape"),
    ("vtp-float-indices", ".vtp", replaced(VTP, b'"Int64" Name="conn', b'"Float64" Name="conn'), "wrong_type float64"),
    ("vtp-no-connectivity", ".vtp", replaced(VTP, b"connectivity", b"something"), "wrong_count Polys"),
    ("vtp-unknown-order", ".vtp", replaced(VTP, b"LittleEndian", b"MiddleEndian"), "unsupported_feature MiddleEndian"),
    ("vtp-offset-beyond", ".vtp", replaced(RAW_VTP, b'offset="0"', b'offset="9"').replace(
        b'Float64" Name="Points" NumberOfComponents="3" format="appended" offset="', b'Float64" Name="Points" '
        b'NumberOfComponents="3" format="appended" offset="99999'), "index_out_of_range"),
    ("vtp-lz4", ".vtp", replaced(WHOLE["vtp-raw-zlib"][1], b"vtkZLib", b"vtkLZ4"), "unsupported_feature vtkLZ4Data"),
    ("vtp-base64-damaged", ".vtp", replaced(WHOLE["vtp-base64"][1], b" _", b" _@@"), "file_damaged"),
    ("vtp-zlib-damaged", ".vtp", WHOLE["vtp-raw-zlib"][1].replace(b"x\x9c", b"x\x9d"), "file_damaged"),
    ("vtp-space", ".vtp", replaced(VTP, b"<PolyData>", b'<PolyData><FieldData><Array type="String" Name="SPACE" '
        b'NumberOfTuples="1" format="ascii">82 65 73 0</Array></FieldData>'), "unknown_space RAI"),
    ("vtk-no-header", ".vtk", VTK[1:], "wrong_format"),
    ("vtk-grid", ".vtk", replaced(VTK, b"POLYDATA", b"UNSTRUCTURED_GRID"), "wrong_format"),
    ("vtk-other-form", ".vtk", replaced(VTK, b"ASCII", b"UTF-8"), "wrong_format"),
    ("vtk-fewer-points", ".vtk", replaced(VTK, b"POINTS 6", b"POINTS 7"), "not_a_number"),
    ("vtk-more-points", ".vtk", replaced(VTK, b"POINTS 6", b"POINTS 4"), "size_mismatch 18 12"),
    ("vtk-huge", ".vtk", replaced(VTK, b"POINTS 6", b"POINTS 999999999999"), "out_of_range 999999999999"),
    ("vtk-points-of-words", ".vtk", replaced(VTK, b"6 float", b"6 string"), "unknown_type"),
    ("vtk-points-of-int", ".vtk", replaced(replaced(VTK, b"6 float", b"6 int"), b"15 10", b"15 10.5"), "not_a_number"),
    ("vtk-word", ".vtk", replaced(VTK, b"15 10", b"wide 1"), "not_a_number"),
    ("vtk-index-too-high", ".vtk", vtk_model(PENTAGON, [[0, 1, 6]]), "index_out_of_range"),
    ("vtk-two-corners", ".vtk", vtk_model(PENTAGON, [[0, 1, 2], [0, 1]]), "wrong_count"),
    ("vtk-cells-too-many", ".vtk", replaced(VTK, b"POLYGONS 3 15", b"POLYGONS 4 15"), "file_cut"),
    ("vtk-cells-too-few", ".vtk", replaced(VTK, b"POLYGONS 3 15", b"POLYGONS 2 15"), "size_mismatch 10"),
    ("vtk-strip-of-two-corners", ".vtk", replaced(vtk_model(PENTAGON, [[0, 1, 2], [0, 1]], binary=False), b"POLYGONS",
     b"TRIANGLE_STRIPS"), "wrong_count"),
    ("vtk-text-cut", ".vtk", vtk_model(PENTAGON, POLYGONS, extra="FIELD FieldData 1\nName 1 1 string\n?"), "file_cut"),
    ("vtk-9-offsets", ".vtk", vtk_model(PENTAGON, [[0, 1, 2], [], [3, 4, 5]], version="5.1"), "bad_offsets"),
    ("vtk-unknown-line", ".vtk", vtk_model(PENTAGON, POLYGONS, extra="SURPRISE 1\n"), "unknown_line SURPRISE"),
    ("vtp-entities", ".vtp", replaced(VTP, b"<VTKFile", b'<!DOCTYPE x [<!ENTITY a "b">]><VTKFile'), "xml_doctype"),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "data", "says"), [pytest.param(*case[1:], id=case[0]) for case in BROKEN])
def test_a_broken_file_is_refused_in_one_line(tmp_path: Path, suffix: str, data: bytes, says: str) -> None:
    with refused(*says.split(), tmp_path / f"mesh{suffix}"):
        read(tmp_path, suffix, data)


def test_a_missing_file_and_a_directory_are_refused(tmp_path: Path) -> None:
    (tmp_path / "folder.stl").mkdir()
    for name, code in (("liver.stl", "no_such_file"), ("folder.stl", "not_a_file"), ("a\0b.stl", "no_such_file")):
        with refused(code):
            read_mesh(tmp_path / name, unit=Unit.MM, space=Space.LPS)


def test_a_mesh_placed_too_often_is_refused_before_it_is_built(tmp_path: Path) -> None:
    """A small file with a million places for one long accessor is refused by arithmetic."""
    nodes = [{"mesh": 0}] * 1000
    long = accessors(1, count=3 * 30_000)
    document = gltf_document(nodes=nodes, scenes=[{"nodes": list(range(1000))}], accessors=long)
    with refused("too_many", "30000000"):
        read(tmp_path, ".glb", glb(document, GLTF_BINARY))


# ---- cut files -----------------------------------------------------------------------------------------------------


def mesh_or_refusal(folder: Path, suffix: str, data: bytes) -> TriangleMesh | None:
    try:
        return read(folder, suffix, data)
    except InputError:
        return None


@pytest.mark.parametrize("kind", WHOLE)
def test_a_cut_file_is_refused_or_has_lost_nothing(tmp_path: Path, kind: str) -> None:
    """Changed bytes are for the fuzzer."""
    random = Random(kind)
    suffix, whole = WHOLE[kind]
    for _ in range(40):
        cut = whole[: random.randrange(len(whole))]
        if kind == "obj" and cut.endswith(b"\n"):  # tested below
            cut = cut[:-1]
        mesh = mesh_or_refusal(tmp_path, suffix, cut)
        assert mesh is None or same_triangles(mesh, BALL.triangles)


def test_an_obj_cut_at_a_line_end_is_open_where_it_is_not_refused(tmp_path: Path) -> None:
    """OBJ has no counts: cut between face lines, a ball is refused or at least is told to be open."""
    lines = OBJ.splitlines(keepends=True)
    seen = set()
    for n_lines in range(len(lines) - 40, len(lines)):
        mesh = mesh_or_refusal(tmp_path, ".obj", b"".join(lines[:n_lines]))
        seen.add(mesh is None)
        if mesh is not None:
            cut = len(mesh.faces) < len(BALL.faces)
            assert cut == any("open mesh" in warning for warning in mesh_warnings(mesh, "ball"))
    assert False in seen


# ---- warnings and real data ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("change", "says"),
    [
        pytest.param(lambda faces: faces[1:], "open mesh: only the distance to its surface is known", id="open"),
        pytest.param(lambda faces: faces[:, ::-1], "inverted normals", id="inverted"),
        pytest.param(lambda f: np.vstack([f[:9, ::-1], f[9:]]), "wound against their neighbours", id="mixed"),
        pytest.param(lambda f: np.vstack([f, [[0, 0, 1]]]), "1 of 81 triangles have no area", id="no-area"),
    ],
)
def test_unusual_meshes_work_with_a_warning(change: Callable[[np.ndarray], np.ndarray], says: str) -> None:
    """Common in real anatomy: they pass, and exactly one sentence says what cannot be known."""
    mesh = guard_mesh(BALL.vertices, change(BALL.faces), where="ball")
    (warning,) = mesh_warnings(mesh, "liver")
    assert warning.startswith("liver: ") and says in warning


def test_what_is_kept_of_meshes_is_what_they_warn_of(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Sentences or none, in the order of the meshes; found again for other names and other triangles alone."""
    whole, cut = (guard_mesh(BALL.vertices, BALL.faces[left_out:], where="ball") for left_out in (0, 1))
    meshes, cache = {"liver": cut, "spleen": whole, "aorta": cut}, Cache(tmp_path)
    expected = (*mesh_warnings(cut, "liver"), *mesh_warnings(cut, "aorta"))
    assert len(expected) == 2
    found: list[str] = []

    def counted(mesh: TriangleMesh, name: str) -> tuple[str, ...]:
        found.append(name)
        return mesh_warnings(mesh, name)

    monkeypatch.setattr(sys.modules[cached_mesh_warnings.__module__], "mesh_warnings", counted)
    assert cached_mesh_warnings(meshes, cache) == cached_mesh_warnings(meshes, cache) == expected
    assert cached_mesh_warnings({"a": whole}, cache) == cached_mesh_warnings({"a": whole}, cache) == ()
    assert cached_mesh_warnings({**meshes, "spleen": cut}, cache) != expected
    assert found == ["liver", "spleen", "aorta", "a", "liver", "spleen", "aorta"]


@pytest.mark.skipif(not VH_MALE.is_dir(), reason="the hubmap_vh_male set is not on this machine")
def test_all_visible_human_organs_read_as_trimesh_reads_them() -> None:
    """Same number of triangles, same set of triangle centres with all node transforms applied, to 0.01 mm."""
    paths = sorted(VH_MALE.glob("*.glb"))
    assert len(paths) == 12
    for path in paths:
        mesh = read_mesh(path, unit=Unit.M, space=Space.LOCAL, up=Up.Z)
        other = trimesh.load_scene(path, process=False, skip_materials=True).to_mesh()
        assert len(mesh.faces) == len(other.faces), path.name
        ours, theirs = mesh.triangles.mean(axis=1), other.triangles.mean(axis=1) * 1000.0
        distance, _ = cKDTree(ours).query(theirs)
        assert distance.max() < 0.01, path.name
        if "Skin" in path.name:
            assert mesh.closed and mesh_warnings(mesh, "skin") == ()
