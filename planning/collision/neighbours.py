"""How the shapes of an own arm hang together: what floats could lie in the patient unseen, what swings may meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from itertools import pairwise
from types import MappingProxyType

import fcl
import numpy as np

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.arm.links import Link, collision_links
from puncture_twin.planning.arm.model_urdf import model_urdf
from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Bools, Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.collision.bodies.shapes import convex

ANGLES = 72
"""At which a joint is looked at, evenly over the turn: every 5 degrees."""

APART_MM = 1.0
"""What two pieces may leave between them and still hang together: too little for a surface to pass through."""


@cache
def joined_pieces(model: UrModel) -> Mapping[tuple[str, str], Bools]:
    """Which pieces of neighbouring links lie together at every angle of the joint between them.

    These are built into one another and never tested. Any other two of neighbouring links meet at some angles alone,
    as a camera on wrist 3 may meet wrist 2, or a folded forearm the upper arm: for these each state is asked.

    Args:
        model: An arm with a URDF of its own.

    Returns:
        For the names of each link and the next, shape (pieces of the one, pieces of the other).

    Raises:
        InputError: Two neighbouring links do not touch at some angle, or a piece hangs on none of the others.
    """
    links = collision_links(model)
    solids = [[fcl.CollisionObject(convex(piece)) for piece in link.pieces] for link in links]
    joined = [_joined(model, links, solids, joint) for joint in range(len(links) - 1)]
    _check_hanging(model, links, solids, joined)
    names = pairwise(link.name for link in links)
    return MappingProxyType(dict(zip(names, joined, strict=True)))


Solids = Sequence[Sequence[fcl.CollisionObject]]


def _joined(model: UrModel, links: Sequence[Link], solids: Solids, joint: int) -> Bools:
    """Of the two links at a joint, which pieces lie within ``APART_MM`` of each other at every angle."""
    always = np.ones((len(solids[joint]), len(solids[joint + 1])), bool)
    for angle in 2.0 * np.pi * np.arange(ANGLES) / ANGLES:
        q = np.zeros(len(links) - 1)
        q[joint] = angle
        for link in (joint, joint + 1):
            _place(solids[link], link_poses(model, q)[links[link].frame])
        gaps = _gaps_mm(solids[joint], solids[joint + 1])
        if gaps.min() > 0.0:
            at = f"at {np.degrees(angle):g} degrees of their joint"
            what = f"the shapes of {links[joint].name} and {links[joint + 1].name} do not meet {at}"
            allowed = "links that hang together: see the unit, scale and origin of their meshes"
            raise InputError(what, where=model_urdf(model).where, allowed=allowed)
        always &= gaps <= APART_MM
    return always


def _check_hanging(model: UrModel, links: Sequence[Link], solids: Solids, joined: Sequence[Bools]) -> None:
    """Refuse an arm of which a piece is reached from the base by no chain of pieces that lie together."""
    hanging = {(0, 0)}
    fresh = [(0, 0)]
    within = [_gaps_mm(some, some) <= APART_MM for some in solids]
    while fresh:
        link, piece = fresh.pop()
        beside = {(link, int(other)) for other in np.flatnonzero(within[link][piece])}
        if link < len(joined):
            beside |= {(link + 1, int(other)) for other in np.flatnonzero(joined[link][piece])}
        if link > 0:
            beside |= {(link - 1, int(other)) for other in np.flatnonzero(joined[link - 1][:, piece])}
        fresh += beside - hanging
        hanging |= beside
    for number, body in enumerate(links):
        for piece, shape in enumerate(body.pieces):
            if (number, piece) not in hanging:
                low, high = shape.bounds
                size = " x ".join(f"{edge:.4g}" for edge in high - low)
                what = f"a shape of {body.name}, {size} mm, hangs on nothing"
                allowed = f"shapes of one body that touch, to {APART_MM:g} mm: see unit, scale and origin; or one mesh"
                raise InputError(what, where=model_urdf(model).where, allowed=allowed)


def _place(solids: Sequence[fcl.CollisionObject], T: Floats) -> None:
    for solid in solids:
        solid.setTransform(fcl.Transform(T[:3, :3], T[:3, 3]))


def _gaps_mm(first: Sequence[fcl.CollisionObject], second: Sequence[fcl.CollisionObject]) -> Floats:
    """Distances between pieces, shape (n, m), mm; at most 0 where they touch."""
    return np.array([[fcl.distance(a, b, fcl.DistanceRequest(), fcl.DistanceResult()) for b in second] for a in first])
