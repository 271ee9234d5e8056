"""Meshes as FCL sees them: surfaces, solids, and whether two of them touch."""

from __future__ import annotations

from itertools import product

import fcl
import numpy as np

from puncture_twin.planning.geometry.mesh import TriangleMesh


def touch(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    """A fresh result for every question: a reused one keeps its old hit."""
    return bool(fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()))


def surface(mesh: TriangleMesh) -> fcl.BVHModel:
    """A surface without an inside."""
    bvh = fcl.BVHModel()
    bvh.beginModel(len(mesh.vertices), len(mesh.faces))
    bvh.addSubModel(np.array(mesh.vertices), np.array(mesh.faces))
    bvh.endModel()
    return bvh


def convex(mesh: TriangleMesh) -> fcl.Convex:
    """A convex mesh as a solid."""
    counted = np.insert(mesh.faces, 0, 3, axis=1)  # FCL wants each face's corner count before its indices
    return fcl.Convex(np.array(mesh.vertices), len(mesh.faces), counted.ravel().astype(np.int32))


def padded(mesh: TriangleMesh, padding_mm: float) -> TriangleMesh:
    """A convex mesh grown by at least ``padding_mm`` on every side: its sum with the cube about such a sphere."""
    import trimesh  # here: it costs a third of a second, and few need it

    if padding_mm == 0.0:
        return mesh
    corners = padding_mm * np.array(list(product((-1.0, 1.0), repeat=3)))
    hull = trimesh.convex.convex_hull((mesh.vertices[:, None] + corners).reshape(-1, 3))
    return TriangleMesh(np.asarray(hull.vertices), np.asarray(hull.faces))
