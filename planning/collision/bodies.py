"""Bodies of the arm and the patient for FCL, and what checkers return: contacts and distances between them.

Links and tool are convex pieces, bare and padded; the skin is in parts. `arm_bodies` makes all of them; a `Solid` is
built by FCL when it is first queried, and so is each part of an `FclSkin`. A `Check` is one query to FCL. Where
surfaces do not touch, `LooseParts` tells whether a part of one lies within a convex piece.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import combinations, islice, pairwise, product
from types import MappingProxyType
from typing import NamedTuple

import fcl
import numpy as np
import scipy

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.links import LINK_NAMES, Link, collision_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.arm.urdf.arm_urdf import hull
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.cache.array_cache import user_cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.collision.kernels.surfaces import boxes_near, points_within
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of, joined, packed_meshes, unpacked_meshes
from puncture_twin.planning.geometry.rigid import pose

PATIENT = "patient"
BODY_NAMES = (*LINK_NAMES, "tool", "holder", "needle")
"""The bodies of the arm, from the base on; not every arm has a tool."""


class Contact(NamedTuple):
    """Two bodies that touch, such as ``("forearm", "patient")``; a body of the arm first."""

    body: str
    other: str


NEEDLE_IN_PATIENT = Contact("needle", PATIENT)
"""The contact that is allowed while the needle goes in."""


class FirstContact(NamedTuple):
    """The first contact along a path: at which of its states, and of what."""

    at: int  # index of the state
    contact: Contact


class Nearest(NamedTuple):
    """The smallest distance between the arm and something else; infinite, with empty names, where there is nothing."""

    mm: float
    body: str
    other: str


class Distances(NamedTuple):
    """Least distances of the arm, mm, 0 where it touches."""

    patient: Nearest  # moving links and holder to the skin
    needle: Nearest  # needle to the skin: 0 while it goes in
    boxes: Nearest  # moving links, holder and needle to the workcell's boxes


DISTANCE_PAIRS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {"patient": BODY_NAMES[1:-1], "needle": BODY_NAMES[-1:], "boxes": BODY_NAMES[1:]}
)
"""The kinds of distance, by the fields of ``Distances``, and the bodies that each is measured from."""


def require_finite(q: Floats) -> None:
    """Refuse joint angles that are not finite: FCL would call them free."""
    if not np.isfinite(q).all():
        refuse(f"joint angles {q} are not finite", "collision check", "six angles in rad", "not_finite")


FLANGE_FRAME = 6
"""The frame of wrist 3, whose origin and axes are the flange's."""
NEVER_TESTED = frozenset((*pairwise(LINK_NAMES), *combinations(("wrist_3", "tool", "holder", "needle"), 2)))
"""Pairs that touch by construction, connected by a joint or bolted together; of an own arm's neighbours what is not
joined is tested."""
NEVER_TOUCHING = frozenset({("wrist_2", "holder"), ("wrist_2", "needle")})
"""Pairs that cannot touch where the arm ships with the program: holder and needle begin at the flange, beyond wrist 2,
and point away at every angle; wrist 2 of an own arm may carry a bracket."""


PRISM_SIDES = 24
"""Sides of the prism about a cylinder: 0.9 % fuller than it."""
FINE_SIDES = 96
"""Sides of the prism about a cylinder that is tested against triangles: 0.05 % fuller than it."""


def prism(radius_mm: float, length_mm: float, sides: int = PRISM_SIDES) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``sides``, 3), mm; those of one end first."""
    angles = 2.0 * np.pi * np.arange(sides) / sides
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / sides)  # circumscribed: encloses the circle
    ring = outer * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


SLACK_MM = 1e-6
"""Prisms and spheres are larger by this, which covers the rounding of cuts and of the hull's edges (about 1e-12 mm)."""


class Shape(NamedTuple):
    """A body for FCL: solid convex pieces, and one surface for the test against the skin."""

    solids: tuple[Solid, ...]
    surface: Solid
    hulls: tuple[Floats, ...]
    """For each solid, corners (n, 3), mm, of a convex hull that contains it, in the frame of the shapes."""


@dataclass(frozen=True, eq=False)
class Body:
    """A body of the arm: a link, the tool, the holder or the needle."""

    name: str  # one of ``BODY_NAMES``
    frame: int  # index of its frame among ``link_poses``
    T_frame_body: Floats  # shape (4, 4), mm: its shapes in that frame
    bare: Shape
    full: Shape  # the body grown by the padding; ``bare`` itself where there is none
    radius_mm: float  # every point of ``bare`` lies within this distance of the shapes' origin

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
    """All bodies, in the order of ``BODY_NAMES``, at the zero configuration of their own frames; ``full`` is padded.

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
    """A moving shape, mm, that ``make`` builds for FCL at its first query; bounds answer most questions before."""

    def __init__(self, make: Callable[[], fcl.CollisionGeometry], pose: fcl.Transform | None = None) -> None:
        self._make = make
        self.pose = pose or fcl.Transform()

    @cached_property
    def made(self) -> fcl.CollisionObject:
        """The FCL object where the shape is now; it moves with `place`."""
        return fcl.CollisionObject(self._make(), self.pose)

    def place(self, pose: fcl.Transform) -> None:
        """Move the shape and its FCL object."""
        self.pose = pose
        if "made" in self.__dict__:
            self.made.setTransform(pose)


def touch(a: fcl.CollisionObject, b: fcl.CollisionObject) -> bool:
    """Whether two FCL objects touch; a fresh result each time, since a reused one keeps its old hit."""
    return bool(fcl.collide(a, b, fcl.CollisionRequest(), fcl.CollisionResult()))


def surface(mesh: TriangleMesh) -> fcl.BVHModel:
    """An FCL model of a surface, without an inside."""
    bvh = fcl.BVHModel()
    bvh.beginModel(len(mesh.vertices), len(mesh.faces))
    bvh.addSubModel(np.array(mesh.vertices), np.array(mesh.faces))
    bvh.endModel()
    return bvh


def convex(mesh: TriangleMesh) -> fcl.Convex:
    """An FCL model of a convex mesh, solid."""
    counted = np.insert(mesh.faces, 0, 3, axis=1)  # FCL wants each face's corner count before its indices
    return fcl.Convex(np.array(mesh.vertices), len(mesh.faces), counted.ravel().astype(np.int32))


def padded(mesh: TriangleMesh, padding_mm: float) -> TriangleMesh:
    """A convex mesh grown by at least ``padding_mm`` on every side: its sum with the cube about such a sphere."""
    if padding_mm == 0.0:
        return mesh
    corners = padding_mm * np.array(list(product((-1.0, 1.0), repeat=3)))
    return hull((mesh.vertices[:, None] + corners).reshape(-1, 3))


class LooseParts(NamedTuple):
    """The connected parts of a surface."""

    corners: Floats  # shape (k, 3), mm: a corner of each
    lengths: Floats  # shape (k,), mm: the diagonal of the box about each

    @classmethod
    def of(cls, mesh: TriangleMesh) -> LooseParts:
        """The connected parts of a checked mesh."""
        points, begins = _in_parts(mesh)
        sizes = np.maximum.reduceat(points, begins) - np.minimum.reduceat(points, begins)
        return cls(points[begins], np.linalg.norm(sizes, axis=1))


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


PART_TRIANGLES = 8192
"""Triangles in one tree: FCL takes some 4 us to build for each, and 20 us to query a tree."""
ROUNDING_MM = 1e-6
"""By how much a body's box is grown: far above the rounding of its pose."""


class FclSkin:
    """A surface in parts, each with a tree of its own, which FCL builds when a body first comes near the part.

    To build a tree takes longer than most questions, and the arm comes near to few parts of a patient. FCL tests a
    triangle by itself, whichever tree it is in, so the surface touches what one of its parts touches.

    Args:
        mesh: The surface, mm.

    Raises:
        InputError: FCL calls a NaN vertex free and dies of an index out of range: so that is looked for first.
    """

    def __init__(self, mesh: TriangleMesh, name: str) -> None:
        count = len(mesh.vertices)
        usable = len(mesh.faces) > 0 and bool(np.isfinite(mesh.vertices).all())
        if not usable or mesh.faces.min() < 0 or mesh.faces.max() >= count:
            refuse("mesh is empty, not finite or has an index out of range", name, "a valid mesh", "bad_mesh")
        self._mesh = mesh
        self._trees: dict[int, fcl.CollisionObject] = {}

    def touches(self, solid: Solid, box: Floats) -> bool:
        """Whether a body, enclosed by a ``box`` (2, 3), mm, of its own frame, touches the surface where it is."""
        return any(touch(self._tree(part), solid.made) for part in self._near(solid.pose, box))

    def collides_with(self, body: Body) -> bool:
        """Whether a body touches the surface where it is, or has a part of it within."""
        return self.touches(body.full.surface, body.box) or self.has_part_within(body)

    def has_part_within(self, body: Body) -> bool:
        """Whether a connected part of the surface lies within a link where it is, which :meth:`touches` does not see.

        Of a link FCL sees the surface, which such a part does not touch. Holder and needle are solid for it.
        """
        if not body.hollow:
            return False
        loose, stands = self._loose, body.full.surface.pose
        R, t, near = stands.getRotation(), stands.getTranslation(), np.empty(len(loose.corners), np.bool_)
        if not points_within(loose.corners, R, t, *body.box, near):
            return False
        near &= loose.lengths <= float(np.linalg.norm(body.box[1] - body.box[0]))
        return bool(within((loose.corners[near] - t) @ R, body.half_spaces).any())

    def _near(self, pose: fcl.Transform, box: Floats) -> list[int]:
        """Parts of the surface that a box about a body, in the body's frame, may touch."""
        (lows, highs), near = self._bounds, np.empty(len(self._parts), np.bool_)
        if not boxes_near(lows, highs, pose.getRotation(), pose.getTranslation(), *box, ROUNDING_MM, near):
            return []
        rows: list[int] = np.flatnonzero(near).tolist()
        return rows

    @cached_property
    def _loose(self) -> LooseParts:
        return LooseParts.of(self._mesh)

    @cached_property
    def _parts(self) -> list[Ints]:
        order = kd_order(self._mesh.triangles.mean(axis=1), PART_TRIANGLES)
        return np.split(order, range(PART_TRIANGLES, len(order), PART_TRIANGLES))

    @cached_property
    def _bounds(self) -> tuple[Floats, Floats]:
        boxes = np.array([box_of(self._mesh.triangles[part].reshape(-1, 3)) for part in self._parts])
        return np.ascontiguousarray(boxes[:, 0]), np.ascontiguousarray(boxes[:, 1])

    def _tree(self, part: int) -> fcl.CollisionObject:
        if part not in self._trees:
            faces = self._mesh.faces[self._parts[part]]
            used, corners = np.unique(faces, return_inverse=True)
            piece = TriangleMesh(self._mesh.vertices[used], corners.reshape(faces.shape).astype(np.int32))
            self._trees[part] = fcl.CollisionObject(surface(piece))
        return self._trees[part]


class FclPatient(NamedTuple):
    """The patient for FCL: the skin, and what else the CT shows."""

    skin: FclSkin
    outside: FclSkin | None

    def touched_part(self, body: Body) -> str | None:
        """The part that a body touches where it is: the skin, ``outside_body`` where that is all, or None."""
        if self.skin.collides_with(body):
            return PATIENT
        return OUTSIDE_BODY if self.outside is not None and self.outside.collides_with(body) else None


class Check(NamedTuple):
    """One query to FCL: whether two shapes touch."""

    contact: Contact  # what it means if they do
    first: Solid | FclPatient  # the patient, a box, or a piece of a body
    second: Solid
    first_body: Body | None  # the body that ``first`` moves with; None for skin and boxes
    second_body: Body
    hulls: tuple[Floats | None, Floats] | None
    """Corners that enclose either, in the frames of their shapes; None for a box, and for the pair with the skin."""

    @property
    def before_last_joint(self) -> bool:
        """Whether it is of two bodies of the arm neither of which moves with the last joint."""
        return self.first_body is not None and max(self.first_body.frame, self.second_body.frame) < FLANGE_FRAME

    def contact_at(self, frames: Floats) -> Contact | None:
        """The contact, if the two shapes touch where ``link_poses`` (7, 4, 4) has them; see `contact_found`."""
        self.second.place(self.second_body.pose(frames))
        if self.first_body is not None:
            assert not isinstance(self.first, FclPatient)  # it belongs to no body
            self.first.place(self.first_body.pose(frames))
        return self.contact_found()

    def contact_found(self) -> Contact | None:
        """The contact, if the two shapes touch where they are: ``outside_body`` where that is all of the patient."""
        if not isinstance(self.first, FclPatient):
            return self.contact if touch(self.first.made, self.second.made) else None
        part = self.first.touched_part(self.second_body)
        return None if part is None else self.contact._replace(other=part)
