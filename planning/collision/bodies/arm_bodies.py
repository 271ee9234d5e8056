"""The bodies of an arm with its tool: links and tool of convex pieces, bare and padded; holder and needle."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from itertools import islice

import fcl
import numpy as np

from puncture_twin.planning.arm.links import Link, collision_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.collision.bodies.body import FLANGE_FRAME, Body, Shape
from puncture_twin.planning.collision.bodies.prisms import prism
from puncture_twin.planning.collision.bodies.shapes import convex, padded, surface
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.geometry.mesh import joined
from puncture_twin.planning.geometry.mesh_list import packed_meshes, unpacked_meshes
from puncture_twin.planning.geometry.rigid import pose


def link_body(link: Link, grown: Link) -> Body:
    """A link as it is, and grown by the padding; the same object where there is none."""
    bare = _link_shape(link)
    full = bare if grown is link else _link_shape(grown)
    radius_mm = float(np.linalg.norm(link.mesh.vertices, axis=1).max())
    return Body(link.name, link.frame, np.eye(4), bare, full, radius_mm)


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
        *(link_body(bare, more) for bare, more in zip(links, full, strict=True)),
        round_body("holder", tool.holder_diameter_mm, tool.holder_span_mm, padding_mm),
        round_body("needle", tool.needle_diameter_mm, tool.needle_span_mm, padding_mm),
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
