"""The waypoints of a joint path, found again in its samples."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.arm.ur import UrModel
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.motion.trajectory import Trajectory

STRAIGHT_RAD = 1e-9
"""Joint distance within which samples lie on a straight segment: far above rounding, a millionth of a degree."""

REST_SLACK = 1e-6
"""Relative rounding of a speed by differences."""


def corner_rows(q: Floats) -> NDArray[np.intp]:
    """Rows at which a path turns or turns back, with both ends: every other row lies between two of them.

    Splits at the row farthest from the chord until none is off (Douglas and Peucker 1973, in six dimensions). For a
    path of straight segments that row is always one of its waypoints.

    Args:
        q: Shape (m, 6), rad.

    Returns:
        Rising rows, shape (k,); ``[0]`` for a single row.
    """
    kept, pending = {0, len(q) - 1}, [(0, len(q) - 1)]
    while pending:
        first, last = pending.pop()
        split = _turning_row(q[first : last + 1])
        if split is not None:
            kept.add(first + split)
            pending += [(first, first + split), (first + split, last)]
    return np.array(sorted(kept), dtype=np.intp)


def _turning_row(rows: Floats) -> int | None:
    """The row farthest from the segment between the ends, or the last before the path reverses; None if straight."""
    if len(rows) < 3:
        return None
    away, chord = rows - rows[0], rows[-1] - rows[0]
    length = float(np.linalg.norm(chord))
    unit = chord / length if length > STRAIGHT_RAD else np.zeros(6)
    along = np.clip(away @ unit, 0.0, length)
    off = np.linalg.norm(away - along[:, None] * unit, axis=1)
    if off[1:-1].max() > STRAIGHT_RAD:
        return int(np.argmax(off[1:-1])) + 1
    back = np.flatnonzero(np.diff(along) < -STRAIGHT_RAD)
    return int(back[0]) if len(back) else None


def rests_at(model: UrModel, trajectory: Trajectory, rows: NDArray[np.intp]) -> bool:
    """Whether the arm can be at rest at each of the rows: beside it no joint is faster than one step of braking allows.

    Args:
        model: The arm: its acceleration limit.
        trajectory: The samples.
        rows: Rows between the ends.
    """
    steps = np.diff(trajectory.times_s)[:, None]
    most = model.max_acceleration * steps**2 * (1.0 + REST_SLACK)
    slow = np.all(np.abs(np.diff(trajectory.q, axis=0)) <= most, axis=1)
    return bool((slow[rows - 1] & slow[rows]).all())
