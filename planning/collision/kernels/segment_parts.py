"""What compiled checks of a segment share: the segment, its answer, and the room to work in."""

# mypy: disable-error-code="no-untyped-def"
# numba infers the types

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from puncture_twin.planning.arm.kinematics import link_frames
from puncture_twin.planning.base.arrays import Bools, Floats, Ints
from puncture_twin.planning.base.numba_kernels import allocation_free
from puncture_twin.planning.collision.kernels.proofs import Movers, ProofScene, ProofScratch, scratch

CLEAR, CONTACT, QUERY, NOT_FINITE = 0, 1, 2, 3
"""What a segment came to: proven but for the queries, a contact, a query to be made at once, no numbers."""

STATUS, CHECK, ANSWERED, QUERIES = 0, 1, 2, 3
"""The entries of an answer's status: one of the above; the check that touches; how many queries were, or are to be,
answered at once; how many there are now."""

HALVINGS = 6
"""Of a segment for all checks together; each check that is left goes on alone."""

PARTS = 256
"""Space for parts of a segment that wait: one more for each halving, and 64 of them leave nothing of a segment."""


class Answer(NamedTuple):
    """What a segment came to, filled by :func:`segments.check_segment`."""

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
    """Shape (1, 7, 4, 4), mm: filled by :func:`place_arm`."""


class Room(NamedTuple):
    """Where a segment is checked: see :func:`segment_room`. Nothing in it outlasts the segment."""

    work: ProofScratch
    kept: Floats
    """Shape (k,), mm: what each check is to keep."""
    lists: Ints
    """Shape (2, n): lists of checks, those that are left before and after a halving."""
    spans: Ints
    """Shape (2, p, 2): where in them each part's begins and ends."""
    paths: Floats
    """Shape (m, 7), mm: of each mover, see :func:`paths_about`."""
    known: Bools
    """Shape (m,): of which movers."""
    parts: Floats
    """Shape (``PARTS``, 2): parts of a segment that wait."""


def segment_room(scene: ProofScene, movers: Movers) -> Room:
    """Room for the checks of a cell."""
    checks, count = len(scene.checks), len(movers.frames)
    lists, spans = np.empty((2, checks << HALVINGS), np.int64), np.empty((2, 2 << HALVINGS, 2), np.int64)
    work, paths = scratch(checks, len(scene.hulls.radii)), np.empty((count, 7))
    return Room(work, np.zeros(checks), lists, spans, paths, np.zeros(count, np.bool_), np.empty((PARTS, 2)))


@allocation_free()
def place_arm(segment, fraction):
    """Put the arm at a fraction of the segment."""
    for joint in range(6):
        segment.q[0, joint] = segment.start[joint] + fraction * segment.step[joint]
    link_frames(segment.lengths, segment.q, segment.frames)
