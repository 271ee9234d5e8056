"""Meshes as FCL sees them: surfaces, solids, and whether two of them touch."""

from __future__ import annotations

from functools import cached_property
from itertools import product

import fcl
import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.geometry.mesh import TriangleMesh


class FclSkin:
    """The skin, whose tree FCL builds when it is first asked about: that takes longer than most questions.

    Args:
        patient: The surface, mm.
        name: Of it, for who is told of its fault.

    Raises:
        InputError: FCL calls a NaN vertex free and dies of an index out of range: so that is looked for first.
    """

    def __init__(self, patient: TriangleMesh, name: str) -> None:
        count = len(patient.vertices)
        usable = len(patient.faces) > 0 and bool(np.isfinite(patient.vertices).all())
        if not usable or patient.faces.min() < 0 or patient.faces.max() >= count:
            what = "mesh is empty, not finite or has an index out of range"
            raise InputError(what, where=name, allowed="a checked mesh")
        self._mesh = patient

    @cached_property
    def object(self) -> fcl.CollisionObject:
        """The whole surface for FCL."""
        return fcl.CollisionObject(surface(self._mesh))

    def touches_still(self, solid: fcl.CollisionObject, bounds: Floats) -> bool:
        """Whether a body that does not move touches the surface.

        Only triangles whose box meets the body's box can touch it, so FCL is asked about these alone.

        Args:
            solid: The body.
            bounds: Shape (2, 3), mm: a box about it, in the surface's frame.
        """
        triangles = self._mesh.triangles
        near = np.all((triangles.max(axis=1) >= bounds[0]) & (triangles.min(axis=1) <= bounds[1]), axis=1)
        if not near.any():
            return False
        return touch(fcl.CollisionObject(surface(TriangleMesh(self._mesh.vertices, self._mesh.faces[near]))), solid)


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
