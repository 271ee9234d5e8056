"""Compiled check of one straight joint segment: what surely touches, what is surely clear, and what is left to ask.

It calls the kernels of :mod:`puncture_twin.planning.collision.kernels.halving`, of those that it calls and of
:mod:`puncture_twin.planning.arm.kinematics`.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.collision.kernels.halving import divide, left_of
from puncture_twin.planning.collision.kernels.hulls import TOUCHING
from puncture_twin.planning.collision.kernels.proofs import (
    BOX,
    MIN_GAP_MM,
    PAIR,
    SKIN,
    near_gap,
    paths_about,
    place_sphere,
    place_spheres,
    sphere_gap,
)
from puncture_twin.planning.collision.kernels.segment_parts import (
    ANSWERED,
    CHECK,
    CLEAR,
    CONTACT,
    NOT_FINITE,
    QUERIES,
    STATUS,
    Segment,
    place_arm,
)

KEPT = 0.8
"""Of the clearance at the nearer end of a segment, what all of it is to keep: bounds are loose by up to a tenth."""


@allocation_free()
def _keep(scene, segment, clear_mm, room):
    """Fills ``kept`` (k,), mm: what a check is to keep, ``clear_mm`` or as much as the nearer end does (``KEPT``)."""
    checks, hulls, T_box_base, halves = scene.checks, scene.hulls, scene.T_box_base, scene.halves
    kept, work, frames, enough = room.kept, room.work, segment.frames[0], clear_mm / KEPT
    for at in range(len(checks)):
        kept[at] = 0.0 if checks[at, 0] == PAIR else clear_mm
    for end in (0.0, 1.0):
        place_arm(segment, end)
        place_spheres(hulls, frames, work.spheres)
        for at in range(len(checks)):
            if kept[at] > 0.0:
                needed, gap = MIN_GAP_MM, 0.0
                if checks[at, 0] == BOX:
                    first, second, needed = checks[at, 1], checks[at, 2], enough
                    gap = sphere_gap(True, first, second, work.spheres, hulls.radii, T_box_base, halves)
                if gap <= enough:
                    gap = near_gap(scene, work, at, frames, enough, enough + MIN_GAP_MM, needed)
                kept[at] = min(kept[at], KEPT * max(0.0, gap))


@allocation_free()
def _bound(scene, work, at, frames, needed):
    """Lower bound on the distance of a check, of use above ``needed``: of the spheres about two hulls where they tell.

    Spheres whose middles are nearer than ``needed`` are about hulls that are, so no closer look proves more.
    """
    checks, hulls = scene.checks, scene.hulls
    kind, first, second = checks[at, 0], checks[at, 1], checks[at, 2]
    if kind != SKIN:
        place_sphere(hulls, frames, second, work.spheres)
        if kind == PAIR:
            place_sphere(hulls, frames, first, work.spheres)
        gap = sphere_gap(kind == BOX, first, second, work.spheres, hulls.radii, scene.T_box_base, scene.halves)
        radii = hulls.radii[second] + (hulls.radii[first] if kind == PAIR else 0.0)
        if gap > needed or gap + radii < needed:
            return gap
    return near_gap(scene, work, at, frames, needed, needed + MIN_GAP_MM, needed)


@allocation_free()
def _prove(scene, movers, segment, at, within, fine_mm, room, answer):
    """Whether a check surely finds something, or keeps less than it is to; else what is left to query joins the answer.

    Looked at is the part ``within`` (low, high) of the segment. Its middle clears what lies nearer to it than its gap
    allows to move; the rest is checked in the same way, by the middles of what is left on either side.
    """
    mover, frame_a, frames, paths = movers.of_check[at], scene.checks[at, 3], segment.frames[0], room.paths[0]
    work, parts, kept_mm = room.work, room.parts, room.kept[at]
    kept = kept_mm + MIN_GAP_MM
    parts[0, 0], parts[0, 1], top = within[0], within[1], 1
    while top > 0:
        top -= 1
        low, high = parts[top, 0], parts[top, 1]
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        place_arm(segment, middle)
        sphere = movers.centres[mover], movers.radii[mover]
        paths_about(frames, movers.frames[mover], sphere[0], sphere[1], segment.turns, half, paths)
        needed = paths[frame_a] + kept
        gap = _bound(scene, work, at, frames, needed)
        if gap > needed:
            continue
        if gap == TOUCHING:
            answer.status[STATUS], answer.status[CHECK] = CONTACT, at
            return True
        if paths[frame_a] > fine_mm:
            clear = half * max(0.0, gap - kept) / (needed - kept_mm)
            parts[top, 0], parts[top, 1] = low, middle - clear
            parts[top + 1, 0], parts[top + 1, 1] = middle + clear, high
            top += 2
        elif gap <= kept:
            if kept_mm > 0.0:
                answer.status[STATUS], answer.status[CHECK] = CONTACT, at
                return True
            queries = answer.status[QUERIES]
            if queries < len(answer.fractions):
                answer.fractions[queries], answer.checks[queries] = middle, at
            answer.status[QUERIES] += 1
    return False


@nb.njit(cache=True)
def check_segment(scene, movers, lengths, start, end, answered, halvings, fine_mm, clear_mm, order, room, answer):
    """Check a straight joint segment: fills ``answer``.

    Args:
        scene: See :class:`ProofScene`.
        movers: See :class:`Movers`.
        lengths: Of the arm, see :mod:`puncture_twin.planning.arm.kinematics`.
        start: Shape (6,), rad.
        end: Shape (6,), rad.
        answered: 0; after a query whose answer was no, how many there were.
        halvings: How often the segment is halved for all checks together, at most ``HALVINGS``.
        fine_mm: Where the bodies of a check move no farther than this within a part, its middle decides.
        clear_mm: What the arm is to keep from skin and boxes where both ends do, see :func:`_keep`; 0 for none.
        order: Shape (k,): the checks in the order in which they are tested.
        room: See :class:`Room`.
        answer: See :class:`Answer`.
    """
    step, frames = end - start, np.empty((1, 7, 4, 4))
    segment = Segment(lengths, start, step, np.abs(step), np.empty((1, 6)), frames)
    answer.status[STATUS], answer.status[QUERIES], answer.status[ANSWERED] = CLEAR, 0, 0
    place_arm(segment, 0.5)
    if not np.isfinite(frames).all():
        answer.status[STATUS] = NOT_FINITE
        return
    room.work.axes[:], room.kept[:] = 0.0, 0.0
    if clear_mm > 0.0:
        _keep(scene, segment, clear_mm, room)
    for row in range(len(order)):
        room.lists[0, row] = order[row]
    none = np.int64(0)
    if left_of(scene, movers, segment, (1.0, 0.0), (none, none, len(order)), none, room, answered, answer) < 0:
        return
    parts, here = divide(scene, movers, segment, halvings, order, room, answered, answer)
    for part in range(parts):
        for row in range(room.spans[here, part, 0], room.spans[here, part, 1]):
            within = part / parts, (part + 1) / parts
            if _prove(scene, movers, segment, room.lists[here, row], within, fine_mm, room, answer):
                return
