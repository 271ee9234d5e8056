"""The reference engine, and the cross-check against it: FCL, one query per direction and structure.

It is slow, plain and right by definition. `cross_check` measures some directions again and names every difference.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass

import fcl
import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import PlanningError, refuse
from puncture_twin.planning.base.progress import Count
from puncture_twin.planning.clearance.engine import AxisDistances, ClearanceEngine
from puncture_twin.planning.clearance.kernels.blocks import Blocks, pack
from puncture_twin.planning.geometry.containment import first_crossing
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import frame_about

_SEGMENT_FACE = np.array([[0, 1, 1]])
"""A triangle with two corners at the needle's top is the axis itself: FCL's triangle distance is exact for it."""


class FclEngine:
    """FCL over bounding volume trees of the triangles of k surfaces, CT frame, mm.

    The distance comes from FCL's triangle-to-triangle distance with the axis as a degenerate triangle: exact to
    rounding, and 0 on contact, where the distance of an FCL capsule is accurate to 1e-6 mm and a flat -1 on contact.
    """

    def __init__(self, meshes: Sequence[TriangleMesh], progress: Count | None = None) -> None:
        self._meshes = tuple(meshes)
        self._objects = tuple(fcl.CollisionObject(_tree(mesh.vertices, mesh.faces)) for mesh in self._meshes)
        self._progress = progress

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """Triangles of each structure, as its mesh has them; see `ClearanceEngine`."""
        return tuple(mesh.vertices[mesh.faces].reshape(-1, 9) for mesh in self._meshes)

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """Packed blocks of each structure, made anew: FCL itself needs none; see `ClearanceEngine`."""
        return tuple(pack(mesh) for mesh in self._meshes)

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """Exact distances of n axes from all k structures; see `ClearanceEngine`."""
        shape = (len(outward_ct), len(self._objects))
        distance, depth, nearest = np.empty(shape), np.empty(shape), np.empty(shape, np.int32)
        lengths = np.broadcast_to(np.asarray(length, dtype=np.float64), shape)
        for row, outward in enumerate(outward_ct):
            distance[row], depth[row], nearest[row] = self._one_direction(target_ct, outward, lengths[row])
            if shown and self._progress is not None:
                self._progress(row + 1, len(outward_ct))
        for column, mesh in enumerate(self._meshes):
            touching = distance[:, column] <= 0
            distance[touching, column] = 0.0
            if touching.any():
                lengths_here = lengths[touching, column]
                first = first_crossing(mesh, target_ct, outward_ct[touching], float(lengths_here.max()))
                depth[touching, column] = np.minimum(first, lengths_here)
        return AxisDistances(distance, depth, nearest)

    def distances(self, target_ct: Floats, outward_ct: Floats, length: float) -> Floats:
        """Distances of one axis from all k structures, shape (k,), mm, 0 on contact; no nearest points."""
        distances, _, _ = self._one_direction(target_ct, outward_ct, np.full(len(self._objects), length))
        return np.maximum(np.array(distances, dtype=np.float64), 0.0)

    def _one_direction(
        self, tip: Floats, outward: Floats, lengths: Floats
    ) -> tuple[list[float], list[float], list[int]]:
        axes = {
            length: fcl.CollisionObject(_tree(np.stack([tip, tip + length * outward]), _SEGMENT_FACE))
            for length in set(lengths.tolist())
        }
        distances, depths, nearest = [], [], []
        for structure, length in zip(self._objects, lengths.tolist(), strict=True):
            result = fcl.DistanceResult()  # a reused result keeps its old minimum
            request = fcl.DistanceRequest(enable_nearest_points=True)
            distances.append(fcl.distance(axes[length], structure, request, result))
            depths.append(float(np.linalg.norm(result.nearest_points[0] - tip)))
            nearest.append(result.b2)
        return distances, depths, nearest

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """FCL collision of a capsule with one structure; see `ClearanceEngine`."""
        return _capsule_touches(self._objects[structure], target_ct, outward_ct, length, radius)

    def of(self, columns: Ints) -> FclEngine:
        """This engine for some of its structures; see `ClearanceEngine`."""
        part = copy(self)
        part._meshes = tuple(self._meshes[column] for column in columns)
        part._objects = tuple(self._objects[column] for column in columns)
        part._progress = None
        return part


def capsule_touches_any(triangles: Floats, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
    """Whether FCL finds a capsule in contact with any of some triangles (m, 9), mm; see `FclEngine.collides`."""
    corners = np.ascontiguousarray(triangles, dtype=np.float64).reshape(-1, 3)
    surface = fcl.CollisionObject(_tree(corners, np.arange(len(corners)).reshape(-1, 3)))
    return _capsule_touches(surface, target_ct, outward_ct, length, radius)


def _capsule_touches(
    surface: fcl.CollisionObject, target_ct: Floats, outward_ct: Floats, length: float, radius: float
) -> bool:
    pose = fcl.Transform(frame_about(outward_ct), target_ct + outward_ct * (length / 2))
    capsule = fcl.CollisionObject(fcl.Capsule(radius, length), pose)
    return bool(fcl.collide(capsule, surface, fcl.CollisionRequest(), fcl.CollisionResult()) > 0)


def _tree(vertices: Floats, faces: np.ndarray) -> fcl.BVHModel:
    tree = fcl.BVHModel()
    tree.beginModel(num_tris_=len(faces), num_vertices_=len(vertices))
    tree.addSubModel(vertices, faces)
    tree.endModel()
    return tree


CUSTOM_TOLERANCE_MM = 1e-3
"""By so much a distance of a custom engine may exceed the exact one: single precision, 0.5 m from the origin."""


@dataclass(frozen=True, eq=False)
class VerifiedEngine:
    """A custom engine, verified against an exact one: its distances may be smaller than the true ones, never larger."""

    custom: ClearanceEngine
    exact: ClearanceEngine  # measures the same axes again, and answers all else

    @property
    def triangles(self) -> tuple[Floats, ...]:
        """The exact engine's; see `ClearanceEngine`."""
        return self.exact.triangles

    @property
    def blocks(self) -> tuple[Blocks, ...]:
        """The exact engine's; see `ClearanceEngine`."""
        return self.exact.blocks

    def measure(
        self, target_ct: Floats, outward_ct: Floats, length: Floats | float, *, shown: bool = True
    ) -> AxisDistances:
        """The lesser of both distances, at the exact engine's depths and triangles; see `ClearanceEngine`.

        Raises:
            InputError: The custom engine gives another shape, no number, or more than there is.
        """
        exact = self.exact.measure(target_ct, outward_ct, length, shown=False)
        distances = np.asarray(self.custom.measure(target_ct, outward_ct, length, shown=shown).distance)
        name, allowed = type(self.custom).__name__, "never more than there is"
        if distances.shape != exact.distance.shape:
            refuse(f"distances of shape {distances.shape}", name, f"{exact.distance.shape}", "wrong_shape")
        wrong = ~(distances <= exact.distance + CUSTOM_TOLERANCE_MM)  # NaN too
        if wrong.any():
            row, column = np.argwhere(wrong)[0]
            stated, true = distances[row, column], exact.distance[row, column]
            what = f"measures {stated:.4g} mm to a structure that is {true:.4g} mm away"
            refuse(what, name, allowed, "engine_contradicted")
        return AxisDistances(np.minimum(distances, exact.distance), exact.depth, exact.nearest)

    def collides(self, structure: int, target_ct: Floats, outward_ct: Floats, length: float, radius: float) -> bool:
        """Whether either engine finds a contact; see `ClearanceEngine`."""
        query = structure, target_ct, outward_ct, length, radius
        return self.exact.collides(*query) or self.custom.collides(*query)

    def of(self, columns: Ints) -> VerifiedEngine:
        """Both engines for some of their structures; see `ClearanceEngine`."""
        return VerifiedEngine(self.custom.of(columns), self.exact.of(columns))


AGREE_MM = 1e-6
"""Two exact engines differ by rounding alone: 1e-12 of a metre and a thousand operations."""


class CrossCheckError(PlanningError):
    """The engine and FCL disagree: a defect of this program, not of its input."""


@dataclass(frozen=True)
class CrossChecked:
    """How many pairs of direction and structure were measured twice, and their largest difference."""

    directions: int
    pairs: int
    largest_mm: float


def cross_check(
    measured: AxisDistances,
    meshes: tuple[TriangleMesh, ...],
    target_ct: Floats,
    outward_ct: Floats,
    length: Floats | float,
    *,
    count: int,
    rng: np.random.Generator,
) -> CrossChecked:
    """Measure some of the directions again with `FclEngine`.

    Args:
        measured: By an engine, n directions and k structures.
        target_ct: Shape (3,).
        outward_ct: Shape (n, 3), unit vectors.
        length: Of the axes, one number, shape (k,) or (n, k), mm.
        count: How many directions to measure again; all of them if there are fewer.

    Raises:
        CrossCheckError: A distance differs by more than rounding.
    """
    rows = rng.choice(len(outward_ct), min(count, len(outward_ct)), replace=False)
    lengths = np.broadcast_to(length, measured.distance.shape)[rows]
    reference = FclEngine(meshes).measure(target_ct, outward_ct[rows], lengths)
    difference = np.abs(reference.distance - measured.distance[rows])
    if difference.size and difference.max() > AGREE_MM:
        row, column = np.unravel_index(int(difference.argmax()), difference.shape)
        raise CrossCheckError(
            f"direction {rows[row]}, structure {column}: the engine finds"
            f" {measured.distance[rows[row], column]:.9f} mm, FCL {reference.distance[row, column]:.9f} mm"
        )
    return CrossChecked(len(rows), difference.size, float(difference.max(initial=0.0)))
