"""Compiled halving of a segment for all checks together: each part keeps those that no middle of a part has cleared.

It calls the kernels of :mod:`puncture_twin.planning.collision.kernels.proofs` and of those that they call.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.collision.kernels.hulls import TOUCHING
from puncture_twin.planning.collision.kernels.proofs import (
    BOX,
    MIN_GAP_MM,
    PAIR,
    SKIN,
    near_gap,
    paths_about,
    place_spheres,
    sphere_gap,
)
from puncture_twin.planning.collision.kernels.segment_parts import (
    ANSWERED,
    CHECK,
    CONTACT,
    QUERIES,
    QUERY,
    STATUS,
    place_arm,
)

LIKELY = 0.6
"""Two hulls are seldom farther apart than their spheres and this much of the radii: beyond it a closer look at a part
is left for when the part is halved."""


@allocation_free()
def _found(at, gap, kept_mm, fraction, answered, answer):
    """Whether a bound at a state, which is too small to tell the check clear there, ends the search.

    It does where the check surely finds something or keeps less than it is to, and where it has to be queried and was
    not yet.
    """
    answer.status[CHECK] = at
    if gap == TOUCHING or kept_mm > 0.0:
        answer.status[STATUS] = CONTACT
        return True
    answer.status[ANSWERED] += 1
    if answer.status[ANSWERED] <= answered:
        return False
    answer.status[STATUS], answer.status[QUERIES] = QUERY, 1
    answer.fractions[0], answer.checks[0] = fraction, at
    return True


@allocation_free()
def left_of(scene, movers, segment, part, span, into, room, answered, answer):
    """Which checks the middle of a part of the segment does not clear all over the part.

    Each is looked at in the middle as it is. How far spheres and bodies are from one another clears the part where the
    bodies cannot come as far within it (after Schwarzer, Saha and Latombe 2005, "Adaptive dynamic collision checking
    for single and multiple articulated robots in complex environments").

    Args:
        scene: See :class:`ProofScene`.
        movers: See :class:`Movers`.
        segment: See :class:`Segment`.
        part: Its middle and half its width, fractions of the segment.
        span: Which list of ``room.lists``, and from where to where, holds the checks that are to be cleared.
        into: Where in the other list the rest goes.
        room: See :class:`Room`.
        answered: See :func:`check_segment`.
        answer: Likewise.

    Returns:
        Where in the other list the rest ends; -1 where the search has ended.
    """
    checks, radii, T_box_base, halves = scene.checks, scene.hulls.radii, scene.T_box_base, scene.halves
    work, paths, known, spheres, frames = room.work, room.paths, room.known, room.work.spheres, segment.frames[0]
    of_check, centres, reaches, mover_frames = movers.of_check, movers.centres, movers.radii, movers.frames
    source, target, kept_mm = room.lists[span[0]], room.lists[1 - span[0]], room.kept
    place_arm(segment, part[0])
    place_spheres(scene.hulls, frames, spheres)
    known[:] = False
    for row in range(span[1], span[2]):
        at = source[row]
        mover, kind, first, second = of_check[at], checks[at, 0], checks[at, 1], checks[at, 2]
        if not known[mover]:
            known[mover] = True
            paths_about(
                frames, mover_frames[mover], centres[mover], reaches[mover], segment.turns, part[1], paths[mover]
            )
        kept = kept_mm[at] + MIN_GAP_MM
        needed, gap, most = paths[mover, checks[at, 3]] + kept, 0.0, math.inf
        if kind != SKIN:
            gap = sphere_gap(kind == BOX, first, second, spheres, radii, T_box_base, halves)
            if gap > needed:
                continue
            most = gap + LIKELY * (radii[second] + (radii[first] if kind == PAIR else 0.0))
        if gap <= kept or most >= needed:
            wanted = needed if most >= needed else kept
            gap = near_gap(scene, work, at, frames, wanted, wanted + MIN_GAP_MM, wanted)
            if gap > needed:
                continue
            if gap <= kept < wanted and gap != TOUCHING:
                gap = near_gap(scene, work, at, frames, kept, kept + MIN_GAP_MM, kept)
            if gap <= kept and _found(at, gap, kept_mm[at], part[0], answered, answer):
                return -1
        target[into] = at
        into += 1
    return into


@allocation_free()
def divide(scene, movers, segment, halvings, order, room, answered, answer):
    """Halve the segment, and leave of each part the checks that neither its middle nor that of a larger part clears.

    All parts of one size come before the next, so that what touches is found soon.

    Returns:
        How many parts there are, and which list of ``room`` holds the checks left in each; (0, 0) for none, and
        (-1, 0) where the search has ended.
    """
    lists, spans, parts, here = room.lists, room.spans, 1, np.int64(0)
    for row in range(len(order)):
        lists[0, row] = order[row]
    spans[0, 0, 0], spans[0, 0, 1] = 0, len(order)
    for _ in range(halvings + 1):
        top, half = np.int64(0), 0.5 / parts
        for part in range(parts):
            begin = top
            if spans[here, part, 0] < spans[here, part, 1]:
                middle, span = half * (2 * part + 1), (here, spans[here, part, 0], spans[here, part, 1])
                top = left_of(scene, movers, segment, (middle, half), span, top, room, answered, answer)
            if top < 0:
                return -1, 0
            for side in range(2):
                spans[1 - here, 2 * part + side, 0], spans[1 - here, 2 * part + side, 1] = begin, top
        parts, here = 2 * parts, 1 - here
        if top == 0:
            return 0, 0
    return parts, here
