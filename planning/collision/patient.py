"""The patient and single checks as FCL sees them: the skin and what else the CT shows, in parts built on demand.

A `Check` is one query to FCL. A base that stands in the patient is refused, and so is a tool of the user's own that
hangs on nothing: one that floats could lie wholly in the patient, unseen.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import NamedTuple

import fcl
import numpy as np

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.arm.tool import ToolBody
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import refuse
from puncture_twin.planning.collision.bodies import (
    FLANGE_FRAME,
    Body,
    LooseParts,
    Solid,
    convex,
    padded,
    surface,
    touch,
    within,
)
from puncture_twin.planning.collision.state_checker import PATIENT, Contact
from puncture_twin.planning.geometry.containment import Side, side_of, winding_number
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of

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
        """Whether a body touches the surface where it is.

        Args:
            box: Shape (2, 3), mm: lowest and highest corner of a box about it, in its own frame.
        """
        return any(touch(self._tree(part), solid.made) for part in self._near(solid.pose, box))

    def collides_with(self, body: Body) -> bool:
        """Whether a body touches the surface where it is, or has a part of it within."""
        return self.touches(body.full.surface, body.box) or self.has_part_within(body)

    def has_part_within(self, body: Body) -> bool:
        """Whether a connected part of the surface lies within a link where it is.

        Of a link FCL sees the surface, which such a part does not touch. Holder and needle are solid for it.

        Args:
            body: One that :meth:`touches` has found to touch nothing.
        """
        pose = body.full.surface.pose
        if not body.hollow or not self._near(pose, body.box):
            return False
        small = np.linalg.norm(self._loose.sizes, axis=1) <= float(np.linalg.norm(body.box[1] - body.box[0]))
        points = (self._loose.corners[small] - pose.getTranslation()) @ pose.getRotation()
        near = np.all((points >= body.box[0]) & (points <= body.box[1]), axis=1)
        return bool(near.any()) and bool(within(points[near], body.half_spaces).any())

    def _near(self, pose: fcl.Transform, box: Floats) -> list[int]:
        """Parts of the surface that a box about a body, in the body's frame, may touch."""
        R = pose.getRotation()
        centre = R @ (0.5 * (box[0] + box[1])) + pose.getTranslation()
        reach = np.abs(R) @ (0.5 * (box[1] - box[0])) + ROUNDING_MM
        near = np.all((self._bounds[:, 1] >= centre - reach) & (self._bounds[:, 0] <= centre + reach), axis=1)
        found: list[int] = np.flatnonzero(near).tolist()
        return found

    @cached_property
    def _loose(self) -> LooseParts:
        return LooseParts.of(self._mesh)

    @cached_property
    def _parts(self) -> list[Ints]:
        order = kd_order(self._mesh.triangles.mean(axis=1), PART_TRIANGLES)
        return np.split(order, range(PART_TRIANGLES, len(order), PART_TRIANGLES))

    @cached_property
    def _bounds(self) -> Floats:
        return np.array([box_of(self._mesh.triangles[part].reshape(-1, 3)) for part in self._parts])

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

    contact: Contact
    """What it means if they do."""
    first: Solid | FclPatient
    """The patient, a box, or a piece of a body."""
    second: Solid
    first_body: Body | None
    """The body that ``first`` moves with; None for skin and boxes."""
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


APART_MM = 1.0
"""What a mesh may leave between its parts, or to the flange: less than a gap through which a surface could pass."""

CARRIERS = ("wrist_3", "holder", "needle")
"""What a tool is bolted to."""


def check_hanging(tool: ToolBody, bodies: Sequence[Body]) -> None:
    """Refuse a tool of which a part touches neither wrist, holder nor needle, nor a part that does.

    Args:
        bodies: Of the arm; those of the flange all move with one frame.

    Raises:
        InputError: Says how large the tool is and where it lies.
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
