"""Links grown by the padding."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import islice

from puncture_twin.planning.arm.links import Link
from puncture_twin.planning.base.cache.array_cache import Arrays, user_cache
from puncture_twin.planning.collision.bodies.shapes import padded
from puncture_twin.planning.geometry.mesh_list import packed_meshes, unpacked_meshes


def padded_links(links: Sequence[Link], padding_mm: float) -> tuple[Link, ...]:
    """The links with every piece grown by the padding, from the user's cache where they are there."""
    pieces = [piece for link in links for piece in link.pieces]
    made_from = {"what": "padded", "padding_mm": padding_mm, "pieces": [piece.digest for piece in pieces]}

    def grown() -> Arrays:
        return packed_meshes([padded(piece, padding_mm) for piece in pieces])

    kept = user_cache().arrays(made_from, grown, by=__name__, check=unpacked_meshes)
    following = iter(unpacked_meshes(kept))
    return tuple(Link(link.name, link.frame, tuple(islice(following, len(link.pieces)))) for link in links)
