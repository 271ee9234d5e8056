"""Boxes, bodies and skin as compiled code takes them.

Convex hulls are packed once each, with their edges; many corners are replaced by a coarse hull of few, with how far the
others stand out. Bodies have trees of bounding spheres; the skin is a balanced tree of boxes and a field of distances.
`joint_levers` bounds how far a rotation of each joint moves a body.

A `SphereTree` encloses a body: what is clear of its spheres is clear of the body. A sphere is convex, so it contains
the convex hull of any points in it. A convex piece is cut by planes; the corners of a part are the piece's corners on
that side and the points where its edges cross the plane; a sphere about those corners contains the part
(docs/concepts/arm-collisions.md).
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.cache.array_cache import NO_CACHE, Cache
from puncture_twin.planning.base.cache.entry_file import Arrays
from puncture_twin.planning.base.numba_kernels import nb
from puncture_twin.planning.collision.bodies import FINE_SIDES, PRISM_SIDES, SLACK_MM, Body, Check, prism
from puncture_twin.planning.collision.kernels.hulls import Hulls
from puncture_twin.planning.collision.kernels.proofs import Movers, SkinTree
from puncture_twin.planning.collision.kernels.surfaces import CELL_MM
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply, even_directions
from puncture_twin.planning.geometry.triangle_distance import farthest_from

NO_BOX = -1.0
"""Half sizes of a hull that is not a box."""
ROUND = ("holder", "needle")
"""Bodies that are cylinders: their hulls are prisms about them."""
INSIDE = 1e-5
"""By this fraction a prism within a cylinder is smaller still: more than the slack of any cylinder of 1 mm or more."""
Axes = tuple[Floats, Floats, Floats]


COARSE_DIRECTIONS = 60
"""Directions in which a coarse hull is as wide as the hull: 26 degrees apart, so a round body of 45 mm bulges out by
1.5 mm."""
WORKCELL_FRAME = 0
"""The frame of what does not move: the base's."""


def finer_prism(corners: Floats) -> Floats:
    """Corners of a prism of ``FINE_SIDES`` about the cylinder that :func:`prism` gave these corners about, as there."""
    radius_mm = float(np.hypot(corners[:, 0], corners[:, 1]).max()) * np.cos(2.0 * np.pi / len(corners))
    return prism(radius_mm, float(np.ptp(corners[:, 2])), FINE_SIDES)


CENTRE_STEPS = 25
"""Steps of the walk to a sphere's centre; how good it is decides how tight the sphere is, never whether it encloses."""
LEAF_RADIUS_MM = 30.0
"""Parts are cut until their sphere is no larger: half of a UR3 wrist's size."""


class BoundingSphere(NamedTuple):
    """Centre and radius of a sphere, mm."""

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

    centres: Floats  # shape (n, 3), mm, in the frame of the body
    radii: Floats  # shape (n,), mm
    children: NDArray[np.int64]  # shape (n, 2): rows of the two children; -1 at a leaf

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


class PackedHulls:
    """Convex hulls, each once: the boxes first."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._rows: dict[int, int] = {}
        self._added: list[Floats] = []  # kept, so that no other array takes the id of one of them
        self._boxes = list(boxes)
        self._names = {box.name: row for row, box in enumerate(boxes)}
        self._corners = [box.corners for box in boxes]
        self._rounded = [False] * len(boxes)
        self._frames = [WORKCELL_FRAME] * len(boxes)

    def box(self, name: str) -> int:
        """Row of the box of that name."""
        return self._names[name]

    def add(self, corners: Floats, body: Body) -> int:
        """Row of a hull of a body, which is added if it is new."""
        row = self._rows.setdefault(id(corners), len(self._corners))
        if row == len(self._corners):
            self._added.append(corners)
            self._corners.append(in_frame(corners, body))
            self._rounded.append(body.name in ROUND)
            self._frames.append(body.frame)
        return row

    def packed(self, cache: Cache) -> tuple[Hulls, Floats, Floats]:
        """``hulls``, ``T_box_base`` and ``halves`` of :class:`ProofScene`."""
        corners, pieces = np.concatenate(self._corners), zip(self._corners, self._rounded, strict=True)
        axes = by_axes(corners)
        inner = np.concatenate([inscribed_prism(piece) if rounded else piece for piece, rounded in pieces])
        count = len(self._boxes)
        boxes, arm = (enclosed(some, cache) for some in (self._corners[:count], self._corners[count:]))
        centres, radii, slack, sizes, few, degrees = (
            np.concatenate([boxes[key], arm[key]]) for key in ("centres", "radii", "slack", "sizes", "few", "degrees")
        )
        neighbours = np.concatenate([boxes["neighbours"], arm["neighbours"] + sum(map(len, self._corners[:count]))])
        poses, halves = np.tile(np.eye(4), (len(self._corners), 1, 1)), np.full((len(self._corners), 3), NO_BOX)
        for row, box in enumerate(self._boxes):
            poses[row], halves[row] = np.linalg.inv(box.T_base_box), np.asarray(box.size_mm) / 2.0
        starts, around = row_starts([len(piece) for piece in self._corners]), np.array(self._rounded)
        few_axes, frames = (by_axes(few), row_starts(sizes)), np.array(self._frames, dtype=np.int64)
        links = (row_starts(degrees), neighbours)
        hulls = Hulls(axes, starts, *few_axes, slack, corners, inner, around, *links, centres, radii, frames)
        return hulls, poses, halves


def inscribed_prism(corners: Floats) -> Floats:
    """Corners of a prism inside the cylinder that `prism` gave the corners about, along z of any frame."""
    middle, inside = corners.mean(axis=0), 1.0 - INSIDE
    return np.asarray(middle + (corners - middle) * (2 * [inside * np.cos(2.0 * np.pi / len(corners))] + [inside]))


def row_starts(sizes: Sequence[int] | Ints) -> Ints:
    """Start of each row and end of the last, shape (n + 1,), of rows of given lengths."""
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)


def by_axes(points: Floats) -> Axes:
    """The coordinates of points (n, 3), an array each."""
    x, y, z = (np.ascontiguousarray(axis) for axis in points.T)
    return x, y, z


def enclosed(hulls: Sequence[Floats], cache: Cache) -> Arrays:
    """A sphere about each convex hull and a coarse hull: their numbers, one array each.

    Boxes are kept apart from the arm, which is the same for every patient.
    """

    def make() -> Arrays:
        coarse, edges = [coarse_hull(corners) for corners in hulls], [neighbours(corners) for corners in hulls]
        first = row_starts([len(corners) for corners in hulls])
        rows = [own + start for (_, own), start in zip(edges, first[:-1], strict=True)]
        spheres = [enclosing_sphere(corners) for corners in hulls]
        return {
            "centres": np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
            "radii": np.array([sphere.radius for sphere in spheres]),
            "slack": np.array([slack_mm for _, slack_mm in coarse]),
            "sizes": np.array([len(few) for few, _ in coarse], dtype=np.int64),
            "few": np.concatenate([np.empty((0, 3)), *(few for few, _ in coarse)]),
            "degrees": np.concatenate([np.empty(0, np.int64), *(degrees for degrees, _ in edges)]),
            "neighbours": np.concatenate([np.empty(0, np.int64), *rows]),
        }

    return cache.arrays(made_from("hulls", hulls), make, by=__name__)


def packed_trees(bodies: Sequence[Body], cache: Cache) -> tuple[dict[str, int], tuple[Floats, Floats, Ints]]:
    """The spheres of the bodies' full shapes, each in the body's frame, and the row of each body's root."""
    roots: dict[str, int] = {}
    centres, radii, children = [np.empty((0, 3))], [np.empty(0)], [np.empty((0, 2), np.int64)]
    for body in bodies:
        pieces = [in_frame(hull, body) for hull in body.full.hulls]
        make = partial(lambda parts: dict(vars(sphere_tree(parts))), pieces)
        tree = SphereTree(**cache.arrays(made_from("balls", pieces), make, by=__name__))
        start = sum(len(part) for part in radii)
        roots[body.name] = start
        centres.append(tree.centres)
        radii.append(tree.radii)
        children.append(np.where(tree.children < 0, -1, tree.children + start))
    return roots, (np.concatenate(centres), np.concatenate(radii), np.concatenate(children))


def made_from(what: str, pieces: Sequence[NDArray[Any]]) -> dict[str, object]:
    """Cache key of results about some convex pieces: their corners and how they are enclosed."""
    digest = hashlib.sha256()
    for corners in pieces:
        digest.update(f"{corners.shape}".encode())
        digest.update(np.ascontiguousarray(corners).tobytes())
    return {
        "what": what,
        "pieces": digest.hexdigest(),
        "leaf": LEAF_RADIUS_MM,
        "slack": SLACK_MM,
        "steps": CENTRE_STEPS,
        "sides": PRISM_SIDES,
        "few": COARSE_DIRECTIONS,
    }


def coarse_hull(corners: Floats) -> tuple[Floats, float]:
    """The corners (n, 3) that are outermost in some of many directions, and how far the others stand out, mm.

    Distance to a convex set is a convex function, so over the whole hull it is largest at a corner.
    """
    if len(corners) <= COARSE_DIRECTIONS:
        return corners, 0.0
    few = corners[np.unique(np.argmax(even_directions(COARSE_DIRECTIONS) @ corners.T, axis=1))]
    hull = scipy.spatial.ConvexHull(few)
    outside = (corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > -SLACK_MM  # beyond a face
    triangles = np.ascontiguousarray(few[hull.simplices])
    return few, float(farthest_from(triangles, corners[outside])) + SLACK_MM


def neighbours(corners: Floats) -> tuple[Ints, Ints]:
    """Which corners (n, 3) of a convex hull share an edge of its triangles; a corner within the hull has none.

    How many neighbours each corner has, shape (n,), and the rows of the first corner's, of the second's, and so on.
    """
    faces = scipy.spatial.ConvexHull(corners).simplices
    edges = np.concatenate([np.roll(faces, turn, axis=1)[:, :2] for turn in range(3)])  # each face's three
    pairs = np.unique(np.concatenate([edges, edges[:, ::-1]]), axis=0).astype(np.int64)
    return np.bincount(pairs[:, 0], minlength=len(corners)), pairs[:, 1]


def in_frame(corners: Floats, body: Body) -> Floats:
    """Corners (n, 3) of a body's shapes in the frame that it moves with."""
    return np.asarray(apply(body.T_frame_body, corners))


def joint_levers(model: UrModel, check: Check) -> Floats:
    """How far a rotation of each joint (6,) may move the second body against the first, mm/rad.

    A body's point is no farther from a joint's axis than the links between reach, end to end, and the body itself.
    Only the joints between the two bodies move them against one another.
    """
    levers = np.zeros(6)
    if check.hulls is None or check.first_body is None:
        return levers
    body = check.second_body
    own = np.linalg.norm(apply(body.T_frame_body, check.hulls[1]), axis=1).max()  # from its frame's origin
    lengths = np.hypot(model.a, model.d)
    for joint in range(check.first_body.frame, body.frame):
        levers[joint] = abs(model.a[joint]) + lengths[joint + 1 : body.frame].sum() + own
    return levers


def packed_movers(checks: Sequence[Check]) -> Movers:
    """The moving piece of each check, or all of a body for the skin."""
    rows: dict[int, int] = {}
    frames, spheres, mover = [], [], []
    for check in checks:
        body = check.second_body
        key = id(body) if check.hulls is None else id(check.hulls[1])
        if key not in rows:
            rows[key] = len(rows)
            corners = np.concatenate(body.full.hulls) if check.hulls is None else check.hulls[1]
            frames.append(body.frame)
            spheres.append(enclosing_sphere(in_frame(corners, body)))
        mover.append(rows[key])
    centres, radii = np.array([sphere.centre for sphere in spheres]), np.array([sphere.radius for sphere in spheres])
    return Movers(np.array(mover, dtype=np.int64), np.array(frames, dtype=np.int64), centres, radii)


LEAF_TRIANGLES = 4
"""At most so many triangles in a leaf."""


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """A heap of boxes: the children of node i are 2 i + 1 and 2 i + 2; the last level's nodes are the leaves."""

    lows: Floats  # shape (nodes, 3), mm: lowest corner of each node's box
    highs: Floats  # shape (nodes, 3), mm
    corners: Floats
    """Shape (leaves, k, 3, 3), mm: the triangles of each leaf; some stand in two, so that all have k."""
    rows: NDArray[np.int32]  # shape (leaves, k): which of the mesh's triangles they are

    @classmethod
    def of(cls, mesh: TriangleMesh, cache: Cache = NO_CACHE) -> TriangleTree:
        """The tree of a mesh that has been checked: finite, not empty.

        Its leaves are cached. What costs little to make from them is not: it is six times as large.
        """
        made_from = {"what": "leaves", "surface": mesh.digest}
        return cache.value(made_from, lambda: _leaves(mesh), partial(cls._of_leaves, mesh), by=__name__)

    @classmethod
    def _of_leaves(cls, mesh: TriangleMesh, leaves: Arrays) -> TriangleTree:
        """The tree from its leaves' boxes and rows."""
        rows = leaves["rows"]
        _check_leaves(mesh, leaves)
        lows, highs = [leaves["lows"]], [leaves["highs"]]
        while len(lows[0]) > 1:
            lows.insert(0, np.minimum(lows[0][::2], lows[0][1::2]))
            highs.insert(0, np.maximum(highs[0][::2], highs[0][1::2]))
        corners = mesh.vertices.take(mesh.faces.take(rows, axis=0).reshape(-1), axis=0).reshape(*rows.shape, 3, 3)
        arrays = np.concatenate(lows), np.concatenate(highs), corners
        for array in arrays:
            array.setflags(write=False)  # as all that comes from the cache: kernels are compiled for one kind
        return cls(*arrays, rows)


def _leaves(mesh: TriangleMesh) -> Arrays:
    """Which triangles share a leaf, and the leaves' boxes, as in `TriangleTree`.

    Each level halves every node's triangles at the median of their centres along its longest side.
    """
    triangles = mesh.triangles
    levels = max(0, int(np.ceil(np.log2(len(triangles) / LEAF_TRIANGLES))))
    size = -(-len(triangles) // 2**levels)
    order = np.minimum(np.arange(size * 2**levels), len(triangles) - 1)[None, :]
    centres = triangles.mean(axis=1)
    for _ in range(levels):
        inside = centres[order]
        axis = np.ptp(inside, axis=1).argmax(axis=1)
        keys = np.take_along_axis(inside, axis[:, None, None], axis=2)[:, :, 0]
        order = np.take_along_axis(order, np.argsort(keys, axis=1), axis=1).reshape(2 * len(order), -1)
    corners = triangles[order]
    return {"rows": order.astype(np.int32), "lows": corners.min(axis=(1, 2)), "highs": corners.max(axis=(1, 2))}


def _check_leaves(mesh: TriangleMesh, leaves: Arrays) -> None:
    """Refuse leaves that leave out a triangle, which an arm could touch then and nobody would know."""
    rows, boxes = leaves["rows"], (leaves["lows"], leaves["highs"])
    if rows.dtype != np.int32 or any(box.dtype != np.float64 or box.shape != (len(rows), 3) for box in boxes):
        raise TypeError("leaves of other types than ours")
    in_leaf = np.zeros(len(mesh.faces), np.bool_)
    if rows.ndim != 2 or len(rows).bit_count() != 1 or rows.min() < 0 or rows.max() >= len(in_leaf):
        raise ValueError("no leaves of this mesh")
    in_leaf[rows] = True
    if not in_leaf.all():
        raise ValueError("a triangle is in no leaf")


FIELD_MARGIN_MM = 500.0
"""How far around the skin distances are kept: beyond, they are seldom needed."""
MOST_CELLS = 4_000_000
"""Cells of that field at most (16 MB): a larger skin gets a narrower margin."""


def packed_skin(patient: TriangleMesh | None, skin_triangles: int, cache: Cache) -> SkinTree:
    """The tree of the skin and the solids outside it, with an empty field of distances; empty without a patient."""
    if patient is None:
        nothing = (np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1, 3, 3)))
        return SkinTree(nothing, np.zeros((1, 1, 1), np.float32), np.zeros(3), np.zeros((1, 1), np.bool_))
    leaves, (low, high) = TriangleTree.of(patient, cache), patient.bounds
    margin = FIELD_MARGIN_MM
    while np.prod(cells := np.ceil((high - low + 2.0 * margin) / CELL_MM).astype(np.int64)) > MOST_CELLS:
        margin = margin / 2.0 if margin > 1.0 else 0.0
        if margin == 0.0:
            cells = np.ones(3, np.int64)
            break
    tree, field = (leaves.lows, leaves.highs, leaves.corners), np.full(cells, np.nan, np.float32)
    return SkinTree(tree, field, low - margin, leaves.rows >= skin_triangles)
