"""The checks of one cell as compiled code takes them: hulls, spheres and the skin's tree, packed once."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.tool import Box
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.cache.array_cache import Arrays, Cache
from puncture_twin.planning.collision import bounding_spheres as enclosures
from puncture_twin.planning.collision.bodies import Body
from puncture_twin.planning.collision.bounding_spheres import (
    SphereTree,
    coarse_hull,
    enclosing_sphere,
    inscribed_prism,
    neighbours,
    sphere_tree,
)
from puncture_twin.planning.collision.checker import Check, Contact
from puncture_twin.planning.collision.kernels import proofs as proof_kernels
from puncture_twin.planning.collision.kernels.hulls import Hulls
from puncture_twin.planning.collision.kernels.proofs import Movers, ProofScene, SkinTree, scratch
from puncture_twin.planning.collision.kernels.surfaces import CELL_MM
from puncture_twin.planning.collision.patient import FclPatient
from puncture_twin.planning.collision.triangle_tree import TriangleTree
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.geometry.rigid import apply

_Axes = tuple[Floats, Floats, Floats]

WORKCELL_FRAME = 0
"""The frame of what does not move: the base's."""

NO_BOX = -1.0
"""Half sizes of what is no box."""

FIELD_MARGIN_MM = 500.0
"""How far around the skin distances are kept: beyond, they are seldom needed."""

MOST_CELLS = 4_000_000
"""Of that field (16 MB): a larger skin gets a narrower margin."""

ROUND = ("holder", "needle")
"""Bodies that are cylinders: their hulls are prisms about them."""


class Motion(NamedTuple):
    """A path as the compiled code takes it, see :func:`proof_kernels.first_unproven`."""

    frames: Floats
    moved: Floats
    rotated: Floats


class Around(NamedTuple):
    """What :meth:`Proofs.clear_about` leaves open."""

    touching: Bools
    """Shape (m, k): at the state itself the reference must be queried, and is likely to find that something touches."""
    unproven: Bools
    """Shape (m, k): the checks open about each state."""


class Proofs:
    """The checks of one cell, ready to be proven. Not for several threads: the scratch is shared.

    ``joint_spans`` (k, 3) says of each check whether it is between two bodies of the arm, and the frames of both.

    Args:
        model: The arm.
        checks: The questions, in order.
        boxes: The workcell's boxes.
        patient: The skin, or None.
        cache: Where enclosures are kept: they depend on arm and tool alone.
    """

    def __init__(
        self, model: UrModel, checks: Sequence[Check], boxes: Sequence[Box], patient: TriangleMesh | None, cache: Cache
    ) -> None:
        hulls, rows = _Hulls(boxes), []
        roots, spheres = _trees([check.second_body for check in checks if check.hulls is None], cache)
        for check in checks:
            frame = check.second_body.frame
            if check.hulls is None:
                row = (proof_kernels.SKIN, -1, roots[check.second_body.name], WORKCELL_FRAME, frame)
            elif check.first_body is None:
                second = hulls.add(check.hulls[1], check.second_body)
                row = (proof_kernels.BOX, hulls.box(check.contact.other), second, WORKCELL_FRAME, frame)
            else:
                assert check.hulls[0] is not None  # only a box has none, and it belongs to no body
                pair = (hulls.add(check.hulls[0], check.first_body), hulls.add(check.hulls[1], check.second_body))
                row = (proof_kernels.PAIR, *pair, check.first_body.frame, frame)
            rows.append(row)
        self.scene = ProofScene(np.array(rows, dtype=np.int64), _skin(patient, cache), spheres, *hulls.packed(cache))
        self._levers = np.array([_levers(model, check) for check in checks])
        self.movers = _moving(checks)
        self._work = scratch(len(rows), len(self.scene.hulls.radii))
        self._proven = np.empty(len(rows))
        self.joint_spans = np.array([(row[0] == proof_kernels.PAIR, row[3], row[4]) for row in rows], dtype=np.int64)

    def __len__(self) -> int:
        return len(self._proven)

    def drop(self, never: Bools) -> None:
        """Drop some checks (k,) for good: the others keep their order."""
        kept = ~never
        self.scene = self.scene._replace(checks=self.scene.checks[kept])
        self.movers = self.movers._replace(of_check=self.movers.of_check[kept])
        self._levers, self.joint_spans = self._levers[kept], self.joint_spans[kept]
        self._work, self._proven = scratch(int(kept.sum()), len(self.scene.hulls.radii)), self._proven[kept].copy()

    def first_unproven(
        self, motion: Motion, begin: int, tested: Bools, clear_mm: float = proof_kernels.MIN_GAP_MM
    ) -> int:
        """The first check at or after ``begin``, counted as state * checks + check, that is not proven; -1 for none.

        Args:
            motion: The states, in order.
            begin: 0 for a new path.
            tested: Shape (k,): which checks.
            clear_mm: What the distance must exceed.
        """
        if begin == 0:
            self._proven.fill(-np.inf)
        at = divmod(begin, len(self._proven))
        arguments = (self.scene, self._levers, tuple(motion), self._work, self._proven, *at, tested, clear_mm)
        return int(proof_kernels.first_unproven(*arguments))

    def unproven_at_each(self, frames: Floats, begins: Ints, tested: Bools) -> Ints:
        """Of each state by itself the first check that is not proven, at or after one; -1 for none.

        Args:
            frames: Shape (m, 7, 4, 4), mm.
            begins: Shape (m,): where to begin; ``len(self)`` to pass a state over.
            tested: Shape (k,): which checks.
        """
        found = np.empty(len(frames), dtype=np.int64)
        proof_kernels.unproven_at_each(self.scene, frames, self._work, tested, begins, found)
        return found

    def clear_about(self, frames: Floats, turns: Floats, tested: Bools) -> Around:
        """Prove checks clear all about some states.

        Args:
            frames: Shape (m, 7, 4, 4), mm: the states.
            turns: Shape (6,), rad: how far each joint may turn either way from each of them.
            tested: Shape (m, k): what is to be proven.
        """
        unproven, gaps = tested.copy(), np.full(tested.shape, np.inf)
        proof_kernels.clear_about(self.scene, self.movers, frames, turns, self._work, gaps, unproven)
        return Around(gaps <= 0.0, unproven)


def fcl_contact(check: Check, frames: Floats) -> Contact | None:
    """The contact, if the shapes of a check touch where ``link_poses`` (7, 4, 4) has them."""
    check.second.setTransform(check.second_body.pose(frames))
    if check.first_body is not None:
        assert not isinstance(check.first, FclPatient)  # it belongs to no body
        check.first.setTransform(check.first_body.pose(frames))
    return check.met()


def _levers(model: UrModel, check: Check) -> Floats:
    """How far a turn of each joint (6,) may move the second body against the first, mm/rad.

    A body's point is no farther from a joint's axis than the links between reach, end to end, and the body itself.
    Only the joints between the two bodies move them against one another.
    """
    levers = np.zeros(6)
    if check.hulls is None or check.first_body is None:
        return levers
    body = check.second_body
    own = np.linalg.norm(apply(body.T_frame_body, check.hulls[1]), axis=1).max()
    lengths = np.hypot(model.a, model.d)
    for joint in range(check.first_body.frame, body.frame):
        levers[joint] = abs(model.a[joint]) + lengths[joint + 1 : body.frame].sum() + own
    return levers


def _moving(checks: Sequence[Check]) -> Movers:
    """The piece that each check is about, or all of a body for the skin."""
    rows: dict[int, int] = {}
    frames, spheres, mover = [], [], []
    for check in checks:
        body = check.second_body
        key = id(body) if check.hulls is None else id(check.hulls[1])
        if key not in rows:
            rows[key] = len(rows)
            corners = np.concatenate(body.full.hulls) if check.hulls is None else check.hulls[1]
            frames.append(body.frame)
            spheres.append(enclosing_sphere(_in_frame(corners, body)))
        mover.append(rows[key])
    centres, radii = np.array([sphere.centre for sphere in spheres]), np.array([sphere.radius for sphere in spheres])
    return Movers(np.array(mover, dtype=np.int64), np.array(frames, dtype=np.int64), centres, radii)


def _in_frame(corners: Floats, body: Body) -> Floats:
    """Corners (n, 3) of a body's shapes in the frame that it moves with."""
    return np.asarray(apply(body.T_frame_body, corners))


class _Hulls:
    """Convex hulls, each once: the boxes first."""

    def __init__(self, boxes: Sequence[Box]) -> None:
        self._rows: dict[int, int] = {}
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
            self._corners.append(_in_frame(corners, body))
            self._rounded.append(body.name in ROUND)
            self._frames.append(body.frame)
        return row

    def packed(self, cache: Cache) -> tuple[Hulls, Floats, Floats]:
        """``hulls``, ``T_box_base`` and ``halves`` of :class:`ProofScene`."""
        count = len(self._boxes)
        boxes, bodies = _enclosed(self._corners[:count]), self._corners[count:]
        arm = cache.arrays(made_from("hulls", bodies), lambda: _enclosed(bodies), by=__name__)
        centres, radii, slack, sizes, few, degrees = (
            np.concatenate([boxes[key], arm[key]]) for key in ("centres", "radii", "slack", "sizes", "few", "degrees")
        )
        neighbours = np.concatenate([boxes["neighbours"], arm["neighbours"] + sum(map(len, self._corners[:count]))])
        poses, halves = np.tile(np.eye(4), (len(self._corners), 1, 1)), np.full((len(self._corners), 3), NO_BOX)
        for row, box in enumerate(self._boxes):
            poses[row], halves[row] = np.linalg.inv(box.T_base_box), np.asarray(box.size_mm) / 2.0
        corners, pieces = np.concatenate(self._corners), zip(self._corners, self._rounded, strict=True)
        inner = np.concatenate([inscribed_prism(piece) if about else piece for piece, about in pieces])
        starts, around = _starts([len(piece) for piece in self._corners]), np.array(self._rounded)
        few_axes, frames = (_axes(few), _starts(sizes)), np.array(self._frames, dtype=np.int64)
        links = (_starts(degrees), neighbours)
        hulls = Hulls(_axes(corners), starts, *few_axes, slack, corners, inner, around, *links, centres, radii, frames)
        return hulls, poses, halves


def _enclosed(hulls: Sequence[Floats]) -> Arrays:
    """Of each convex hull a sphere about it and a coarse hull: their numbers, one array each."""
    spheres, coarse = [enclosing_sphere(corners) for corners in hulls], [coarse_hull(corners) for corners in hulls]
    edges, first = [neighbours(corners) for corners in hulls], _starts([len(corners) for corners in hulls])
    rows = [hull.rows + start for hull, start in zip(edges, first[:-1], strict=True)]
    return {
        "centres": np.array([sphere.centre for sphere in spheres]).reshape(-1, 3),
        "radii": np.array([sphere.radius for sphere in spheres]),
        "slack": np.array([hull.slack_mm for hull in coarse]),
        "sizes": np.array([len(hull.corners) for hull in coarse], dtype=np.int64),
        "few": np.concatenate([np.empty((0, 3)), *(hull.corners for hull in coarse)]),
        "degrees": np.concatenate([np.empty(0, np.int64), *(hull.degrees for hull in edges)]),
        "neighbours": np.concatenate([np.empty(0, np.int64), *rows]),
    }


def made_from(what: str, pieces: Sequence[NDArray[Any]]) -> dict[str, object]:
    """What decides a result about some convex pieces, for the cache: their corners and how they are enclosed."""
    digest = hashlib.sha256()
    for corners in pieces:
        digest.update(f"{corners.shape}".encode())
        digest.update(np.ascontiguousarray(corners).tobytes())
    return {"what": what, "pieces": digest.hexdigest(), **enclosures.settings()}


def _starts(sizes: Sequence[int] | Ints) -> Ints:
    return np.concatenate([[0], np.cumsum(sizes, dtype=np.int64)]).astype(np.int64)


def _axes(points: Floats) -> _Axes:
    x, y, z = (np.ascontiguousarray(axis) for axis in points.T)
    return x, y, z


def _skin(patient: TriangleMesh | None, cache: Cache) -> SkinTree:
    """The skin's tree and its field, of which nothing is known yet; or some that no check wants."""
    if patient is None:
        nothing = (np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 1, 3, 3)))
        return SkinTree(nothing, np.zeros((1, 1, 1), np.float32), np.zeros(3))
    made_from, (low, high) = {"what": "skin", "surface": patient.digest}, patient.bounds
    kept = cache.arrays(made_from, lambda: vars(TriangleTree.of(patient)), by=__name__)
    margin = FIELD_MARGIN_MM
    while np.prod(cells := np.ceil((high - low + 2.0 * margin) / CELL_MM).astype(np.int64)) > MOST_CELLS:
        margin = margin / 2.0 if margin > 1.0 else 0.0
        if margin == 0.0:
            cells = np.ones(3, np.int64)
            break
    return SkinTree((kept["lows"], kept["highs"], kept["corners"]), np.full(cells, np.nan, np.float32), low - margin)


def _tree_arrays(pieces: Sequence[Floats]) -> Arrays:
    return dict(vars(sphere_tree(pieces)))


def _trees(bodies: Sequence[Body], cache: Cache) -> tuple[dict[str, int], tuple[Floats, Floats, Ints]]:
    """The spheres of the bodies' full shapes, each in the body's frame, and the row of each body's root."""
    roots: dict[str, int] = {}
    centres, radii, children = [np.empty((0, 3))], [np.empty(0)], [np.empty((0, 2), np.int64)]
    for body in bodies:
        pieces = [_in_frame(hull, body) for hull in body.full.hulls]
        tree = SphereTree(**cache.arrays(made_from("balls", pieces), partial(_tree_arrays, pieces), by=__name__))
        start = sum(len(part) for part in radii)
        roots[body.name] = start
        centres.append(tree.centres)
        radii.append(tree.radii)
        children.append(np.where(tree.children < 0, -1, tree.children + start))
    return roots, (np.concatenate(centres), np.concatenate(radii), np.concatenate(children))
