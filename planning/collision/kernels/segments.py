# mypy: disable-error-code="no-untyped-def"
"""Compiled check of one straight joint segment: certain contacts, what is certainly clear, and what FCL has to decide.

`divide` halves the segment for all checks together: each part keeps the checks that the middle of no larger part has
cleared. `check_segment` goes on with each check alone. It calls the kernels of `proofs` and of the arm's kinematics.
"""

import math
from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_frames
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free, nb
from puncture_twin.planning.collision.kernels.hulls import TOUCHING
from puncture_twin.planning.collision.kernels.proofs import (
    BOX,
    MIN_GAP_MM,
    PAIR,
    SKIN,
    Movers,
    ProofScene,
    ProofScratch,
    near_gap,
    paths_about,
    place_sphere,
    place_spheres,
    proof_scratch,
    sphere_gap,
)

KEPT = 0.8
"""Fraction of the clearance at the nearer end of a segment that the whole segment must keep: bounds are loose by up to
a tenth."""


@allocation_free()
def _keep(scene, segment, clear_mm, scratch):
    """Fill ``kept`` (k,), mm: the clearance that each check must keep, ``clear_mm`` or ``KEPT`` of the nearer end's."""
    checks, hulls, T_box_base, halves = scene.checks, scene.hulls, scene.T_box_base, scene.halves
    kept, work, frames, enough = scratch.kept, scratch.work, segment.frames[0], clear_mm / KEPT
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
    """Lower bound on the distance of a check's bodies: by bounding spheres where they decide, else by `near_gap`.

    They decide where their gap exceeds ``needed``, and where it cannot: their centres are then nearer than that.
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
def _prove(scene, movers, segment, at, within, fine_mm, scratch, answer):
    """Prove one check clear in the part ``within`` (low, high) of the segment; True where it certainly is not.

    The middle's gap clears the states up to which the bodies cannot move that far (adaptive bisection); what is left on
    either side is checked likewise. States where neither is proven are added to the answer's queries.
    """
    mover, frame_a, frames, paths = movers.of_check[at], scene.checks[at, 3], segment.frames[0], scratch.paths[0]
    work, parts, kept_mm = scratch.work, scratch.parts, scratch.kept[at]
    kept = kept_mm + MIN_GAP_MM
    parts[0, 0], parts[0, 1], top = within[0], within[1], 1
    while top > 0:
        top -= 1
        low, high = parts[top, 0], parts[top, 1]
        middle, half = (low + high) / 2.0, (high - low) / 2.0
        place_arm(segment, middle)
        sphere = movers.centres[mover], movers.radii[mover]
        paths_about(frames, movers.frames[mover], sphere[0], sphere[1], segment.rotations, half, paths)
        needed = paths[frame_a] + kept
        gap = _bound(scene, work, at, frames, needed)
        if gap > needed:
            continue
        if gap == TOUCHING:
            answer.status[STATUS], answer.status[CHECK] = CONTACT, at
            return True
        if paths[frame_a] > fine_mm:
            # The bodies move in proportion to the distance from the middle: the gap suffices for this much of it.
            clear = half * max(0.0, gap - kept) / (needed - kept_mm)
            parts[top, 0], parts[top, 1] = low, middle - clear
            parts[top + 1, 0], parts[top + 1, 1] = middle + clear, high
            top += 2
        elif gap <= kept:  # the part is too short to divide: its middle decides
            if kept_mm > 0.0:
                answer.status[STATUS], answer.status[CHECK] = CONTACT, at
                return True
            queries = answer.status[QUERIES]
            if queries < len(answer.fractions):
                answer.fractions[queries], answer.checks[queries] = middle, at
            answer.status[QUERIES] += 1
    return False


@nb.njit(cache=True)
def check_segment(scene, movers, lengths, start, end, answered, halvings, fine_mm, clear_mm, order, scratch, answer):
    """Check a straight joint segment, and fill ``answer``.

    Args:
        lengths: Of the arm, see :mod:`puncture_twin.planning.arm.kinematics`.
        start: Shape (6,), rad.
        end: Shape (6,), rad.
        answered: How many queries FCL has answered with no contact; 0 for the first call.
        halvings: How often the segment is halved for all checks together, at most ``HALVINGS``.
        fine_mm: Where the bodies of a check move no farther than this within a part, its middle decides.
        clear_mm: Clearance from skin and boxes to keep where both ends do, see :func:`_keep`; 0 for none.
        order: Shape (k,): the checks in the order in which they are tested.
    """
    step, frames = end - start, np.empty((1, 7, 4, 4))
    segment = Segment(lengths, start, step, np.abs(step), np.empty((1, 6)), frames)
    answer.status[STATUS], answer.status[QUERIES], answer.status[ANSWERED] = CLEAR, 0, 0
    place_arm(segment, 0.5)
    if not np.isfinite(frames).all():
        answer.status[STATUS] = NOT_FINITE
        return
    scratch.work.axes[:], scratch.kept[:] = 0.0, 0.0
    if clear_mm > 0.0:
        _keep(scene, segment, clear_mm, scratch)
    for row in range(len(order)):
        scratch.lists[0, row] = order[row]
    none = np.int64(0)
    # 1. The whole segment from its middle, all checks; 2. halves of halves, all checks; 3. each check left, alone.
    if left_of(scene, movers, segment, (1.0, 0.0), (none, none, len(order)), none, scratch, answered, answer) < 0:
        return
    parts, here = divide(scene, movers, segment, halvings, order, scratch, answered, answer)
    for part in range(parts):
        for row in range(scratch.spans[here, part, 0], scratch.spans[here, part, 1]):
            within = part / parts, (part + 1) / parts
            if _prove(scene, movers, segment, scratch.lists[here, row], within, fine_mm, scratch, answer):
                return


LIKELY = 0.6
"""Guess of two hulls' gap: that of their spheres and this fraction of the radii. Where that is too small for a part of
the segment, no closer bound is sought before the part is halved."""


@allocation_free()
def _found(at, gap, kept_mm, fraction, answered, answer):
    """Whether a check that is not proven clear at a state ends the search.

    It does where the bodies certainly touch or have less than the clearance to keep, and where FCL must be queried and
    has not been.
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
def left_of(scene, movers, segment, part, span, into, scratch, answered, answer):
    """List the checks that the middle of a part of the segment does not clear in all of the part.

        clear in all of the part: gap in the middle > paths of the bodies within the part + clearance to keep

    After Schwarzer, Saha and Latombe 2005, "Adaptive dynamic collision checking for single and multiple articulated
    robots in complex environments".

    Args:
        part: The part's middle and half its width, fractions of the segment.
        span: Which list of ``scratch.lists`` holds the checks to clear, and its first and last (excluded) index.
        into: Index in the other list at which the checks that are left are written.

    Returns:
        The index in the other list after the last check that is left; -1 where the search has ended.
    """
    checks, radii, T_box_base, halves = scene.checks, scene.hulls.radii, scene.T_box_base, scene.halves
    work, paths, known, frames = scratch.work, scratch.paths, scratch.known, segment.frames[0]
    spheres = work.spheres
    of_check, centres, reaches, mover_frames = movers.of_check, movers.centres, movers.radii, movers.frames
    source, target, kept_mm = scratch.lists[span[0]], scratch.lists[1 - span[0]], scratch.kept
    place_arm(segment, part[0])
    place_spheres(scene.hulls, frames, spheres)
    known[:] = False
    for row in range(span[1], span[2]):
        at = source[row]
        mover, kind, first, second = of_check[at], checks[at, 0], checks[at, 1], checks[at, 2]
        if not known[mover]:
            known[mover] = True
            paths_about(
                frames, mover_frames[mover], centres[mover], reaches[mover], segment.rotations, part[1], paths[mover]
            )
        kept = kept_mm[at] + MIN_GAP_MM
        needed, gap, most = paths[mover, checks[at, 3]] + kept, 0.0, math.inf
        if kind != SKIN:  # cheapest first: bounding spheres, then hulls or skin
            gap = sphere_gap(kind == BOX, first, second, spheres, radii, T_box_base, halves)
            if gap > needed:
                continue
            most = gap + LIKELY * (radii[second] + (radii[first] if kind == PAIR else 0.0))
        if gap <= kept or most >= needed:
            wanted = needed if most >= needed else kept
            gap = near_gap(scene, work, at, frames, wanted, wanted + MIN_GAP_MM, wanted)
            if gap > needed:
                continue
            if gap <= kept < wanted and gap != TOUCHING:  # the search for more ended early: ask for the middle alone
                gap = near_gap(scene, work, at, frames, kept, kept + MIN_GAP_MM, kept)
            if gap <= kept and _found(at, gap, kept_mm[at], part[0], answered, answer):
                return -1
        target[into] = at
        into += 1
    return into


@allocation_free()
def divide(scene, movers, segment, halvings, order, scratch, answered, answer):
    """Halve the segment again and again; each part keeps the checks that no middle of its or a larger part clears.

    Breadth first, all parts of one size before the next, so that a contact is found soon.

    Returns:
        How many parts there are, and which list of ``scratch`` holds the checks left in each; (0, 0) for none, and
        (-1, 0) where the search has ended.
    """
    lists, spans, parts, here = scratch.lists, scratch.spans, 1, np.int64(0)
    for row in range(len(order)):
        lists[0, row] = order[row]
    spans[0, 0, 0], spans[0, 0, 1] = 0, len(order)
    for _ in range(halvings + 1):
        top, half = np.int64(0), 0.5 / parts
        for part in range(parts):
            begin = top
            if spans[here, part, 0] < spans[here, part, 1]:
                middle, span = half * (2 * part + 1), (here, spans[here, part, 0], spans[here, part, 1])
                top = left_of(scene, movers, segment, (middle, half), span, top, scratch, answered, answer)
            if top < 0:
                return -1, 0
            for side in range(2):
                spans[1 - here, 2 * part + side, 0], spans[1 - here, 2 * part + side, 1] = begin, top
        parts, here = 2 * parts, 1 - here
        if top == 0:
            return 0, 0
    return parts, here


CLEAR, CONTACT, QUERY, NOT_FINITE = 0, 1, 2, 3
"""Results of a segment: proven but for the queries; a contact; a query to be made at once; joints not finite."""
STATUS, CHECK, ANSWERED, QUERIES = 0, 1, 2, 3
"""The entries of an answer's status: one of the above; the check that touches; how many queries were, or are to be,
answered at once; how many there are now."""
HALVINGS = 6
"""Of a segment for all checks together; each check that is left goes on alone."""
PARTS = 256
"""Space for parts of a segment that wait: one more for each halving, and 64 of them leave nothing of a segment."""


class Answer(NamedTuple):
    """Result of a segment's check, filled by :func:`segments.check_segment`."""

    status: Ints  # shape (4,)
    fractions: Floats  # shape (q,): of each query, the fraction of the segment at which its state is
    checks: Ints  # shape (q,): the checks that are queried


class Segment(NamedTuple):
    """A segment, and the arm at one state of it."""

    lengths: Floats
    start: Floats
    step: Floats
    rotations: Floats  # shape (6,), rad: how far each joint rotates
    q: Floats  # shape (1, 6): scratch
    frames: Floats  # shape (1, 7, 4, 4), mm: filled by :func:`place_arm`


class SegmentScratch(NamedTuple):
    """Scratch in which a segment is checked: see :func:`segment_scratch`. Nothing in it outlasts the segment."""

    work: ProofScratch
    kept: Floats  # shape (k,), mm: what each check is to keep
    lists: Ints  # shape (2, n): lists of checks, those that are left before and after a halving
    spans: Ints  # shape (2, p, 2): where in them each part's begins and ends
    paths: Floats  # shape (m, 7), mm: of each mover, see :func:`paths_about`
    known: Bools  # shape (m,): of which movers
    parts: Floats  # shape (``PARTS``, 2): parts of a segment that wait


def segment_scratch(scene: ProofScene, movers: Movers) -> SegmentScratch:
    """Scratch for segments of a workcell's checks."""
    checks, count = len(scene.checks), len(movers.frames)
    lists, spans = np.empty((2, checks << HALVINGS), np.int64), np.empty((2, 2 << HALVINGS, 2), np.int64)
    work, paths = proof_scratch(checks, len(scene.hulls.radii)), np.empty((count, 7))
    return SegmentScratch(work, np.zeros(checks), lists, spans, paths, np.zeros(count, np.bool_), np.empty((PARTS, 2)))


@allocation_free()
def place_arm(segment, fraction):
    """Put the arm at a fraction of the segment."""
    for joint in range(6):
        segment.q[0, joint] = segment.start[joint] + fraction * segment.step[joint]
    link_frames(segment.lengths, segment.q, segment.frames)
