"""A link of an arm as a body for FCL."""

from __future__ import annotations

from functools import partial

import numpy as np

from puncture_twin.planning.arm.links import Link
from puncture_twin.planning.collision.bodies.body import Body, Shape
from puncture_twin.planning.collision.bodies.shapes import convex, surface
from puncture_twin.planning.collision.bodies.solid import Solid
from puncture_twin.planning.geometry.mesh import joined


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
