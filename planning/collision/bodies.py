"""Bodies of the arm for FCL and for bounds: links and tool as convex pieces, bare and padded, and spheres around them.

`arm_bodies` makes all of them; a `Solid` is built by FCL when it is first queried. A `SphereTree` encloses a body: what
is clear of its spheres is clear of the body. A sphere is convex, so it contains the convex hull of any points in it.
A convex piece is cut by planes; the corners of a part are the piece's corners on that side and the points where its
edges cross the plane; a sphere about those corners contains the part (docs/concepts/arm-collisions.md).
Where surfaces do not touch, `LooseParts` tells whether a part of one lies within a convex piece.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, islice, pairwise, product
from typing import NamedTuple

import fcl
import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.arm.links import LINK_NAMES, Link, collision_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import hull
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined, packed_meshes, unpacked_meshes
from puncture_twin.planning.geometry.rigid import pose

BODY_NAMES = (*LINK_NAMES, "tool", "holder", "needle")
"""The bodies of the arm, from the base on; not every arm has a tool."""

FLANGE_FRAME = 6
"""The frame of wrist 3, whose origin and axes are the flange's."""

NEVER_TESTED = frozenset((*pairwise(LINK_NAMES), *combinations(("wrist_3", "tool", "holder", "needle"), 2)))
"""Pairs that touch by construction, connected by a joint or bolted together; of an own arm's neighbours what is not
joined is tested."""

NEVER_TOUCHING = frozenset({("wrist_2", "holder"), ("wrist_2", "needle")})
"""Pairs that cannot touch where the arm ships with the program: holder and needle begin at the flange, beyond wrist 2,
and point away at every angle; wrist 2 of an own arm may carry a bracket."""


class Shape(NamedTuple):
    """A body for FCL: solid convex pieces, and one surface for the test against the skin."""

    solids: tuple[Solid, ...]
    surface: Solid
    hulls: tuple[Floats, ...]
    """For each solid, corners (n, 3), mm, of a convex hull that contains it, in the frame of the shapes."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body of the arm."""

    name: str
    """One of ``BODY_NAMES``."""
    frame: int
    """Index of its frame among ``link_poses``."""
    T_frame_body: Floats
    """Shape (4, 4), mm: its shapes in that frame."""
    bare: Shape
    full: Shape
    """The body grown by the padding; ``bare`` itself where there is none."""
    radius_mm: float
    """Every point of ``bare`` lies within this distance of the shapes' origin."""

    @cached_property
    def box(self) -> Floats:
        """Shape (2, 3), mm: lowest and highest corner of a box about ``full``, in the frame of the shapes."""
        return box_of(np.concatenate(self.full.hulls))

    @property
    def hollow(self) -> bool:
        """Whether FCL sees only its surface when it is tested against the skin."""
        return self.full.surface not in self.full.solids

    @cached_property
    def half_spaces(self) -> tuple[Floats, ...]:
        """Half spaces (m, 4) of each piece of ``full``, whose intersection it is, in the frame of the shapes."""
        return tuple(half_spaces(corners) for corners in self.full.hulls)

    def pose(self, poses: Floats) -> fcl.Transform:
        """Pose of the body's shapes where ``link_poses`` (7, 4, 4) has its link."""
        T = poses[self.frame] @ self.T_frame_body
        return fcl.Transform(T[:3, :3], T[:3, 3])

    def place(self, poses: Floats) -> None:
        """Move the shapes with ``link_poses`` (7, 4, 4)."""
        transform = self.pose(poses)
        for shape in (self.bare,) if self.full is self.bare else (self.bare, self.full):
            for item in (*shape.solids, shape.surface):
                item.place(transform)


def _link_shape(link: Link) -> Shape:
    solids = tuple(Solid(partial(convex, piece)) for piece in link.pieces)
    hulls = tuple(np.asarray(piece.vertices) for piece in link.pieces)
    return Shape(solids, Solid(lambda: surface(joined(link.pieces))), hulls)


def round_body(name: str, diameter_mm: float, span_mm: tuple[float, float], padding_mm: float) -> Body:
    """A cylinder about the needle's axis, from one height above the flange to another, mm."""
    length = span_mm[1] - span_mm[0]
    T_flange_body = pose(np.eye(3), [0.0, 0.0, (span_mm[0] + span_mm[1]) / 2.0])
    bare = _cylinder(diameter_mm / 2.0, length)
    full = _cylinder(diameter_mm / 2.0 + padding_mm, length + 2.0 * padding_mm) if padding_mm else bare
    radius_mm = float(np.hypot(diameter_mm, length)) / 2.0
    return Body(name, FLANGE_FRAME, T_flange_body, bare, full, radius_mm)


def _cylinder(radius_mm: float, length_mm: float) -> Shape:
    solid = Solid(partial(fcl.Cylinder, radius_mm, length_mm))
    return Shape((solid,), solid, (prism(radius_mm, length_mm),))


def arm_bodies(model: UrModel, tool: Tool, padding_mm: float) -> tuple[Body, ...]:
    """All bodies, in the order of ``BODY_NAMES``, at the zero configuration of their own frames.

    Args:
        padding_mm: How much fuller ``full`` is than ``bare``.

    Raises:
        InputError: If the model's meshes do not ship, or the tool is flat.
    """
    own = () if tool.body is None else (Link("tool", FLANGE_FRAME, tool.body.pieces),)
    links = (*collision_links(model), *own)
    pieces = [piece for link in links for piece in link.pieces]

    def grown() -> Arrays:
        return packed_meshes([padded(piece, padding_mm) for piece in pieces])

    bodies, bare = [], [_link_shape(link) for link in links]
    full = bare
    if padding_mm:
        made_from = {"what": "padded", "padding_mm": padding_mm, "pieces": [piece.digest for piece in pieces]}
        following = iter(unpacked_meshes(user_cache().arrays(made_from, grown, by=__name__, check=unpacked_meshes)))
        fuller = [replace(link, pieces=tuple(islice(following, len(link.pieces)))) for link in links]
        full = [_link_shape(link) for link in fuller]
    for link, shape, more in zip(links, bare, full, strict=True):
        radius_mm = float(np.linalg.norm(link.mesh.vertices, axis=1).max())
        bodies.append(Body(link.name, link.frame, np.eye(4), shape, more, radius_mm))
    return (
        *bodies,
        round_body("holder", tool.holder_diameter_mm, tool.holder_span_mm, padding_mm),
        round_body("needle", tool.needle_diameter_mm, tool.needle_span_mm, padding_mm),
    )


class Solid:
    """A moving shape; its bounding spheres and planes answer most questions before FCL builds it.

    Args:
        make: Makes its geometry, mm.
    """

    def __init__(self, make: Callable[[], fcl.CollisionGeometry], pose: fcl.Transform | None = None) -> None:
        self._make = make
        self.pose = pose or fcl.Transform()

    @cached_property
    def made(self) -> fcl.CollisionObject:
        """The FCL object where the shape is now; it moves with `place`."""
        return fcl.CollisionObject(self._make(), self.pose)

    def place(self, pose: fcl.Transform) -> None:
        """Move it."""
        self.pose = pose
        if "made" in self.__dict__:
            self.made.setTransform(pose)


def touch(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    """Whether two FCL objects touch; a fresh result each time, since a reused one keeps its old hit."""
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
    if padding_mm == 0.0:
        return mesh
    corners = padding_mm * np.array(list(product((-1.0, 1.0), repeat=3)))
    return hull((mesh.vertices[:, None] + corners).reshape(-1, 3))


PRISM_SIDES = 24
"""Sides of the prism about a cylinder: 0.9 % fuller than it."""


FINE_SIDES = 96
"""Sides of the prism about a cylinder that is tested against triangles: 0.05 % fuller than it."""


def prism(radius_mm: float, length_mm: float, sides: int = PRISM_SIDES) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``sides``, 3), mm; those of one end first."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / sides)  # circumscribed: encloses the circle
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def finer_prism(corners: Floats) -> Floats:
    """Corners of a prism of ``FINE_SIDES`` about the cylinder that :func:`prism` gave these corners about, as there."""
    radius_mm = float(np.hypot(corners[:, 0], corners[:, 1]).max()) * np.cos(2.0 * np.pi / len(corners))
    return prism(radius_mm, float(np.ptp(corners[:, 2])), FINE_SIDES)


SLACK_MM = 1e-6
"""Every sphere is larger by this: covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""

CENTRE_STEPS = 25
"""Steps of the walk to a sphere's centre; how good it is decides how tight the sphere is, never whether it encloses."""

LEAF_RADIUS_MM = 30.0
"""Parts are cut until their sphere is no larger: half of a UR3 wrist's size."""


class BoundingSphere(NamedTuple):
    """A sphere, mm."""

    centre: Floats
    radius: float


def enclosing_sphere(points: Floats) -> BoundingSphere:
    """A small sphere about points (n, 3): steps toward the farthest point, ever shorter (Badoiu and Clarkson 2003)."""
    centre = np.empty(3)
    radius = _walk_to_centre(np.ascontiguousarray(points), CENTRE_STEPS, centre)
    return BoundingSphere(centre, radius + SLACK_MM)


@nb.njit(cache=True)
def _walk_to_centre(points, steps, best):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``best`` (3,) with the best centre visited for points (n, 3); the radius that it needs."""
    x, y, z = [(points[:, i].min() + points[:, i].max()) / 2.0 for i in range(3)]
    least = math.inf
    for step in range(1, steps + 1):
        most, far = -1.0, 0
        for i in range(len(points)):
            squared = (points[i, 0] - x) ** 2 + (points[i, 1] - y) ** 2 + (points[i, 2] - z) ** 2
            if squared > most:
                most, far = squared, i
        if most < least:
            least = most
            best[0], best[1], best[2] = x, y, z
        x += (points[far, 0] - x) / (step + 1)
        y += (points[far, 1] - y) / (step + 1)
        z += (points[far, 2] - z) / (step + 1)
    return math.sqrt(least)


@dataclass(frozen=True, eq=False)
class SphereTree:
    """Spheres in a tree, the root first: every node's sphere encloses all parts below it."""

    centres: Floats
    """Shape (n, 3), mm, in the frame of the body."""
    radii: Floats
    """Shape (n,), mm."""
    children: NDArray[np.int64]
    """Shape (n, 2): rows of the two children; -1 at a leaf."""

    @property
    def leaves(self) -> NDArray[np.int64]:
        """Rows of the leaves, whose spheres together cover the body."""
        return np.flatnonzero(self.children[:, 0] < 0)


def halves(corners: Floats) -> tuple[Floats, Floats]:
    """A convex hull's corners (n, 3), cut in the middle of its longest side: the corners of the two parts, mm."""
    low, high = corners.min(axis=0), corners.max(axis=0)
    axis = int(np.argmax(high - low))
    cut = (low[axis] + high[axis]) / 2.0
    faces = scipy.spatial.ConvexHull(corners).simplices
    below = corners[:, axis] < cut
    starts, ends = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    crosses = below[starts] != below[ends]  # Qhull turns its faces either way round: each edge counts from both
    a, b = corners[starts[crosses]], corners[ends[crosses]]
    crossings = a + ((cut - a[:, axis]) / (b[:, axis] - a[:, axis]))[:, None] * (b - a)
    return np.concatenate([corners[below], crossings]), np.concatenate([corners[~below], crossings])


def sphere_tree(pieces: Sequence[Floats], leaf_radius_mm: float = LEAF_RADIUS_MM) -> SphereTree:
    """Spheres that enclose the union of convex pieces, each given by its corners (n, 3), mm."""
    spheres: list[BoundingSphere] = []
    children: list[tuple[int, int]] = []

    def add(parts: Sequence[Floats]) -> int:
        row = len(spheres)
        spheres.append(enclosing_sphere(np.concatenate(parts)))
        children.append((-1, -1))
        if len(parts) > 1:
            half = len(parts) // 2
            children[row] = (add(parts[:half]), add(parts[half:]))
        elif spheres[row].radius > leaf_radius_mm:
            below, above = halves(parts[0])
            children[row] = (add([below]), add([above]))
        return row

    add(pieces)
    return SphereTree(
        np.array([sphere.centre for sphere in spheres]),
        np.array([sphere.radius for sphere in spheres]),
        np.array(children, dtype=np.int64),
    )


class LooseParts(NamedTuple):
    """The connected parts of a surface."""

    corners: Floats
    """Shape (k, 3), mm: a corner of each."""
    sizes: Floats
    """Shape (k, 3), mm: the edges of the box about each."""

    @classmethod
    def of(cls, mesh: TriangleMesh) -> LooseParts:
        """The connected parts of a checked mesh."""
        points, begins = _in_parts(mesh)
        sizes = np.maximum.reduceat(points, begins) - np.minimum.reduceat(points, begins)
        return cls(points[begins], sizes)


def connected_parts(mesh: TriangleMesh) -> list[Floats]:
    """The corners of each connected part of a surface, shapes (n, 3)."""
    points, begins = _in_parts(mesh)
    return np.split(points, begins[1:])


def _in_parts(mesh: TriangleMesh) -> tuple[Floats, Ints]:
    """Corners part by part, and where each part begins; faces are connected where they share a corner."""
    count = len(mesh.vertices)
    used = np.flatnonzero(np.bincount(mesh.faces.ravel(), minlength=count))  # corners without a face are no part
    starts, ends = mesh.faces[:, [0, 1]].ravel(), mesh.faces[:, [1, 2]].ravel()
    links = scipy.sparse.coo_array((np.ones(len(starts), np.int8), (starts, ends)), shape=(count, count))
    part = scipy.sparse.csgraph.connected_components(links, directed=False)[1][used]
    order = np.argsort(part, kind="stable")
    return mesh.vertices[used[order]], np.flatnonzero(np.diff(part[order], prepend=-1))


def half_spaces(corners: Floats) -> Floats:
    """The half spaces that a convex hull of corners (n, 3), mm, is the intersection of: shape (m, 4), outward."""
    return np.asarray(scipy.spatial.ConvexHull(corners).equations)


def within(points: Floats, pieces: Sequence[Floats]) -> Bools:
    """Which points (k, 3) lie within one of some convex pieces, each as of :func:`half_spaces`: shape (k,)."""
    inside = np.zeros(len(points), np.bool_)
    for planes in pieces:
        inside |= (points @ planes[:, :3].T + planes[:, 3] <= 0.0).all(axis=1)
    return inside
