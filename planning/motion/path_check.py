"""Checks of a finished joint path: dense states, the first contact, and the least clearance."""

from heapq import heappop, heappush

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies import DISTANCE_PAIRS, Contact, Distances, Nearest
from puncture_twin.planning.collision.checker import CellChecker
from puncture_twin.planning.collision.fast_checker import FastChecker

RESOLUTION_RAD = 0.05
"""Joint distance of the states at which FCL alone checks a segment: up to 50 mm at a metre, never the last word."""
FINER = 10
"""The check of the finished trajectory is this many times finer, and no body moves more than ``MAX_SWEEP_MM`` between
its states."""
MAX_SWEEP_MM = 2.0
"""So fine that no body point moves farther between two checked states."""
CLEARANCE_STEP_MM = 1.0
"""The least clearance is found to this: states that cannot improve on it by more are passed over."""
ROUGHLY_MM = 10.0
"""To this the least clearance is sought first; then a fast checker passes over what it proves to be no nearer."""
_At = tuple[int, float]
"""Index of a state and a body's distance there, mm."""
_Stretch = tuple[float, str, _At, _At]
"""Of a path: how near a body might come between two states, mm; the body; its ends."""


def path_length(waypoints: Floats) -> float:
    """Joint-space length of straight segments through (k, 6), rad."""
    return float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())


def dense_states(checker: CellChecker, waypoints: Floats, step_rad: float) -> Floats:
    """States along a path, so close that neither joint distance nor any body's motion exceeds its bound.

    Shape (m, 6), rad, all waypoints (k, 6) among them. ``MAX_SWEEP_MM`` bounds the motion of the bodies.
    """
    waypoints = np.asarray(waypoints, dtype=np.float64)
    lengths = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
    counts = np.maximum(1, np.ceil(lengths / step_rad)).astype(np.int64)
    while True:
        states = path_states(waypoints, counts)
        if len(counts) == 0:
            return states
        farthest = np.maximum.reduceat(checker.sweep_mm(states), np.cumsum(counts) - counts)
        if farthest.max() <= MAX_SWEEP_MM:
            return states
        counts = np.ceil(counts * np.maximum(1.0, farthest / MAX_SWEEP_MM)).astype(np.int64)


def path_states(waypoints: Floats, counts: NDArray[np.int64]) -> Floats:
    """The waypoints (k, 6) and states between them, each segment in its count of equal steps."""
    segment = np.repeat(np.arange(len(counts)), counts)
    fraction = (np.arange(len(segment)) - np.repeat(np.cumsum(counts) - counts, counts)) / np.repeat(counts, counts)
    rows = waypoints[segment] + fraction[:, None] * (waypoints[segment + 1] - waypoints[segment])
    return np.concatenate([rows, waypoints[-1:]])


def first_contact(checker: CellChecker, q_path: Floats) -> Contact | None:
    """The first contact along states (m, 6), the needle being outside the patient; None if all are free."""
    first = checker.first_contact(q_path, needle_may_touch_patient=False)
    return None if first is None else first.contact


def least_clearance(checker: CellChecker, q_path: Floats) -> Distances:
    """The least of each distance over states (m, 6) along a path, to ``CLEARANCE_STEP_MM``."""
    path = _Path(checker, np.asarray(q_path, dtype=np.float64))
    return Distances(*(path.least(pair) for pair in DISTANCE_PAIRS))


class _Path:
    """States whose distances are measured. A body's distance changes by no more than the body moves."""

    def __init__(self, checker: CellChecker, q: Floats) -> None:
        self._checker, self._q = checker, q
        sweeps = checker.body_sweeps_mm(q)
        self._moved = {body: np.concatenate([[0.0], np.cumsum(sweep)]) for body, sweep in sweeps.items()}

    def least(self, pair: str) -> Nearest:
        """The least of one kind of distance along the path."""
        if not isinstance(self._checker, FastChecker):
            return self._split(pair, CLEARANCE_STEP_MM)
        best, motion = self._split(pair, ROUGHLY_MM), self._checker.motion(self._q)
        for body in DISTANCE_PAIRS[pair] if np.isfinite(best.mm) else ():
            at = self._checker.next_nearer(motion, 0, pair, body, best.mm - CLEARANCE_STEP_MM)
            while at >= 0:
                distance = self._checker.nearest(self._q[at], pair, body)
                best = min(best, distance)
                moved = self._moved[body]
                at = int(np.searchsorted(moved, moved[at] + distance.mm - best.mm + CLEARANCE_STEP_MM))
                if at >= len(moved):
                    break
                at = self._checker.next_nearer(motion, at, pair, body, best.mm - CLEARANCE_STEP_MM)
        return best

    def _split(self, pair: str, tolerance_mm: float) -> Nearest:
        """The least to a tolerance: the stretch that might be nearest is split until none might (Piyavskii 1972)."""
        stretches: list[_Stretch] = []
        last, best = len(self._q) - 1, Nearest(np.inf, "", "")
        for body in DISTANCE_PAIRS[pair]:
            ends = [(at, self._checker.nearest(self._q[at], pair, body)) for at in (0, last)]
            best = min(best, *(distance for _, distance in ends))
            self._push(stretches, body, *((at, distance.mm) for at, distance in ends))
        while stretches and stretches[0][0] < best.mm - tolerance_mm:
            _, body, first, second = heappop(stretches)
            moved = self._moved[body]
            lowest = (moved[first[0]] + moved[second[0]] + first[1] - second[1]) / 2.0
            at = int(np.clip(np.searchsorted(moved, lowest), first[0] + 1, second[0] - 1))
            distance = self._checker.nearest(self._q[at], pair, body)
            best = min(best, distance)
            self._push(stretches, body, first, (at, distance.mm))
            self._push(stretches, body, (at, distance.mm), second)
        return best

    def _push(self, stretches: list[_Stretch], body: str, first: _At, second: _At) -> None:
        """Add a stretch with states between its ends, by how near the body might come there."""
        if second[0] - first[0] > 1 and np.isfinite(first[1]):
            moved = self._moved[body]
            nearest = (first[1] + second[1] - (moved[second[0]] - moved[first[0]])) / 2.0
            heappush(stretches, (float(nearest), body, first, second))
