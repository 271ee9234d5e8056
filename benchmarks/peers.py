"""What others take for the same question, or for the nearest that they answer.

``python benchmarks/peers.py`` prints them side by side. Coal and VTK (both BSD) are no part of the project; they are
measured where they are installed: ``pip install coal vtk`` into any environment that holds the project's own parts.
"""

from __future__ import annotations

import argparse
import importlib.util
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import fcl
import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # run as a script, beside the package

from benchmarks.scenes import Scene, scenes
from benchmarks.timing import least_seconds
from puncture_twin.planning.clearance.fast_engine import FastEngine

RADIUS_MM = 0.6
SEED = 20190401


def trees(scene: Scene) -> list[fcl.CollisionObject]:
    """FCL objects of the surfaces."""
    found = []
    for mesh in scene.meshes:
        tree = fcl.BVHModel()
        tree.beginModel(num_tris_=len(mesh.faces), num_vertices_=len(mesh.vertices))
        tree.addSubModel(mesh.vertices, mesh.faces)
        tree.endModel()
        found.append(fcl.CollisionObject(tree))
    return found


def pose(target: np.ndarray, outward: np.ndarray, length: float) -> fcl.Transform:
    """Of a capsule about a needle axis."""
    helper = np.eye(3)[np.argmin(np.abs(outward))]
    x = np.cross(helper, outward) / np.linalg.norm(np.cross(helper, outward))
    R = np.stack([x, np.cross(outward, x), outward], axis=1)
    return fcl.Transform(R, target + outward * (length / 2))


def fcl_capsule_distance(scene: Scene, directions: np.ndarray, objects: list[fcl.CollisionObject]) -> float:
    """Seconds for `fcl.distance` of a 0.6 mm capsule from every surface: exact, as people use it."""
    start = time.thread_time()
    for outward in directions:
        needle = fcl.CollisionObject(fcl.Capsule(0.6, scene.length), pose(scene.target, outward, scene.length))
        for tree in objects:
            fcl.distance(needle, tree, fcl.DistanceRequest(), fcl.DistanceResult())
    return time.thread_time() - start


def fcl_collide(scene: Scene, directions: np.ndarray, objects: list[fcl.CollisionObject]) -> float:
    """Seconds for `fcl.collide` with every surface that has a margin: one capsule per direction and margin."""
    asked: dict[float, list[fcl.CollisionObject]] = {}
    for column in np.flatnonzero(np.isfinite(scene.thresholds)):
        asked.setdefault(float(scene.thresholds[column]), []).append(objects[column])
    start = time.thread_time()
    for outward in directions:
        at = pose(scene.target, outward, scene.length)
        for radius, margined in asked.items():
            needle = fcl.CollisionObject(fcl.Capsule(radius, scene.length), at)
            for tree in margined:
                fcl.collide(needle, tree, fcl.CollisionRequest(), fcl.CollisionResult())
    return time.thread_time() - start


@dataclass(frozen=True)
class Peer:
    """Somebody who answers a question about one needle direction, and what exactly it answers.

    Attributes:
        answers: In words.
        prepare: Builds what it needs of a scene, and returns the function that answers one batch of directions.
        part: The package that it comes from.
        most: How many directions are asked at most.
    """

    name: str
    answers: str
    prepare: Callable[[Scene], Callable[[np.ndarray], object]]
    part: str
    most: int


def _needle(scene: Scene, outward: np.ndarray) -> fcl.CollisionObject:
    return fcl.CollisionObject(fcl.Capsule(RADIUS_MM, scene.length), pose(scene.target, outward, scene.length))


def fcl_distance(scene: Scene) -> Callable[[np.ndarray], object]:
    """Exact distance of the capsule from every surface, as python-fcl gives it."""
    objects = trees(scene)

    def ask(directions: np.ndarray) -> np.ndarray:
        found = np.empty((len(directions), len(objects)))
        for row, outward in enumerate(directions):
            needle = _needle(scene, outward)
            for column, tree in enumerate(objects):
                found[row, column] = fcl.distance(needle, tree, fcl.DistanceRequest(), fcl.DistanceResult())
        return found

    return ask


def fcl_hits(scene: Scene) -> Callable[[np.ndarray], object]:
    """Whether the capsule meets each surface."""
    objects = trees(scene)

    def ask(directions: np.ndarray) -> np.ndarray:
        found = np.empty((len(directions), len(objects)), bool)
        for row, outward in enumerate(directions):
            needle = _needle(scene, outward)
            for column, tree in enumerate(objects):
                found[row, column] = fcl.collide(needle, tree, fcl.CollisionRequest(), fcl.CollisionResult()) > 0
        return found

    return ask


def coal_distance(scene: Scene) -> Callable[[np.ndarray], object]:
    """Exact distance of the capsule from every surface, as Coal gives it."""
    import coal

    objects, still = _coal_trees(scene), coal.Transform3s.Identity()
    capsule = coal.Capsule(RADIUS_MM, scene.length)

    def ask(directions: np.ndarray) -> np.ndarray:
        found = np.empty((len(directions), len(objects)))
        for row, outward in enumerate(directions):
            at = pose(scene.target, outward, scene.length)
            where = coal.Transform3s(np.array(at.getRotation()), np.array(at.getTranslation()))
            for column, tree in enumerate(objects):
                result = coal.DistanceResult()
                found[row, column] = coal.distance(capsule, where, tree, still, coal.DistanceRequest(), result)
        return found

    return ask


def coal_hits(scene: Scene) -> Callable[[np.ndarray], object]:
    """Whether the capsule meets each surface, by Coal."""
    import coal

    objects, still = _coal_trees(scene), coal.Transform3s.Identity()
    capsule = coal.Capsule(RADIUS_MM, scene.length)

    def ask(directions: np.ndarray) -> np.ndarray:
        found = np.empty((len(directions), len(objects)), bool)
        for row, outward in enumerate(directions):
            at = pose(scene.target, outward, scene.length)
            where = coal.Transform3s(np.array(at.getRotation()), np.array(at.getTranslation()))
            for column, tree in enumerate(objects):
                result = coal.CollisionResult()
                found[row, column] = coal.collide(capsule, where, tree, still, coal.CollisionRequest(), result) > 0
        return found

    return ask


def _coal_trees(scene: Scene) -> list[object]:
    import coal

    objects = []
    for mesh in scene.meshes:
        tree = coal.BVHModelOBBRSS()
        tree.beginModel(len(mesh.faces), len(mesh.vertices))
        tree.addVertices(np.array(mesh.vertices))
        tree.addTriangles(np.array(mesh.faces, dtype=np.int64))
        tree.endModel()
        objects.append(tree)
    return objects


def embree_rays(scene: Scene) -> Callable[[np.ndarray], object]:
    """Whether a thin ray meets any of the surfaces within the needle's length, all surfaces in one tree."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    world = rtcore_scene.EmbreeScene()
    TriangleMesh(world, np.concatenate([m.triangles for m in scene.meshes]).astype(np.float32))
    world.run(np.zeros((1, 3), np.float32), np.eye(3, dtype=np.float32)[:1])

    def ask(directions: np.ndarray) -> np.ndarray:
        starts = np.tile(scene.target, (len(directions), 1)).astype(np.float32)
        return world.run(starts, directions.astype(np.float32), query="OCCLUDED", dists=scene.length) != -1

    return ask


def vtk_bsp(scene: Scene) -> Callable[[np.ndarray], object]:
    """Whether a thin ray meets each surface, by vtkModifiedBSPTree."""
    import vtk

    return _vtk_rays(scene, vtk.vtkModifiedBSPTree)


def vtk_obb(scene: Scene) -> Callable[[np.ndarray], object]:
    """Whether a thin ray meets each surface, by vtkOBBTree."""
    import vtk

    return _vtk_rays(scene, vtk.vtkOBBTree)


def _vtk_rays(scene: Scene, kind: Callable[[], Any]) -> Callable[[np.ndarray], object]:
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    locators = []
    for mesh in scene.meshes:
        points, cells, data = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
        points.SetData(numpy_to_vtk(mesh.vertices.copy(), deep=True))
        rows = np.concatenate([np.full((len(mesh.faces), 1), 3), mesh.faces], axis=1).astype(np.int64).ravel()
        cells.ImportLegacyFormat(numpy_to_vtkIdTypeArray(rows, deep=True))
        data.SetPoints(points)
        data.SetPolys(cells)
        locator = kind()
        locator.SetDataSet(data)
        locator.BuildLocator()
        locators.append((locator, data))

    def ask(directions: np.ndarray) -> np.ndarray:
        found, at = np.empty((len(directions), len(locators)), bool), [0.0] * 3
        for row, outward in enumerate(directions):
            top = scene.target + scene.length * outward
            for column, (locator, _) in enumerate(locators):
                hit = locator.IntersectWithLine(
                    scene.target, top, 1e-6, vtk.mutable(0.0), at, [0.0] * 3, vtk.mutable(0), vtk.mutable(0)
                )
                found[row, column] = hit != 0
        return found

    return ask


PEERS = (
    Peer("python-fcl distance", "exact mm, capsule, every surface", fcl_distance, "python-fcl", 200),
    Peer("Coal distance", "exact mm, capsule, every surface", coal_distance, "coal", 200),
    Peer("python-fcl collide", "hit or not, capsule, every surface", fcl_hits, "python-fcl", 1000),
    Peer("Coal collide", "hit or not, capsule, every surface", coal_hits, "coal", 1000),
    Peer("vtkOBBTree", "hit or not, thin ray, every surface", vtk_obb, "vtk", 1000),
    Peer("vtkModifiedBSPTree", "hit or not, thin ray, every surface", vtk_bsp, "vtk", 1000),
    Peer("embree", "hit or not, thin ray, all surfaces as one", embree_rays, "embreex", 40_000),
)
"""In the order of the table. A thin ray has no thickness: it asks for no margin, and says no distance."""


def optional(scene: Scene, directions: np.ndarray) -> None:
    """Print the time of the peers that are no part of this project, as far as they are installed."""
    for peer in PEERS:
        if peer.part == "python-fcl":
            continue
        if importlib.util.find_spec(peer.part) is None:
            print(f"{peer.name}: not installed")
            continue
        ask = peer.prepare(scene)
        each = least_seconds(lambda ask=ask: ask(directions), 2) / len(directions)
        print(f"{peer.name} ({peer.answers}): {1e6 * each:.3g} us per direction")


def compare(scene: Scene, step_deg: float) -> None:
    """Print a scene's table: ratios to ours first, then microseconds per direction."""
    directions = np.random.default_rng(SEED).permutation(scene.hemisphere(step_deg))
    engine = FastEngine(scene.meshes, threads=1)
    engine.measure(scene.target, directions[:50], scene.length)
    exact = least_seconds(lambda: engine.measure(scene.target, directions, scene.length), 3) / len(directions)
    ours = engine.measure(scene.target, directions, scene.length).distance
    asked = f"{len(directions):,}"
    print(f"\n## {scene.name}: {scene.triangles:,} triangles, {len(scene.meshes)} surfaces, {asked} directions")
    print("| who | ours is faster by | us per direction | build s | asked | answers | agrees |")
    print("|---|---|---|---|---|---|---|")
    print(f"| ours, exact | 1 | {1e6 * exact:.1f} | | {asked} | exact mm, axis, every surface | |")
    for peer in PEERS:
        if importlib.util.find_spec({"python-fcl": "fcl"}.get(peer.part, peer.part)) is None:
            print(f"| {peer.name} | not installed | | | | {peer.answers} | |")
            continue
        start = time.thread_time()
        ask = peer.prepare(scene)
        build, some = time.thread_time() - start, directions[: peer.most]
        found = np.asarray(ask(some))
        each = least_seconds(lambda ask=ask, some=some: ask(some), 2) / len(some)
        agrees = _agreement(found, ours[: len(some)], thin="thin" in peer.answers)
        cells = f"{each / exact:.3g}x | {1e6 * each:.3g} | {build:.2f} | {len(some):,} | {peer.answers} | {agrees}"
        print(f"| {peer.name} | {cells} |", flush=True)


def _agreement(found: np.ndarray, axis_mm: np.ndarray, *, thin: bool) -> str:
    """How well an answer agrees with our distance of the axis; a thin ray's, with the axis as it asks."""
    if found.dtype == bool:
        hit = axis_mm <= 0 if thin else axis_mm < RADIUS_MM
        return f"{100 * np.mean(found == (hit if found.ndim == 2 else hit.any(axis=1))):.2f} %"
    clear = axis_mm > RADIUS_MM + 0.01
    return f"to {np.abs(found - (axis_mm - RADIUS_MM))[clear].max():.1e} mm"


def main() -> None:
    """Parse, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="", help="only scenes whose name holds this")
    parser.add_argument("--step", type=float, default=1.0, help="of the grid, degrees")
    chosen = parser.parse_args()
    for scene in (scene for scene in scenes() if chosen.scene in scene.name):
        compare(scene, chosen.step)


if __name__ == "__main__":
    main()
