"""The bodies that the benchmark measures: meshes, target, needle length, directions and thresholds."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from puncture_twin import meshes
from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.context import prepare

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data"
LENGTH_MM = 210.0


@dataclass(frozen=True, eq=False)
class Scene:
    """Surfaces and a target amid them; mm.

    Attributes:
        R_ct_entry: Shape (3, 3), the entry frame, for the grid of directions.
        thresholds: Shape (k,), needle radius plus margin.
    """

    name: str
    meshes: tuple[TriangleMesh, ...]
    target: np.ndarray
    R_ct_entry: np.ndarray
    thresholds: np.ndarray
    length: float = LENGTH_MM

    @property
    def triangles(self) -> int:
        """Of all surfaces."""
        return sum(len(mesh.faces) for mesh in self.meshes)

    def hemisphere(self, step_deg: float) -> np.ndarray:
        """Directions up to 90° from the entry frame's z, shape (n, 3)."""
        return grid((0, np.pi / 2), (0, 2 * np.pi), np.radians(step_deg), self.R_ct_entry).outward_ct


def scenes() -> Iterator[Scene]:
    """Every scene whose data is on this machine."""
    yield _case("abdomen phantom", meshes.folder() / "abdomen")
    if (DATA / "totalseg_abdomen_3mm").is_dir():
        with tempfile.TemporaryDirectory() as folder:
            for file in (REPOSITORY / "tests" / "real").iterdir():
                shutil.copy(file, folder)
            for file in (DATA / "totalseg_abdomen_3mm").glob("*.nii.gz"):
                (Path(folder) / file.name).symlink_to(file)
            for version in ("v1", "v2"):
                yield _case(f"real CT, labels {version}", Path(folder) / f"case_{version}.toml")
    if (DATA / "hubmap_vh_male").is_dir():
        yield hubmap()
    yield dense()


def _case(name: str, path: Path) -> Scene:
    context = prepare(path, arm=False)
    case, structures = context.case, context.anatomy.structures
    radius = case.needle.radius_mm
    thresholds = np.array([radius + s.margin_mm if s.demands_margin else -np.inf for s in structures])
    surfaces = tuple(s.mesh for s in structures)
    return Scene(name, surfaces, case.target_ct, case.T_ct_entry[:3, :3], thresholds, case.needle.length_mm)


def hubmap() -> Scene:
    """Visible Human organs: many parts, mostly open; the target amid the liver's box."""
    surfaces = []
    for file in sorted((DATA / "hubmap_vh_male").glob("*.glb")):
        if "Skin" in file.name:
            continue
        loaded = trimesh.load(file, force="mesh", process=False)
        surfaces.append((file.stem, TriangleMesh(np.asarray(loaded.vertices) * 1000.0, np.asarray(loaded.faces))))
    liver = dict(surfaces)["VH_M_Liver"]
    target = liver.bounds.mean(axis=0) + [-20.0, 5.0, 7.0]
    R = np.stack([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], axis=1)
    only = tuple(mesh for _, mesh in surfaces)
    return Scene("hubmap", only, target, R, np.full(len(only), 3.6))


def dense(rows: int = 283) -> Scene:
    """Five bumpy organs around the target, of 2 x ``rows`` x ``rows`` triangles each (160,000: 800k in all)."""
    rng, surfaces = np.random.default_rng(5), []
    steps = np.linspace(0, 1, rows + 1)
    for center, radius in (
        ((60, 10, 40), 28),
        ((-55, 30, 50), 30),
        ((10, -70, 30), 25),
        ((0, 40, 90), 24),
        ((20, 0, -60), 35),
    ):
        theta, beta = np.meshgrid(np.pi * steps, 2 * np.pi * steps, indexing="ij")
        u = np.stack([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)], axis=-1).reshape(
            -1, 3
        )
        waves = rng.normal(0, 5, (12, 3))
        bumps = 1 + 0.03 * np.sin(u @ waves.T + rng.uniform(0, 6, 12)).sum(axis=1)
        row = rows + 1
        i = (np.arange(rows)[:, None] * row + np.arange(rows)).ravel()
        faces = np.concatenate([np.stack([i, i + row, i + 1], 1), np.stack([i + 1, i + row, i + row + 1], 1)])
        surfaces.append(TriangleMesh(np.asarray(center) + radius * bumps[:, None] * u, faces))
    return Scene("dense synthetic", tuple(surfaces), np.zeros(3), np.eye(3), np.full(5, 3.6))
