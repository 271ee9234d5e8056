"""The bodies of an arm with its tool: links and tool of convex pieces, bare and padded; holder and needle."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from puncture_twin.planning.arm.links import Link, collision_links
from puncture_twin.planning.arm.tool import Tool
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.collision.bodies.body import FLANGE_FRAME, Body
from puncture_twin.planning.collision.bodies.link_body import link_body
from puncture_twin.planning.collision.bodies.round_body import round_body
from puncture_twin.planning.collision.bodies.shapes import padded
from puncture_twin.planning.geometry.mesh_list import packed_meshes, unpacked_meshes


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
