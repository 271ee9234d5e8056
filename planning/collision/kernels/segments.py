"""Compiled check of one straight joint segment: what surely touches, what is surely clear, and what is left to ask.

It calls the kernels of :mod:`puncture_twin.planning.collision.kernels.proofs`, of those that they call and of
:mod:`puncture_twin.planning.arm.kinematics`.
"""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_frames
from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.base.numba_kernels import nb
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
    scratch,
    sphere_gap,
)

CLEAR, CONTACT, QUERY, NOT_FINITE = 0, 1, 2, 3
"""What a segment came to: proven but for the queries, a contact, a query to be made at once, no numbers."""

STATUS, CHECK, GO_ON, QUERIES = 0, 1, 2, 3
"""The entries of an answer's status: one of the above; the check that touches; where to go on after a query; how
many queries."""

KEPT = 0.8
"""Of the clearance at the nearer end of a segment, what all of it is to keep: bounds are loose by up to a tenth."""

PARTS = 256
"""Space for parts of a segment that wait: one more for each halving, and 64 of them leave nothing of a segment."""


class Answer(NamedTuple):
    """What a segment came to, filled by :func:`check_segment`."""

    status: Ints
    """Shape (4,)."""
    fractions: Floats
    """Shape (q,): of each query, the fraction of the segment at which its state is."""
    checks: Ints
    """Shape (q,): the checks that are queried."""


class Segment(NamedTuple):
    """A segment, and the arm at one state of it."""

    lengths: Floats
    start: Floats
    step: Floats
    turns: Floats
    """Shape (6,), rad: how far each joint turns."""
    q: Floats
    """Shape (1, 6): scratch."""
    frames: Floats
    """Shape (1, 7, 4, 4), mm: filled by :func:`_stand`."""


@nb.njit(cache=True)
def _place_arm(segment, fraction):
    """Put the arm at a fraction of the segment."""
    for joint in range(6):
        segment.q[0, joint] = segment.start[joint] + fraction * segment.step[joint]
    link_frames(segment.lengths, segment.q, segment.frames)


@nb.njit(cache=True)
def _not_far(scene, movers, frames, turns, order, clear_mm, work, near):
    """Fills ``near`` with the checks, in order, that the spheres in the middle of a segment do not clear everywhere."""
    checks, hulls, T_box_base, halves = scene.checks, scene.hulls, scene.T_box_base, scene.halves
    place_spheres(hulls, frames, work.spheres)
    paths, known = np.empty((len(movers.frames), 7)), np.zeros(len(movers.frames), np.bool_)
    count = 0
    for at in order:
        mover = movers.of_check[at]
        if not known[mover]:
            known[mover] = True
            sphere = movers.centres[mover], movers.radii[mover]
            paths_about(frames, movers.frames[mover], sphere[0], sphere[1], turns, 0.5, paths[mover])
        segment = paths[mover, checks[at, 3]] + MIN_GAP_MM + (0.0 if checks[at, 0] == PAIR else clear_mm)
        if checks[at, 0] == SKIN:
            gap = near_gap(scene, work, at, frames, segment, segment + MIN_GAP_MM, segment)
        else:
            is_box = checks[at, 0] == BOX
            gap = sphere_gap(is_box, checks[at, 1], checks[at, 2], work.spheres, hulls.radii, T_box_base, halves)
        if gap <= segment:
            near[count] = at
            count += 1
    return count


@nb.njit(cache=True)
def _look(scene, segment, fractions, near, kept, begin, work, answer):
    """Whether a check finds something at the states looked at first, from ``begin`` (state * checks + check) on.

    Not keeping ``kept`` (k,), mm, is something.
    """
    checks, hulls, T_box_base, halves = scene.checks, scene.hulls, scene.T_box_base, scene.halves
    frames = segment.frames[0]
    for position in range(begin, len(fractions) * len(near)):
        look, row = divmod(position, len(near))
        if row == 0 or position == begin:
            _place_arm(segment, fractions[look])
            place_spheres(hulls, frames, work.spheres)
        at, gap = near[row], 0.0
        needed = kept[at] + MIN_GAP_MM
        if checks[at, 0] != SKIN:
            is_box = checks[at, 0] == BOX
            gap = sphere_gap(is_box, checks[at, 1], checks[at, 2], work.spheres, hulls.radii, T_box_base, halves)
        if gap <= needed:
            gap = near_gap(scene, work, at, frames, needed, needed + MIN_GAP_MM, needed)
        if gap <= needed:
            sure = gap == TOUCHING or kept[at] > 0.0
            answer.status[STATUS], answer.status[CHECK] = CONTACT if sure else QUERY, at
            answer.status[GO_ON], answer.status[QUERIES] = position + 1, 1
            answer.fractions[0], answer.checks[0] = fractions[look], at
            return True
    return False


@nb.njit(cache=True)
def _keep(scene, segment, near, clear_mm, work, kept):
    """Fills ``kept`` (k,), mm: what a check is to keep, ``clear_mm`` or as much as the nearer end does (``KEPT``)."""
    enough = clear_mm / KEPT
    for at in near:
        kept[at] = 0.0 if scene.checks[at, 0] == PAIR else clear_mm
    for end in (0.0, 1.0):
        _place_arm(segment, end)
        for at in near:
            if kept[at] > 0.0:
                needed = MIN_GAP_MM if scene.checks[at, 0] == SKIN else enough
                gap = near_gap(scene, work, at, segment.frames[0], enough, enough + MIN_GAP_MM, needed)
                kept[at] = min(kept[at], KEPT * max(0.0, gap))


@nb.njit(cache=True)
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


@nb.njit(cache=True)
def _prove(scene, movers, segment, at, kept_mm, fine_mm, work, parts, answer):
    """Whether a check surely finds something, or keeps less than it is to; else what is left to query joins the answer.

    The middle of a part clears what lies nearer to it than its gap allows to move; the rest is checked in the same way,
    by the middles of what is left on either side (after Schwarzer, Saha and Latombe 2005, "Adaptive dynamic collision
    checking for single and multiple articulated robots in complex environments").
    """
    mover, frame_a, frames, paths = movers.of_check[at], scene.checks[at, 3], segment.frames[0], np.empty(7)
    kept = kept_mm + MIN_GAP_MM
    parts[0, 0], parts[0, 1], top = 0.0, 1.0, 1
    while top > 0:
        top -= 1
        low, high = parts[top, 0], parts[top, 1]
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        _place_arm(segment, middle)
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
def check_segment(scene, movers, lengths, start, end, fractions, begin, fine_mm, clear_mm, order, answer):
    """Check a straight joint segment: fills ``answer``.

    Args:
        scene: See :class:`Scene`.
        movers: See :class:`Movers`.
        lengths: Of the arm, see :mod:`puncture_twin.planning.arm.kinematics`.
        start: Shape (6,), rad.
        end: Shape (6,), rad.
        fractions: Shape (m,): of the segment, where states are that are looked at first.
        begin: 0; after a query whose answer was no, where the answer says to go on.
        fine_mm: Where the bodies of a check move no farther than this within a part, its middle decides.
        clear_mm: What the arm is to keep from skin and boxes where both ends do, see :func:`_keep`; 0 for none.
        order: Shape (k,): the checks in the order in which they are tested.
        answer: See :class:`Answer`.
    """
    step, frames = end - start, np.empty((1, 7, 4, 4))
    segment = Segment(lengths, start, step, np.abs(step), np.empty((1, 6)), frames)
    answer.status[STATUS], answer.status[QUERIES] = CLEAR, 0
    _place_arm(segment, 0.5)
    if not np.isfinite(frames).all():
        answer.status[STATUS] = NOT_FINITE
        return
    work, every = scratch(len(scene.checks), len(scene.hulls.radii)), np.empty(len(order), np.int64)
    near = every[: _not_far(scene, movers, frames[0], segment.turns, order, clear_mm, work, every)]
    parts, kept = np.empty((PARTS, 2)), np.zeros(len(scene.checks))
    if clear_mm > 0.0:
        _keep(scene, segment, near, clear_mm, work, kept)
    if _look(scene, segment, fractions, near, kept, begin, work, answer):
        return
    for at in near:
        if _prove(scene, movers, segment, at, kept[at], fine_mm, work, parts, answer):
            return
