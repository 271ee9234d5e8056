"""Writes the embedded cases' meshes and point lists, and the manifest that says how each was made."""

from __future__ import annotations

import hashlib
import json
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from tools.phantoms import abdomen, carton, guidance, head

_COMMAND = "python -m tools.phantoms --out DIR"
_LICENCE = "Apache-2.0"
_PAPER = "DOI 10.7652/xjtuxb201904013"


def ply_bytes(mesh: TriangleMesh) -> bytes:
    """A mesh as a little-endian binary PLY: float32 vertices, int32 faces."""
    header = (
        "ply\nformat binary_little_endian 1.0\n"
        f"element vertex {len(mesh.vertices)}\nproperty float x\nproperty float y\nproperty float z\n"
        f"element face {len(mesh.faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    faces = np.empty(len(mesh.faces), dtype=[("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.faces
    return header.encode("ascii") + mesh.vertices.astype("<f4").tobytes() + faces.tobytes()


def write_phantoms(folder: Path, report: Callable[[str], None] = lambda _: None) -> None:
    """Write every mesh and point list below ``folder``, and the manifest last; case files are left alone.

    Everything is made in a folder beside it first, so that a failure leaves what was there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(prefix=".phantoms-", dir=folder.resolve().parent) as scratch:
        staging = Path(scratch)
        entries = []
        for entry, data in (*_carton_files(), *_abdomen_files(), *_head_files()):
            target = staging / str(entry["path"])
            target.parent.mkdir(exist_ok=True)
            target.write_bytes(data)
            entries.append({**entry, "bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()})
            report(f"{entry['path']}: {entry.get('triangles', '-')} triangles, {len(data)} bytes")
        manifest = {"schema": 1, "command": _COMMAND, "licence": _LICENCE, "files": entries}
        (staging / "manifest.json").write_text(json.dumps(manifest, indent=1) + "\n", encoding="utf-8")
        for path in [str(entry["path"]) for entry in entries] + ["manifest.json"]:
            (folder / path).parent.mkdir(exist_ok=True)
            (staging / path).replace(folder / path)


def points_csv(points: dict[str, Floats], decimals: int, joints_deg: dict[str, Floats] | None = None) -> bytes:
    """Named points as CSV: name, x_mm, y_mm, z_mm, and how the robot stood at each, where that is known."""
    header = ["name", "x_mm", "y_mm", "z_mm", *(f"q{n}_deg" for n in range(1, 7) if joints_deg is not None)]
    angles = {name: np.empty(0) for name in points} if joints_deg is None else joints_deg
    rows = [
        ",".join([name, *(f"{v:.{decimals}f}" for v in point), *(f"{v:.4f}" for v in angles[name])])
        for name, point in points.items()
    ]
    return ("\n".join([",".join(header), *rows]) + "\n").encode("ascii")


def _entry(path: str, space: str, made_by: str, parameters: dict[str, Any]) -> dict[str, Any]:
    where = {"path": path, "unit": "mm", "space": space}
    return {**where, "licence": _LICENCE, "made_by": made_by, "parameters": parameters}


def _carton_files() -> list[tuple[dict[str, Any], bytes]]:
    files = []
    for name, mesh in carton.carton_meshes().items():
        entry = _entry(f"carton/{name}.ply", "local", "tools.phantoms.carton.carton_meshes", {"structure": name})
        files.append(({**entry, "triangles": len(mesh.faces)}, ply_bytes(mesh)))
    touched = carton.TOUCHED_BASE_MM
    markers = {name: touched[name] for name in carton.MARKERS_CT_MM}
    again = carton.TOUCHED_SETUP_2_BASE_MM
    markers_again = {name: again[name] for name in carton.SETUP_2_MARKERS}
    for name, space, points, source in (
        ("markers_ct.csv", "local", carton.MARKERS_CT_MM, "Table 1"),
        ("touch.csv", "base", markers, "Table 2"),
        ("truth.csv", "base", touched, "Table 2"),
        ("setup2_markers_ct.csv", "local", carton.SETUP_2_MARKERS, "Table 1"),
        ("setup2_touch.csv", "base", markers_again, "Table 4"),
        ("setup2_truth.csv", "base", again, "Table 4"),
    ):
        entry = _entry(f"carton/{name}", space, "tools.phantoms.carton", {"source": f"{_PAPER}, {source}"})
        files.append((entry, points_csv({key: np.array(value) for key, value in points.items()}, 2)))
    return files


def _abdomen_files() -> list[tuple[dict[str, Any], bytes]]:
    files = []
    for name, part in abdomen.STRUCTURES.items():
        mesh = abdomen.abdomen_mesh(name)
        parameters = {"structure": name, "spacing_mm": part.spacing_mm}
        entry = _entry(f"abdomen/{name}.ply", "LPS", "tools.phantoms.abdomen.abdomen_mesh", parameters)
        files.append(({**entry, "triangles": len(mesh.faces)}, ply_bytes(mesh)))
    seed = guidance.GUIDANCE_SEED
    known = guidance.abdomen_guidance(np.random.default_rng(seed))
    for name, space, points, decimals, joints in (
        ("markers_ct.csv", "LPS", known.markers_ct, 3, None),
        ("touch.csv", "base", known.touched_base, 3, known.joints_deg),
        ("truth.csv", "base", known.truth_base, 6, None),
    ):
        entry = _entry(f"abdomen/{name}", space, "tools.phantoms.guidance.abdomen_guidance", {"seed": seed})
        files.append((entry, points_csv(points, decimals, joints)))
    return files


def _head_files() -> list[tuple[dict[str, Any], bytes]]:
    mesh = head.head_mesh()
    parameters = {"structure": "head", "spacing_mm": head.SPACING_MM}
    entry = _entry("head/head.ply", "local", "tools.phantoms.head.head_mesh", parameters)
    files = [({**entry, "triangles": len(mesh.faces)}, ply_bytes(mesh))]
    markers = {name: np.array(point) for name, point in head.MARKERS_MM.items()}
    for file, source, points in (("markers", "MARKERS_MM", markers), ("targets", "head_targets", head.head_targets())):
        entry = _entry(f"head/{file}.csv", "local", f"tools.phantoms.head.{source}", {})
        files.append((entry, points_csv(points, 3)))
    return files
