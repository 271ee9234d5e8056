"""The reference collision checker: FCL for an arm with its needle against the patient's skin and the workcell.

FCL sees the surfaces of triangle meshes, not their insides. Links, holder, needle and boxes are therefore solid
convex shapes here, and two of them never hide in one another. The skin is a triangle mesh, and the arm cannot hide in
it either: neighbouring bodies of the chain overlap (a test holds this), the base is outside (checked once), so if
no body touches a closed skin every body is on the base's side of it. For an open skin there is no inside, and only its
surface counts. What is loose (a block of the table) could hide in a link: see `FclSkin`.

`SweptBodies` bounds the motion between two configurations: every sampled collision check rests on it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, partial
from itertools import combinations, pairwise, product
from types import MappingProxyType

import fcl
import numpy as np
import scipy

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.kinematics import link_frames, link_poses
from puncture_twin.planning.arm.links import Link, collision_links, model_urdf
from puncture_twin.planning.arm.tool import Box, Tool, ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.collision.bodies import (
    DISTANCE_PAIRS,
    NEEDLE_IN_PATIENT,
    NEVER_TESTED,
    NEVER_TOUCHING,
    PATIENT,
    Body,
    Check,
    Contact,
    Distances,
    FclPatient,
    FclSkin,
    FirstContact,
    Nearest,
    Solid,
    arm_bodies,
    convex,
    padded,
    require_finite,
    surface,
    touch,
)
from puncture_twin.planning.geometry.containment import Side, side_of, winding_number
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined
from puncture_twin.planning.geometry.rigid import apply


@dataclass(frozen=True, eq=False)
class SweptBodies:
    """Boxes about the moving bodies, to bound their motion."""

    model: UrModel
    tool: Tool
    corners: Floats
    """Shape (6, 8, 3), mm: a box about each moving link in its frame, the last with all on the flange."""
    longest_lever_mm: float  # no body point is ever farther from a joint's axis than this

    @classmethod
    def of(cls, model: UrModel, tool: Tool, padding_mm: float = 0.0) -> SweptBodies:
        """The boxes about a model's links and a tool, each grown by ``padding_mm`` on every side."""
        boxes = [link.mesh.bounds for link in collision_links(model)[1:]]
        radius = max(tool.holder_diameter_mm, tool.needle_diameter_mm) / 2.0
        reach = np.array([[-radius, -radius, tool.holder_span_mm[0]], [radius, radius, tool.needle_length_mm]])
        boxes[-1] = np.stack([np.minimum(boxes[-1][0], reach[0]), np.maximum(boxes[-1][1], reach[1])])
        if tool.body is not None:
            low, high = tool.body.mesh.bounds
            boxes[-1] = np.stack([np.minimum(boxes[-1][0], low), np.maximum(boxes[-1][1], high)])
        grown = [box + [[-padding_mm], [padding_mm]] for box in boxes]
        corners = np.stack([np.array(list(product(*box.T))) for box in grown])
        chain = abs(model.a2) + abs(model.a3) + model.d4 + model.d5 + model.d6
        return cls(model, tool, corners, float(chain + np.linalg.norm(corners, axis=-1).max()))

    def bounds_mm(self, q_path: Floats) -> Floats:
        """A bound on the motion of every point of each link along each straight joint segment of a path.

        Along a segment each point stays within half this bound of where it is at one of the two ends: the farthest
        chord of a box corner (a rigid displacement is affine, so a corner moves farthest), plus twice the sag of the
        curve over its chord, at most (sum of joint steps)^2 times the longest lever / 8. It also bounds how far a
        point ends up from where it started.

        Args:
            q_path: Shape (m, 6), rad.

        Returns:
            Shape (m - 1, 6), mm: shoulder, ..., wrist 3 with the tool.
        """
        path = np.array(q_path, dtype=np.float64, order="C")
        bounds = np.empty((len(path) - 1, 6))
        motion_bounds(link_poses(self.model, path), path, self.corners, self.longest_lever_mm, bounds)
        return bounds

    def rows_within(self, q_path: Floats, mm: float) -> Ints:
        """Rows of a path (m, 6), rad, its ends among them, at one of which no body is farther off than ``mm``.

        That holds for every state on the path, between its rows too, if no step from row to row is longer than twice
        that; where one is, both its ends are taken.
        """
        moved = np.concatenate([[0.0], np.cumsum(self.bounds_mm(q_path).max(axis=1))])
        rows, last = [0], len(moved) - 1
        for row in range(1, last):
            if moved[row + 1] - moved[rows[-1]] > 2.0 * mm:
                rows.append(row)
        return np.unique([*rows, last])

    def moving(self, q_path: Floats) -> tuple[Floats, Floats, Floats]:
        """A path's frames, and how far bodies and joints may have moved since its first state; ``q_path`` (m, 6), rad.

        Returns:
            T_base_link, shape (m, 7, 4, 4), mm; sums of :meth:`bounds_mm`, shape (m, 7), mm, the base's first; sums
            of each joint's turns, shape (m, 6), rad.
        """
        path = np.array(q_path, dtype=np.float64, order="C")
        frames, moved, rotated = np.empty((len(path), 7, 4, 4)), np.empty((len(path), 7)), np.empty((len(path), 6))
        _moving(self.model.lengths, path, self.corners, self.longest_lever_mm, frames, moved, rotated)
        return frames, moved, rotated


@nb.njit(cache=True)
def _moving(lengths, q, corners, lever, frames, moved, rotated):  # type: ignore[no-untyped-def]  # numba infers
    link_frames(lengths, q, frames)
    bounds = np.empty((len(q) - 1, 6))
    motion_bounds(frames, q, corners, lever, bounds)
    moved[0], rotated[0], moved[:, 0] = 0.0, 0.0, 0.0
    for k in range(len(q) - 1):
        for link in range(6):
            moved[k + 1, link + 1] = moved[k, link + 1] + bounds[k, link]
            rotated[k + 1, link] = rotated[k, link] + abs(q[k + 1, link] - q[k, link])


@allocation_free()
def motion_bounds(frames, q, corners, lever, bounds):  # type: ignore[no-untyped-def]  # numba infers
    """Fill ``bounds`` (m - 1, 6) from ``frames`` (m, 7, 4, 4), ``q`` (m, 6) and box ``corners`` (6, 8, 3).

    A NaN anywhere gives a NaN.
    """
    for k in range(len(q) - 1):
        rotated = 0.0
        for link in range(6):
            rotated += abs(q[k + 1, link] - q[k, link])
            here, there = frames[k, link + 1], frames[k + 1, link + 1]
            farthest = 0.0
            for c in range(8):
                squared = 0.0
                for i in range(3):
                    moved = there[i, 3] - here[i, 3]
                    for j in range(3):
                        moved += (there[i, j] - here[i, j]) * corners[link, c, j]
                    squared += moved * moved
                if not squared <= farthest:
                    farthest = squared
            bounds[k, link] = math.sqrt(farthest) + 2.0 * rotated * rotated * lever / 8.0


class CellChecker:
    """The reference checker: FCL's verdict on configurations of one arm, tool, workcell and patient.

    Not for several threads at once: the FCL objects are moved for each question.

    Args:
        model: The arm; its meshes must ship (UR3, UR5, UR10).
        boxes: Solids of the workcell, base frame. The base link is not tested against them: it is bolted to one.
        patient: The skin, base frame, mm; None for an empty workcell.
        outside: What is not to be touched besides (a table), likewise: the base may touch it, and contacts with it are
            named ``outside_body``.
        padding_mm: How much fuller the arm is for contacts with patient and boxes (not for distances, nor with itself):
            slack for what robot and registration get wrong. With 1 mm or more, free states between which no body moves
            more than 2 mm prove that the path between them touches neither patient nor box.

    Raises:
        InputError: If two boxes share a name, the patient's mesh is unusable, the base is in the patient, a shape of an
            own arm hangs on nothing, or an own tool does not hang on the flange.
    """

    def __init__(
        self,
        model: UrModel,
        tool: Tool,
        boxes: Sequence[Box] = (),
        patient: TriangleMesh | None = None,
        *,
        outside: TriangleMesh | None = None,
        padding_mm: float = 0.0,
    ) -> None:
        self.model = model
        self.tool = tool
        self._bodies = arm_bodies(model, tool, padding_mm)
        self._joined = {} if model.urdf is None else joined_pieces(model)
        if tool.body is not None:
            check_hanging(tool.body, self._bodies)
        self.swept = SweptBodies.of(model, tool)
        self.boxes = tuple(boxes)
        self._surface = patient if patient is None or outside is None else joined([patient, outside])
        self._patient = None
        if patient is not None:
            outside_skin = None if outside is None else FclSkin(outside, OUTSIDE_BODY)
            self._patient = FclPatient(FclSkin(patient, PATIENT), outside_skin)
        names, taken = [box.name for box in boxes], {PATIENT, *(body.name for body in self._bodies)}
        if len(set(names)) < len(names) or set(names) & taken:
            refuse(f"box names {names}", "cell", "unique names, not those of a body or the patient", "duplicate_name")
        self._boxes: dict[str, Solid] = {}
        for box in boxes:
            pose = fcl.Transform(box.T_base_box[:3, :3], box.T_base_box[:3, 3])
            self._boxes[box.name] = Solid(partial(fcl.Box, *box.size_mm), pose)
        self._bounds = {box.name: box.bounds for box in boxes}
        self._checks = (*self._workcell_checks(), *self._self_checks())
        if patient is not None and self._surface is not None and self._patient is not None:
            self._bounds[PATIENT] = self._surface.bounds
            refuse_base_in(model, self._bodies[0], self._patient, patient, self._surface)

    def points_of(self, body: str) -> Floats:
        """Corners (n, 3) of a body's convex pieces as they are, without padding, in the frame that it moves with."""
        pieces = [(one.T_frame_body, hull) for one in self._bodies if one.name == body for hull in one.bare.hulls]
        return np.concatenate([apply(T, corners) for T, corners in pieces])

    def contact(self, q: Floats, *, needle_may_touch_patient: bool) -> Contact | None:
        """The first contact found, or None when the arm is clear.

        Args:
            q: Shape (6,), rad.
            needle_may_touch_patient: True while the needle goes in. The holder may never touch.

        Raises:
            InputError: If ``q`` is not finite: FCL would call it free.
        """
        self._place(q)
        for check in self._checks:
            allowed = needle_may_touch_patient and check.contact == NEEDLE_IN_PATIENT
            if not allowed and (contact := check.contact_found()) is not None:
                return contact
        return None

    def contacts(
        self, q: Floats, *, needle_may_touch_patient: bool, round_clear: Bools | None = None
    ) -> list[Contact | None]:
        """First contact of each of many states, shape (n, 6), rad. Raises InputError: If a state is not finite.

        Where ``round_clear`` (n,) says so, holder and needle are known to touch neither patient nor boxes.
        """
        return [self.contact(state, needle_may_touch_patient=needle_may_touch_patient) for state in q]

    def folded(self, q: Floats) -> Bools:
        """Which of many states (n, 6), rad, have contact between links before the last joint: at any q6.

        Raises InputError: If a state is not finite.
        """
        before = [check for check in self._checks if check.before_last_joint]
        in_contact = np.zeros(len(q), np.bool_)
        for row, state in enumerate(q):
            self._place(state)
            in_contact[row] = any(check.contact_found() is not None for check in before)
        return in_contact

    def first_contact(self, q_path: Floats, *, needle_may_touch_patient: bool) -> FirstContact | None:
        """The first state of a path (m, 6), rad, with a contact, and the contact; None when all are clear.

        Raises InputError: If a state is not finite.
        """
        for index, q in enumerate(q_path):
            contact = self.contact(q, needle_may_touch_patient=needle_may_touch_patient)
            if contact is not None:
                return FirstContact(index, contact)
        return None

    def nearest(self, q: Floats, pair: str, body: str | None = None) -> Nearest:
        """The smallest distance of one kind, a ``pair`` of `DISTANCE_PAIRS`, at ``q`` (6,), rad; or of one body of it.

        Raises InputError: If ``q`` is not finite, or there is no such kind or body.
        """
        names = DISTANCE_PAIRS.get(pair, ())
        if not names or (body is not None and body not in names):
            where, allowed = f"distance {pair!r} of {body!r}", ", ".join(names or DISTANCE_PAIRS)
            refuse("no such distance", where, allowed, "unknown_choice")
        self._place(q)
        bodies = [b for b in self._bodies if (b.name in names if body is None else b.name == body)]
        skin = {} if self._surface is None else {PATIENT: self._whole}
        return _nearest(bodies, self._boxes if pair == "boxes" else skin, self._bounds)

    def distances(self, q: Floats) -> Distances:
        """Least distances of moving links and tool from patient and boxes at ``q`` (6,), rad.

        Raises InputError: If ``q`` is not finite.
        """
        return Distances(*(self.nearest(q, pair) for pair in DISTANCE_PAIRS))

    def sweep_mm(self, q_path: Floats) -> Floats:
        """Bound on every body's motion along each segment of a path (m, 6), rad: shape (m - 1,), mm.

        See :meth:`SweptBodies.bounds_mm`.
        """
        return np.asarray(self.swept.bounds_mm(q_path).max(axis=1))

    def body_sweeps_mm(self, q_path: Floats) -> dict[str, Floats]:
        """Bound on each moving body's motion along each segment, by name; the tool counts with wrist 3 as one."""
        bounds = self.swept.bounds_mm(q_path)
        return {body.name: bounds[:, body.frame - 1] for body in self._bodies[1:]}

    @cached_property
    def _whole(self) -> Solid:
        """The patient in one tree, for distances."""
        assert self._surface is not None
        return Solid(partial(surface, self._surface))

    def _workcell_checks(self) -> Iterator[Check]:
        for body in self._bodies[1:]:
            if self._patient is not None:
                yield Check(Contact(body.name, PATIENT), self._patient, body.full.surface, None, body, None)
            for name, box in self._boxes.items():
                for solid, hull in zip(body.full.solids, body.full.hulls, strict=True):
                    yield Check(Contact(body.name, name), box, solid, None, body, (None, hull))

    def _self_checks(self) -> Iterator[Check]:
        """Every pair of bodies that might touch, piece by piece; of an own arm's neighbours what is not joined."""
        left_out = NEVER_TESTED | NEVER_TOUCHING if self.model.urdf is None else NEVER_TESTED
        for first, second in combinations(self._bodies, 2):
            joined = self._joined.get((first.name, second.name))
            if joined is None and (first.name, second.name) in left_out:
                continue
            shapes = product(*(zip(body.bare.solids, body.bare.hulls, strict=True) for body in (first, second)))
            for number, ((a, hull_a), (b, hull_b)) in enumerate(shapes):
                if joined is not None and joined.flat[number]:
                    continue
                yield Check(Contact(second.name, first.name), a, b, first, second, (hull_a, hull_b))

    def _place(self, q: Floats) -> None:
        require_finite(q)
        poses = link_poses(self.model, q)
        for body in self._bodies[1:]:
            body.place(poses)


def _nearest(bodies: Sequence[Body], others: Mapping[str, Solid], bounds: Mapping[str, Floats]) -> Nearest:
    """The closest pair; pairs whose spheres cannot beat the best so far are passed over."""
    pairs = []
    for body in bodies:
        centre = np.asarray(body.bare.surface.pose.getTranslation())
        for name, other in others.items():
            low, high = bounds[name]
            gap = float(np.linalg.norm(np.maximum(0.0, np.maximum(low - centre, centre - high))))
            pairs.append((gap - body.radius_mm, body, name, other))
    best = Nearest(np.inf, "", "")
    for at_least, body, name, other in sorted(pairs, key=lambda pair: pair[0]):
        if at_least >= best.mm:
            break
        shapes = (body.bare.surface,) if name == PATIENT else body.bare.solids
        mm = min(fcl.distance(other.made, shape.made, fcl.DistanceRequest(), fcl.DistanceResult()) for shape in shapes)
        best = min(best, Nearest(max(0.0, float(mm)), body.name, name))  # FCL says -1 for contact
    return best


@cache
def joined_pieces(model: UrModel) -> Mapping[tuple[str, str], Bools]:
    """Which pieces of neighbouring links lie together at every angle of the joint between them.

    These are built into one another and never tested. Any other two of neighbouring links touch at some angles alone,
    as a camera on wrist 3 may touch wrist 2, or a folded forearm the upper arm: for these each state is tested.

    Returns:
        For the names of each link and the next, shape (pieces of the one, pieces of the other).
    """
    links = collision_links(model)
    solids = [[fcl.CollisionObject(convex(piece)) for piece in link.pieces] for link in links]
    joined = [_joined(model, links, solids, joint) for joint in range(len(links) - 1)]
    _check_hanging(model, links, solids, joined)
    names = pairwise(link.name for link in links)
    return MappingProxyType(dict(zip(names, joined, strict=True)))


ANGLES = 72
"""Angles at which a joint is tested, evenly over the turn: every 5 degrees."""
APART_MM = 1.0
"""mm between two pieces that still count as joined: too little for a surface to pass through."""
Solids = Sequence[Sequence[fcl.CollisionObject]]


def _joined(model: UrModel, links: Sequence[Link], solids: Solids, joint: int) -> Bools:
    """Which pieces of the two links at a joint lie within ``APART_MM`` of each other at every angle."""
    always = np.ones((len(solids[joint]), len(solids[joint + 1])), bool)
    for angle in 2.0 * np.pi * np.arange(ANGLES) / ANGLES:
        q = np.zeros(len(links) - 1)
        q[joint] = angle
        for link in (joint, joint + 1):
            _place(solids[link], link_poses(model, q)[links[link].frame])
        gaps = _gaps_mm(solids[joint], solids[joint + 1])
        if gaps.min() > 0.0:
            at = f"at {np.degrees(angle):g} degrees of their joint"
            what = f"the shapes of {links[joint].name} and {links[joint + 1].name} do not touch {at}"
            allowed = "connected links: check the unit, scale and origin of their meshes"
            refuse(what, model_urdf(model).where, allowed, "links_apart")
        always &= gaps <= APART_MM
    return always


def _check_hanging(model: UrModel, links: Sequence[Link], solids: Solids, joined: Sequence[Bools]) -> None:
    """Refuse an arm of which a piece is reached from the base by no chain of pieces that lie together."""
    ends = np.cumsum([0, *map(len, solids)])
    together = np.zeros((ends[-1], ends[-1]), np.bool_)
    for link, some in enumerate(solids):
        own = slice(ends[link], ends[link + 1])
        together[own, own] = _gaps_mm(some, some) <= APART_MM
        if link < len(joined):
            together[own, ends[link + 1] : ends[link + 2]] = joined[link]
    group = scipy.sparse.csgraph.connected_components(together, directed=False)[1]
    pieces = [(body.name, *piece.bounds) for body in links for piece in body.pieces]
    for row in np.flatnonzero(group != group[0])[:1].tolist():
        name, low, high = pieces[row]
        size = " x ".join(f"{edge:.4g}" for edge in high - low)
        what = f"a shape of {name}, {size} mm, is not connected"
        allowed = f"connected shapes, within {APART_MM:g} mm: check unit, scale and origin; or use one mesh"
        refuse(what, model_urdf(model).where, allowed, "shape_detached")


def _place(solids: Sequence[fcl.CollisionObject], T: Floats) -> None:
    for solid in solids:
        solid.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))


def _gaps_mm(first: Sequence[fcl.CollisionObject], second: Sequence[fcl.CollisionObject]) -> Floats:
    """Distances between pieces, shape (n, m), mm; at most 0 where they touch."""
    return np.array([[fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult()) for b in second] for a in first])


def refuse_base_in(
    model: UrModel, base: Body, placed: FclPatient, patient: TriangleMesh, surface: TriangleMesh
) -> None:
    """Refuse a base that is in the patient, or in what the CT shows outside of the body.

    Args:
        patient: The skin, base frame, mm.
        surface: The skin, and behind it what the CT shows besides, likewise; the same where that is nothing.
    """
    centre = collision_links(model)[0].mesh.bounds.mean(axis=0)
    hit = placed.skin.touches(base.bare.surface, base.box) or placed.skin.has_part_within(base)
    if hit or _encloses(patient, centre):
        refuse("the robot's base is in the patient", "workcell", "a base outside the skin", "base_in_patient")
    if surface is not patient and _encloses(surface, centre):
        what = "the robot's base is in space not known to be free: the table in the CT, or beyond the image"
        allowed = 'a base outside of it; if no body is there, [ct] arms = "none" or beyond_mm'
        refuse(what, "workcell", allowed, "base_in_unseen")


def _encloses(mesh: TriangleMesh, point: Floats) -> bool:
    """Whether a point lies inside a surface; more than half around an open one counts too."""
    low, high = mesh.bounds
    if not np.all((point >= low) & (point <= high)) and abs(winding_number(mesh, point)) <= 0.5:
        return False  # outside, or an open surface that goes less than half around: whether it is open does not matter
    side = side_of(mesh, point)
    return side is Side.INSIDE or (side is Side.UNKNOWN and abs(winding_number(mesh, point)) > 0.5)


CARRIERS = ("wrist_3", "holder", "needle")
"""Bodies that a tool may be bolted to."""


def check_hanging(tool: ToolBody, bodies: Sequence[Body]) -> None:
    """Refuse a tool of which a part touches neither wrist, holder nor needle, nor a part that does.

    A part that hangs on nothing could lie wholly in the patient, unseen. What is looked at of ``bodies``, the arm's,
    moves with the flange. Raises InputError: Says how large the tool is and where it lies.
    """
    free = [fcl.CollisionObject(convex(padded(piece, APART_MM))) for piece in tool.pieces]
    carriers = [body for body in bodies if body.name in CARRIERS]
    hanging: list[fcl.CollisionObject] = []
    for body in carriers:
        for solid in body.bare.solids:
            solid.place(fcl.Transform(body.T_frame_body[:3, :3], body.T_frame_body[:3, 3]))
            hanging.append(solid.made)
    while hanging and free:
        one = hanging.pop()
        hanging += [piece for piece in free if touch(one, piece)]
        free = [piece for piece in free if piece not in hanging]
    if free:
        low, high = tool.mesh.bounds
        span = " by ".join(f"{a:.4g}..{b:.4g}" for a, b in zip(low, high, strict=True))
        what = f"the tool ({span} mm in the flange's frame) is not connected to wrist, holder or needle"
        refuse(what, tool.key, "a connected body: check unit, position_mm, rotation_deg", "tool_detached")
