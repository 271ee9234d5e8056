"""Meshes as FCL sees them: surfaces, solids, and whether two of them touch; and prisms about and within cylinders."""

from __future__ import annotations

from itertools import product

import fcl
import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.sphere_tree import SLACK_MM
from puncture_twin.planning.geometry.mesh import TriangleMesh

INSIDE = 1e-5
"""By this fraction a prism within a cylinder is smaller still: more than the slack of any cylinder of 1 mm or more."""

PRISM_SIDES = 24
"""Of the prism about a cylinder: 0.9 % fuller than it."""


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


def prism(radius_mm: float, length_mm: float) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``PRISM_SIDES``, 3), mm."""
    turn = 2.0 * np.pi * np.arange(PRISM_SIDES) / PRISM_SIDES
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / PRISM_SIDES)
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def inscribed_prism(corners: Floats) -> Floats:
    """Corners of a prism inside the cylinder that :func:`prism` gave the corners about, along z of any frame."""
    middle, inside = corners.mean(axis=0), 1.0 - INSIDE
    return np.asarray(middle + (corners - middle) * (2 * [inside * np.cos(np.pi / PRISM_SIDES)] + [inside]))
