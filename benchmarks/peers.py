"""What others take for the same question, or for the nearest that they answer."""

from __future__ import annotations

import importlib.util
import time

import fcl
import numpy as np

from benchmarks.scenes import Scene


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


def fcl_capsule_distance(scene: Scene, directions: np.ndarray) -> float:
    """Seconds for `fcl.distance` of a 0.6 mm capsule from every surface: exact, as people use it."""
    objects = trees(scene)
    start = time.thread_time()
    for outward in directions:
        needle = fcl.CollisionObject(fcl.Capsule(0.6, scene.length), pose(scene.target, outward, scene.length))
        for tree in objects:
            fcl.distance(needle, tree, fcl.DistanceRequest(), fcl.DistanceResult())
    return time.thread_time() - start


def fcl_collide(scene: Scene, directions: np.ndarray) -> float:
    """Seconds for `fcl.collide` with every surface that has a margin: one capsule per direction and margin."""
    objects, asked = trees(scene), {}
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


def optional(scene: Scene, directions: np.ndarray) -> None:
    """Print the peers that happen to be installed; thin rays answer less: whether the axis itself hits."""
    if importlib.util.find_spec("embreex") is None:
        print("embree: not installed")
    else:
        print(f"embree, thin rays: {embree(scene, directions) / len(directions) * 1e6:.2f} us per direction")
    if importlib.util.find_spec("vtk") is None:
        print("vtk: not installed")
    else:
        print(
            f"vtkModifiedBSPTree, thin rays: {vtk_rays(scene, directions) / len(directions) * 1e6:.0f} us per direction"
        )
    if importlib.util.find_spec("coal") is None:
        print("coal: not installed")
    else:
        print(
            f"Coal distance, capsule: {coal_distance(scene, directions) / len(directions) * 1e6:.0f} us per direction"
        )


def embree(scene: Scene, directions: np.ndarray) -> float:
    """Seconds for one thin ray per direction against all surfaces together."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    world = rtcore_scene.EmbreeScene()
    TriangleMesh(world, np.concatenate([m.triangles for m in scene.meshes]).astype(np.float32))
    origins, rays = np.tile(scene.target, (len(directions), 1)).astype(np.float32), directions.astype(np.float32)
    world.run(origins, rays)
    start = time.thread_time()
    world.run(origins, rays)
    return time.thread_time() - start


def vtk_rays(scene: Scene, directions: np.ndarray) -> float:
    """Seconds for one thin ray per direction and surface."""
    import vtk
    from vtk.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray

    locators = []
    for mesh in scene.meshes:
        points, cells, data = vtk.vtkPoints(), vtk.vtkCellArray(), vtk.vtkPolyData()
        points.SetData(numpy_to_vtk(mesh.vertices.copy(), deep=True))
        rows = np.concatenate([np.full((len(mesh.faces), 1), 3), mesh.faces], axis=1).astype(np.int64).ravel()
        cells.SetCells(len(mesh.faces), numpy_to_vtkIdTypeArray(rows, deep=True))
        data.SetPoints(points)
        data.SetPolys(cells)
        locator = vtk.vtkModifiedBSPTree()
        locator.SetDataSet(data)
        locator.BuildLocator()
        locators.append((locator, data))
    start = time.thread_time()
    for outward in directions:
        for locator, _ in locators:
            top = scene.target + scene.length * outward
            locator.IntersectWithLine(scene.target, top, 1e-6, vtk.mutable(0), [0.0] * 3, [0.0] * 3, vtk.mutable(0))
    return time.thread_time() - start


def coal_distance(scene: Scene, directions: np.ndarray) -> float:
    """Seconds for Coal's distance of the capsule from every surface."""
    import coal

    objects = []
    for mesh in scene.meshes:
        tree = coal.BVHModelOBBRSS()
        tree.beginModel(len(mesh.faces), len(mesh.vertices))
        tree.addVertices(np.array(mesh.vertices))
        tree.addTriangles(np.array(mesh.faces, dtype=np.int64))
        tree.endModel()
        objects.append(tree)
    capsule, still = coal.Capsule(0.6, scene.length), coal.Transform3s.Identity()
    start = time.thread_time()
    for outward in directions:
        at = pose(scene.target, outward, scene.length)
        where = coal.Transform3s(np.array(at.getRotation()), np.array(at.getTranslation()))
        for tree in objects:
            coal.distance(capsule, where, tree, still, coal.DistanceRequest(), coal.DistanceResult())
    return time.thread_time() - start
