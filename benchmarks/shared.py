"""What the benchmarks share: the real CT beside its case, versions, time of one thread, and bodies of many surfaces."""

import argparse
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from puncture_twin import meshes
from puncture_twin.planning.case.entry import grid
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.context import prepare

REPOSITORY = Path(__file__).resolve().parents[1]
DATA = REPOSITORY.parent / "shared" / "data"
REAL_CT = DATA / "totalseg_abdomen_3mm"


def options(doc: str | None, **defaults: Any) -> argparse.Namespace:
    """Options of the command line by their defaults: False for a switch, a type for what has none."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    for name, default in defaults.items():
        how = {"type": default} if isinstance(default, type) else {"type": type(default), "default": default}
        parser.add_argument(f"--{name}", **({"action": "store_true"} if default is False else how))
    return parser.parse_args()


def real_ct(folder: Path) -> bool:
    """Lay the real CT beside its cases, ``case_v1.toml`` and ``case_v2.toml``; False where it is not here."""
    if not REAL_CT.is_dir():
        print(f"the real CT is not on this machine ({REAL_CT.name})")
        return False
    for file in (REPOSITORY / "tests" / "real").iterdir():
        shutil.copy(file, folder)
    for file in REAL_CT.glob("*.nii.gz"):
        (folder / file.name).symlink_to(file)
    return True


def versions(*names: str) -> str:
    """The machine, Python, and what is named of its packages."""
    found = [platform.machine(), f"Python {platform.python_version()}"]
    for name in names:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"{name} not installed")
    return ", ".join(found)


def took(work: Callable[[], object]) -> float:
    """Time of this thread on the processor, s: others share the machine."""
    start = time.thread_time()
    work()
    return time.thread_time() - start


def least_seconds(work: Callable[[], object], repeats: int) -> float:
    """The least processor time of this thread over some repeats, s; a first one, which compiles, is not counted."""
    work()
    return min(took(work) for _ in range(repeats))


@dataclass(frozen=True, eq=False)
class Scene:
    """Surfaces and a target amid them, mm; thresholds (k,) are the needle's radius plus a margin."""

    name: str
    meshes: tuple[TriangleMesh, ...]
    target: np.ndarray
    R_ct_entry: np.ndarray
    thresholds: np.ndarray
    length: float = 210.0

    @property
    def triangles(self) -> int:
        """Of all surfaces."""
        return sum(len(mesh.faces) for mesh in self.meshes)

    def hemisphere(self, step_deg: float) -> np.ndarray:
        """Directions up to 90° from the entry frame's z, shape (n, 3)."""
        return grid((0, np.pi / 2), (0, 2 * np.pi), np.radians(step_deg), self.R_ct_entry).outward_ct


def scenes(named: str) -> Iterator[Scene]:
    """Every scene whose data is on this machine and whose name holds a word."""
    with tempfile.TemporaryDirectory() as name:
        makers: dict[str, Callable[[], Scene]] = {"abdomen phantom": lambda: _case(meshes.folder() / "abdomen")}
        if real_ct(Path(name)):
            for labels in ("v1", "v2"):
                makers[f"real CT, labels {labels}"] = lambda labels=labels: _case(Path(name) / f"case_{labels}.toml")
        if (DATA / "hubmap_vh_male").is_dir():
            makers["hubmap"] = hubmap
        makers["dense synthetic"] = dense
        for title, make in makers.items():
            if named in title:
                made = make()
                yield Scene(title, made.meshes, made.target, made.R_ct_entry, made.thresholds, made.length)


def _case(path: Path) -> Scene:
    context = prepare(path, arm=False)
    case, structures = context.case, context.anatomy.structures
    radius = case.needle.radius_mm
    thresholds = np.array([radius + s.margin_mm if s.demands_margin else -np.inf for s in structures])
    surfaces = tuple(s.mesh for s in structures)
    return Scene("", surfaces, case.target_ct, case.T_ct_entry[:3, :3], thresholds, case.needle.length_mm)


def hubmap() -> Scene:
    """Visible Human organs: many parts, mostly open; the target amid the liver's box."""
    surfaces = {}
    for file in sorted((DATA / "hubmap_vh_male").glob("*.glb")):
        if "Skin" not in file.name:
            loaded = trimesh.load(file, force="mesh", process=False)
            surfaces[file.stem] = TriangleMesh(np.asarray(loaded.vertices) * 1000.0, np.asarray(loaded.faces))
    target = surfaces["VH_M_Liver"].bounds.mean(axis=0) + [-20.0, 5.0, 7.0]
    R = np.stack([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]], axis=1)
    return Scene("", tuple(surfaces.values()), target, R, np.full(len(surfaces), 3.6))


def dense(rows: int = 283) -> Scene:
    """Five bumpy organs around the target, of 2 x ``rows`` x ``rows`` triangles each (160,000: 800k in all)."""
    rng, surfaces = np.random.default_rng(5), []
    steps = np.linspace(0, 1, rows + 1)
    organs = {(60, 10, 40): 28, (-55, 30, 50): 30, (10, -70, 30): 25, (0, 40, 90): 24, (20, 0, -60): 35}
    for center, radius in organs.items():
        theta, beta = (angle.ravel() for angle in np.meshgrid(np.pi * steps, 2 * np.pi * steps, indexing="ij"))
        u = np.stack([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)], axis=-1)
        waves = rng.normal(0, 5, (12, 3))
        bumps = 1 + 0.03 * np.sin(u @ waves.T + rng.uniform(0, 6, 12)).sum(axis=1)
        row = rows + 1
        i = (np.arange(rows)[:, None] * row + np.arange(rows)).ravel()
        faces = np.concatenate([np.stack([i, i + row, i + 1], 1), np.stack([i + 1, i + row, i + row + 1], 1)])
        surfaces.append(TriangleMesh(np.asarray(center) + radius * bumps[:, None] * u, faces))
    return Scene("", tuple(surfaces), np.zeros(3), np.eye(3), np.full(5, 3.6))
