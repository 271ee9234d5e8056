"""The patient as FCL is asked about it: the skin and what else the CT shows, in parts that are made when needed."""

from __future__ import annotations

from functools import cached_property
from typing import NamedTuple

import fcl
import numpy as np

from puncture_twin.planning.anatomy.anatomy import OUTSIDE_BODY
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies.body import Body
from puncture_twin.planning.collision.bodies.shapes import surface, touch
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.collision.loose_parts import LooseParts, within
from puncture_twin.planning.collision.state_checker import PATIENT
from puncture_twin.planning.geometry.kd_order import kd_order
from puncture_twin.planning.geometry.mesh import TriangleMesh, box_of

PART_TRIANGLES = 8192
"""So many triangles share a tree: FCL takes some 4 us to build for each, and 20 us to ask a tree."""

ROUNDING_MM = 1e-6
"""By how much a body's box is grown: far above the rounding of its pose."""


class FclSkin:
    """A surface in parts, each with a tree of its own, which FCL builds when a body first comes near the part.

    To build a tree takes longer than most questions, and the arm comes near to few parts of a patient. FCL judges a
    triangle by itself, whichever tree it stands in, so the surface touches what one of its parts touches.

    Args:
        mesh: The surface, mm.
        name: Of it, for who is told of its fault.

    Raises:
        InputError: FCL calls a NaN vertex free and dies of an index out of range: so that is looked for first.
    """

    def __init__(self, mesh: TriangleMesh, name: str) -> None:
        count = len(mesh.vertices)
        usable = len(mesh.faces) > 0 and bool(np.isfinite(mesh.vertices).all())
        if not usable or mesh.faces.min() < 0 or mesh.faces.max() >= count:
            what = "mesh is empty, not finite or has an index out of range"
            raise InputError(what, where=name, allowed="a checked mesh")
        self._mesh = mesh

    def touches(self, solid: Solid, box: Floats) -> bool:
        """Whether a body touches the surface where it stands.

        Args:
            solid: The body.
            box: Shape (2, 3), mm: lowest and highest corner of a box about it, in its own frame.
        """
        return any(touch(self._tree(part), solid.made) for part in self._near(solid.pose, box))

    def collides_with(self, body: Body) -> bool:
        """Whether a body touches the surface where it stands, or has a part of it within."""
        return self.touches(body.full.surface, body.box) or self.has_part_within(body)

    def has_part_within(self, body: Body) -> bool:
        """Whether a connected part of the surface lies within a link where it stands.

        Of a link FCL sees the surface, which such a part does not touch. Holder and needle are solid for it.

        Args:
            body: One that :meth:`touches` has found to touch nothing.
        """
        pose = body.full.surface.pose
        if not body.hollow or not self._near(pose, body.box):
            return False
        small = self._loose.no_larger_than(float(np.linalg.norm(body.box[1] - body.box[0])))
        points = (small.corners - pose.getTranslation()) @ pose.getRotation()
        near = np.all((points >= body.box[0]) & (points <= body.box[1]), axis=1)
        return bool(near.any()) and bool(within(points[near], body.half_spaces).any())

    def _near(self, pose: fcl.Transform, box: Floats) -> list[int]:
        """The parts that a box about a body, in the body's frame, may meet where the body stands."""
        low, high = _bounds_at(pose, box)
        near = np.all((self._bounds[:, 1] >= low) & (self._bounds[:, 0] <= high), axis=1)
        found: list[int] = np.flatnonzero(near).tolist()
        return found

    @cached_property
    def _loose(self) -> LooseParts:
        return LooseParts.of(self._mesh)

    @cached_property
    def _parts(self) -> list[Ints]:
        """The triangles of each part: rows of the mesh's faces."""
        order = kd_order(self._mesh.triangles.mean(axis=1), PART_TRIANGLES)
        return np.split(order, range(PART_TRIANGLES, len(order), PART_TRIANGLES))

    @cached_property
    def _bounds(self) -> Floats:
        """Shape (parts, 2, 3), mm: a box about each part."""
        return np.array([box_of(self._mesh.triangles[part].reshape(-1, 3)) for part in self._parts])

    @cached_property
    def _trees(self) -> dict[int, fcl.CollisionObject]:
        return {}

    def _tree(self, part: int) -> fcl.CollisionObject:
        if part not in self._trees:
            faces = self._mesh.faces[self._parts[part]]
            used, corners = np.unique(faces, return_inverse=True)
            piece = TriangleMesh(self._mesh.vertices[used], corners.reshape(faces.shape).astype(np.int32))
            self._trees[part] = fcl.CollisionObject(surface(piece))
        return self._trees[part]


class FclPatient(NamedTuple):
    """The skin, and what besides it is not to be touched."""

    skin: FclSkin
    outside: FclSkin | None

    def touched_part(self, body: Body) -> str | None:
        """What of it a body touches where it stands: the skin, ``outside_body`` where that is all, or None."""
        if self.skin.collides_with(body):
            return PATIENT
        return OUTSIDE_BODY if self.outside is not None and self.outside.collides_with(body) else None


def _bounds_at(pose: fcl.Transform, box: Floats) -> tuple[Floats, Floats]:
    """Lowest and highest corner (3,) of a box about a body's own box where the body stands."""
    R = pose.getRotation()
    centre = R @ (0.5 * (box[0] + box[1])) + pose.getTranslation()
    reach = np.abs(R) @ (0.5 * (box[1] - box[0])) + ROUNDING_MM
    return centre - reach, centre + reach
