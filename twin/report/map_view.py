"""Projection of directions to the map: the cap seen from outside, θ as distance from the centre, β counter-clockwise.

Who looks from outside along -z of the entry frame sees its z axis come out of the paper, and x, y right-handed: β runs
counter-clockwise, with no mirroring. For a patient the map is turned so that the head is at the top where that is
possible (else the front); seen from the front, the patient's right is then on the left, as on a radiograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np

from puncture_twin.planning.base.arrays import Floats, Ints
from puncture_twin.planning.case.entry import ANATOMICAL_LPS, angles
from puncture_twin.planning.search.candidates import Candidates

NAMES_LPS = {"left": "patient's left", "right": "patient's right", "posterior": "back", "anterior": "front"}
"""Head and feet are called so."""

IN_PLANE = 0.5  # least sine to the view axis at which a body direction has a place at the rim (30 degrees)
BEYOND = np.radians(92.0)  # a map whose rim lies beyond this shows directions from the far side, and says so
SAME_PLACE = np.radians(20.0)  # rim labels nearer than this share one line
RING_SLACK = 1e-7  # two θ nearer than this (rad) are one ring of the grid
RING = 8.0  # more than a turn: by it rings lie beside one another where all cells are in one order
HALF_CELL_SLACK = 1e-6  # share by which rounding may widen half a cell


class RimLabel(NamedTuple):
    """A body direction at the rim: its text and its angle on the picture, counter-clockwise from the right."""

    text: str
    angle: float


@dataclass(frozen=True)
class MapView:
    """Geometry of the map: rotation, extent, labels of the rim and the centre."""

    turn: float  # angle on the picture, counter-clockwise from the right, at which β = 0 lies
    theta_max: float  # θ at the rim, rad
    rim: tuple[RimLabel, ...]  # body directions around the rim
    centre: str  # what the viewer looks at: the body direction that θ = 0 points to, or ""

    def place(self, theta: Floats, beta: Floats) -> Floats:
        """Points of the unit disc (x right, y up), shape (n, 2), of directions."""
        radius = np.asarray(theta) / self.theta_max
        angle = np.asarray(beta) + self.turn
        return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)

    def angles_at(self, points: Floats) -> tuple[Floats, Floats]:
        """The directions (θ, β in 0..2π) at points of the unit disc, shape (..., 2)."""
        theta = np.hypot(points[..., 0], points[..., 1]) * self.theta_max
        beta = np.mod(np.arctan2(points[..., 1], points[..., 0]) - self.turn, 2 * np.pi)
        return theta, beta


def body_directions(space: str) -> dict[str, Floats]:
    """Unit vectors in the CT frame by their names: the patient's, or the axes of a local frame."""
    if str(space) == "local":
        names = ((f"{sign}{axis}", i, s) for i, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("−", -1.0)))
        return {name: s * np.eye(3)[i] for name, i, s in names}
    return {NAMES_LPS.get(name, name): np.array(vector) for name, vector in ANATOMICAL_LPS.items()}


def map_view(case: Any, candidates: Candidates) -> MapView:
    """The view for a case: turned so that head (or front) is up, with its labels."""
    to_entry = np.asarray(case.T_ct_entry)[:3, :3].T
    vectors = {name: to_entry @ v for name, v in body_directions(case.space).items()}
    rotation = 0.0
    for name in ("head", "front"):
        if name in vectors and np.hypot(*vectors[name][:2]) > IN_PLANE:
            rotation = np.pi / 2 - float(np.arctan2(vectors[name][1], vectors[name][0]))
            break
    theta_max = float(candidates.theta.max(initial=0.0)) + 0.5 * grid_step(candidates)
    centre = max(vectors, key=lambda name: vectors[name][2])
    exact = vectors[centre][2] > np.cos(np.radians(1.0))
    rim: list[RimLabel] = []
    for name, vector in vectors.items():
        theta, beta = (float(a) for a in angles(vector / np.linalg.norm(vector)))
        if np.sin(theta) < IN_PLANE:
            continue
        text = name if abs(theta - np.pi / 2) < np.radians(1.0) else f"{name} (θ {np.degrees(theta):.0f}°)"
        angle = float(np.mod(beta + rotation, 2 * np.pi))
        near = [i for i, other in enumerate(rim) if abs(_angle_between(other.angle, angle)) < SAME_PLACE]
        if near:
            rim[near[0]] = RimLabel(f"{rim[near[0]].text} / {text}", rim[near[0]].angle)
        else:
            rim.append(RimLabel(text, angle))
    return MapView(rotation, theta_max, tuple(rim), centre if exact else "")


def grid_step(candidates: Candidates) -> float:
    """The grid's step in θ (else in β), rad; one degree where there is one direction only."""
    for values in (candidates.theta, candidates.beta):
        gaps = np.diff(np.unique(values))
        gaps = gaps[gaps > RING_SLACK]
        if len(gaps):
            return float(gaps.min())
    return float(np.radians(1.0))


@dataclass(frozen=True, eq=False)
class MapCells:
    """The grid's cells, ring after ring of equal θ, and in each ring by β in 0..2π."""

    rows_in_order: Ints  # shape (n,), the candidate of each cell
    beta: Floats  # shape (n,), rad, in 0..2π
    starts: Ints  # shape (k + 1,), where each ring begins
    heights: Floats  # shape (k,), θ of each ring, ascending, rad
    half_theta: float  # half a cell, rad
    half_beta: Floats  # shape (k,), half a cell of each ring, rad

    @classmethod
    def of(cls, candidates: Candidates) -> MapCells:
        """The cells of a search's grid."""
        step, wrapped = grid_step(candidates), np.mod(candidates.beta, 2 * np.pi)
        by_theta = np.argsort(candidates.theta, kind="stable")
        fresh = np.diff(candidates.theta[by_theta]) > RING_SLACK
        ring = np.empty(len(by_theta), dtype=np.int64)
        ring[by_theta] = np.concatenate([[0], np.cumsum(fresh)])
        order = np.lexsort([wrapped, ring])
        starts = np.concatenate([[0], np.flatnonzero(np.diff(ring[order])) + 1, [len(order)]])
        heights = candidates.theta[by_theta[starts[:-1]]]
        beta, half = wrapped[order], step / 2 * (1 + HALF_CELL_SLACK)
        half_beta = np.empty(len(heights))
        for i, (begin, end) in enumerate(pairwise(starts)):
            gaps = np.diff(beta[begin:end])
            half_beta[i] = float(np.median(gaps)) / 2 * (1 + HALF_CELL_SLACK) if len(gaps) else half
            if heights[i] < RING_SLACK and len(gaps) == 0:
                half_beta[i] = np.inf  # one cell at the pole
        return cls(order, beta, starts, heights, half, half_beta)

    def rows(self, theta: Floats, beta: Floats) -> Ints:
        """The candidate at each direction (rad, β in 0..2π), -1 outside the grid; same shape as ``theta``."""
        theta, beta = np.asarray(theta, dtype=float), np.asarray(beta, dtype=float)
        last, heights = len(self.heights) - 1, self.heights
        above = np.minimum(np.searchsorted(heights, theta), last)
        below = np.maximum(above - 1, 0)
        ring = np.where(theta - heights[below] <= heights[above] - theta, below, above)
        cells = np.repeat(np.arange(last + 1), np.diff(self.starts)) * RING + self.beta  # ascend along all rings
        after = np.searchsorted(cells, ring * RING + beta)
        begin, end = self.starts[ring], self.starts[ring + 1]
        before, after = np.where(after > begin, after, end) - 1, np.where(after < end, after, begin)
        ahead, behind = (np.abs(_angle_between(self.beta[one], beta)) for one in (after, before))
        near = (np.minimum(ahead, behind) <= self.half_beta[ring]) & (np.abs(theta - heights[ring]) <= self.half_theta)
        return np.where(near, self.rows_in_order[np.where(ahead < behind, after, before)], -1)

    def picture(self, view: MapView, size: int) -> Ints:
        """The candidate under the middle of each pixel of a square picture of the disc, shape (size, size)."""
        middles = (np.arange(size) + 0.5) / size * 2 - 1
        return self.rows(*view.angles_at(np.stack(np.meshgrid(middles, -middles), axis=-1)))


def _angle_between(a: Any, b: Any) -> Any:
    return np.mod(np.asarray(a) - b + np.pi, 2 * np.pi) - np.pi
