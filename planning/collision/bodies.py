"""The bodies of an arm with its tool, as FCL objects that move with the joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from types import MappingProxyType
from typing import NamedTuple

import fcl
import numpy as np

from puncture_twin.planning.arm.links import LINK_NAMES, Link, collision_links, joined
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.collision.bounding_spheres import prism
from puncture_twin.planning.collision.shapes import convex, padded, surface
from puncture_twin.planning.geometry.mesh_list import packed_meshes, unpacked_meshes
from puncture_twin.planning.geometry.rigid import pose

BODY_NAMES = (*LINK_NAMES, "tool", "holder", "needle")
"""The bodies of the arm, from the base on; not every arm has a tool."""

FLANGE_FRAME = 6
"""The frame of wrist 3, whose origin and axes are the flange's."""

NEVER_TESTED: Mapping[tuple[str, str], str] = MappingProxyType(
    {
        ("base", "shoulder"): "joined by a joint: they overlap at every angle",
        ("shoulder", "upper_arm"): "joined by a joint",
        ("upper_arm", "forearm"): "joined by a joint",
        ("forearm", "wrist_1"): "joined by a joint",
        ("wrist_1", "wrist_2"): "joined by a joint",
        ("wrist_2", "wrist_3"): "joined by a joint",
        ("wrist_3", "tool"): "bolted together",
        ("tool", "holder"): "bolted together",
        ("tool", "needle"): "bolted together",
        ("wrist_3", "holder"): "bolted together",
        ("wrist_3", "needle"): "bolted together",
        ("holder", "needle"): "bolted together",
        ("wrist_2", "holder"): "the holder begins at the flange, beyond wrist 2, and leads away from it at every angle",
        ("wrist_2", "needle"): "as the holder",
    }
)
"""Pairs that touch by construction, or cannot touch at all, with the reason."""


class Shape(NamedTuple):
    """A body for FCL: solid convex pieces, and one surface for the test against the skin."""

    solids: tuple[fcl.CollisionObject, ...]
    surface: fcl.CollisionObject
    hulls: tuple[Floats, ...]
    """For each solid, corners (n, 3), mm, of a convex hull that contains it, in the frame of the shapes."""


@dataclass(frozen=True, eq=False)
class Body:
    """One body of the arm.

    Attributes:
        name: One of ``BODY_NAMES``.
        frame: Index of its frame among ``link_poses``.
        T_frame_body: Shape (4, 4), mm: its shapes in that frame.
        bare: The body as it is.
        full: The body grown by the padding; ``bare`` itself where there is none.
        radius_mm: Every point of ``bare`` lies within this distance of the shapes' origin.
    """

    name: str
    frame: int
    T_frame_body: Floats
    bare: Shape
    full: Shape
    radius_mm: float

    @cached_property
    def box(self) -> Floats:
        """Shape (2, 3), mm: lowest and highest corner of a box about ``full``, in the frame of the shapes."""
        corners = np.concatenate(self.full.hulls)
        return np.array([corners.min(axis=0), corners.max(axis=0)])

    def pose(self, poses: Floats) -> fcl.Transform:
        """Where ``link_poses`` (7, 4, 4) has the body's shapes."""
        T = poses[self.frame] @ self.T_frame_body
        return fcl.Transform(T[:3, :3], T[:3, 3])

    def place(self, poses: Floats) -> None:
        """Move the shapes to where ``link_poses`` (7, 4, 4) has them."""
        transform = self.pose(poses)
        for shape in (self.bare,) if self.full is self.bare else (self.bare, self.full):
            for item in (*shape.solids, shape.surface):
                item.setTransform(transform)


def arm_bodies(model: UrModel, tool: Tool, padding_mm: float) -> tuple[Body, ...]:
    """All bodies, in the order of ``BODY_NAMES``, at the zero configuration of their own frames.

    Args:
        model: The arm.
        tool: What its flange carries.
        padding_mm: How much fuller ``full`` is than ``bare``.

    Raises:
        InputError: If the model's meshes do not ship, or the tool is flat.
    """
    own = () if tool.body is None else (Link("tool", FLANGE_FRAME, tool.body.pieces),)
    links = (*collision_links(model), *own)
    full = padded_links(links, padding_mm) if padding_mm else links
    return (
        *(_link_body(bare, more) for bare, more in zip(links, full, strict=True)),
        _round_body("holder", tool.holder_diameter_mm, tool.holder_span_mm, padding_mm),
        _round_body("needle", tool.needle_diameter_mm, tool.needle_span_mm, padding_mm),
    )


def padded_links(links: Sequence[Link], padding_mm: float) -> tuple[Link, ...]:
    """The links with every piece grown by the padding, from the user's cache where they are there."""
    pieces = [piece for link in links for piece in link.pieces]
    made_from = {"what": "padded", "padding_mm": padding_mm, "pieces": [piece.digest for piece in pieces]}

    def grown() -> Arrays:
        return packed_meshes([padded(piece, padding_mm) for piece in pieces])

    kept = user_cache().arrays(made_from, grown, by=__name__, check=unpacked_meshes)
    following = iter(unpacked_meshes(kept))
    return tuple(Link(link.name, link.frame, tuple(islice(following, len(link.pieces)))) for link in links)


def _link_body(link: Link, grown: Link) -> Body:
    bare = _link_shape(link)
    full = bare if grown is link else _link_shape(grown)
    radius_mm = float(np.linalg.norm(link.mesh.vertices, axis=1).max())
    return Body(link.name, link.frame, np.eye(4), bare, full, radius_mm)


def _link_shape(link: Link) -> Shape:
    solids = tuple(fcl.CollisionObject(convex(piece)) for piece in link.pieces)
    hulls = tuple(np.asarray(piece.vertices) for piece in link.pieces)
    return Shape(solids, fcl.CollisionObject(surface(joined(link.pieces))), hulls)


def _round_body(name: str, diameter_mm: float, span_mm: tuple[float, float], padding_mm: float) -> Body:
    length = span_mm[1] - span_mm[0]
    T_flange_body = pose(np.eye(3), [0.0, 0.0, (span_mm[0] + span_mm[1]) / 2.0])
    bare = _cylinder(diameter_mm / 2.0, length)
    full = _cylinder(diameter_mm / 2.0 + padding_mm, length + 2.0 * padding_mm) if padding_mm else bare
    radius_mm = float(np.hypot(diameter_mm, length)) / 2.0
    return Body(name, FLANGE_FRAME, T_flange_body, bare, full, radius_mm)


def _cylinder(radius_mm: float, length_mm: float) -> Shape:
    solid = fcl.CollisionObject(fcl.Cylinder(radius_mm, length_mm))
    return Shape((solid,), solid, (prism(radius_mm, length_mm),))
