"""The bodies of an arm with its tool."""

from __future__ import annotations

import fcl
import numpy as np

from puncture_twin.planning.arm.links import Link, collision_links, joined
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.collision.bodies.body import FLANGE_FRAME, Body, Shape
from puncture_twin.planning.collision.bodies.padded_links import padded_links
from puncture_twin.planning.collision.bodies.round_body import round_body
from puncture_twin.planning.collision.bodies.shapes import convex, surface


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
        round_body("holder", tool.holder_diameter_mm, tool.holder_span_mm, padding_mm),
        round_body("needle", tool.needle_diameter_mm, tool.needle_span_mm, padding_mm),
    )


def _link_body(link: Link, grown: Link) -> Body:
    bare = _link_shape(link)
    full = bare if grown is link else _link_shape(grown)
    radius_mm = float(np.linalg.norm(link.mesh.vertices, axis=1).max())
    return Body(link.name, link.frame, np.eye(4), bare, full, radius_mm)


def _link_shape(link: Link) -> Shape:
    whole = surface(joined(link.pieces))
    solids = tuple(fcl.CollisionObject(convex(piece)) for piece in link.pieces)
    hulls = tuple(np.asarray(piece.vertices) for piece in link.pieces)
    return Shape(solids, fcl.CollisionObject(whole), hulls)
