"""The embedded meshes are the files that the manifest describes."""

import hashlib
import json
import tomllib

import numpy as np
import pytest
import trimesh

from puncture_twin import meshes
from tools.phantoms.abdomen import STRUCTURES
from tools.phantoms.carton import carton_meshes
from tools.phantoms.manifest import ply_bytes, points_csv

FOLDER = meshes.folder()
MANIFEST = json.loads((FOLDER / "manifest.json").read_text(encoding="utf-8"))
FILES = {entry["path"]: entry for entry in MANIFEST["files"]}
MESH_PATHS = [path for path in FILES if path.endswith(".ply")]
CASES = sorted(FOLDER.glob("*/case*.toml"))
BYTES_AT_MOST = 15_000_000


def test_every_made_file_is_listed_and_every_listed_file_is_there():
    """Meshes and point lists are all in the manifest, and nothing else is; the cases are where the package says."""
    assert [path.stem for path in CASES] == ["case", "case_h", "case_l", "case_m", "case_m_setup2"]
    made = {path.relative_to(FOLDER).as_posix() for kind in ("ply", "csv") for path in FOLDER.glob(f"*/*.{kind}")}
    assert made == set(FILES)


@pytest.mark.parametrize("path", FILES)
def test_file_has_the_stated_hash_unit_and_licence(path):
    """The hash is that of the file's bytes; unit, space, maker and licence are stated."""
    entry, data = FILES[path], (FOLDER / path).read_bytes()
    assert hashlib.sha256(data).hexdigest() == entry["sha256"] and len(data) == entry["bytes"]
    assert entry["unit"] == "mm" and entry["space"] in {"LPS", "local", "base"}
    assert entry["made_by"].startswith("tools.phantoms.") and entry["licence"] == "Apache-2.0"


@pytest.mark.parametrize("path", MESH_PATHS)
def test_mesh_is_binary_float32_with_the_stated_triangles(path):
    """The PLY holds float32 vertices and int32 faces, as many as the manifest says, and not a byte more."""
    data = (FOLDER / path).read_bytes()
    header, body = data.split(b"end_header\n", 1)
    words = header.decode("ascii").split()
    vertices, triangles = int(words[words.index("vertex") + 1]), int(words[words.index("face") + 1])
    assert "binary_little_endian" in words
    assert triangles == FILES[path]["triangles"]
    assert len(body) == vertices * 12 + triangles * 13


def test_the_abdomen_is_large_enough_and_the_whole_small_enough():
    """At least 12 structures and 200,000 triangles, at most 330,000; all files together at most 15 MB.

    No structure of the phantom is left out of its case: a forgotten organ would look like free space.
    """
    content = tomllib.loads((FOLDER / "abdomen/case.toml").read_text(encoding="utf-8"))
    assert {structure["name"] for structure in content["structure"]} == set(STRUCTURES)
    counts = [FILES[f"abdomen/{name}.ply"]["triangles"] for name in STRUCTURES]
    assert len(counts) >= 12
    assert 200_000 <= sum(counts) <= 330_000
    assert sum(path.stat().st_size for path in FOLDER.rglob("*") if path.suffix != ".pyc") <= BYTES_AT_MOST


@pytest.mark.parametrize("case", CASES, ids=lambda path: f"{path.parent.name}/{path.stem}")
def test_case_names_only_files_of_the_manifest(case):
    """Every mesh and point list that a case names is a listed file beside it, in the case's space and in mm."""
    content = tomllib.loads(case.read_text(encoding="utf-8"))
    folder = case.parent.name
    for structure in content["structure"]:
        entry = FILES[f"{folder}/{structure['mesh']}"]
        assert entry["space"] == content["space"]
        assert entry["unit"] == structure["unit"]
        assert structure["role"] != "avoid" or structure["margin_mm"] > 0
    assert FILES[f"{folder}/{content['registration']['markers_ct']}"]["space"] == content["space"]
    assert FILES[f"{folder}/{content['registration']['markers_base']}"]["space"] == "base"
    assert FILES[f"{folder}/{content['rehearsal']['truth_base']}"]["space"] == "base"


def test_ply_reads_back_as_written():
    """Another reader finds the same triangles, to float32."""
    mesh = carton_meshes()["bolt_l"]
    read = trimesh.load(trimesh.util.wrap_as_stream(ply_bytes(mesh)), file_type="ply", process=False)
    assert np.array_equal(read.faces, mesh.faces)
    assert np.array_equal(np.asarray(read.vertices, dtype=np.float32), mesh.vertices.astype(np.float32))


def test_points_are_written_with_names_and_fixed_decimals():
    """The point lists have one header and one row for each name."""
    assert points_csv({"A": np.array([1.0, -2.5, 3.0])}, 3) == b"name,x_mm,y_mm,z_mm\nA,1.000,-2.500,3.000\n"
