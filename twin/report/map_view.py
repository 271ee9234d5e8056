"""How directions lie on the map: the cap seen from outside, θ as distance from the centre, β counter-clockwise.

Who looks from outside along -z of the entry frame sees its z axis come out of the paper, and x, y right-handed: β runs
counter-clockwise, with no mirroring. For a patient the map is turned so that the head is at the top where that is
possible (else the front); seen from the front, the patient's right is then on the left, as on a radiograph.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from planning.candidates import Candidates
from planning.entry import ANATOMICAL_LPS, angles

Floats = NDArray[np.float64]

WORDS_LPS = {
    "left": "patient's left",
    "right": "patient's right",
    "posterior": "back",
    "anterior": "front",
    "head": "head",
    "feet": "feet",
}

IN_PLANE = 0.5
"""Least sine of the angle to the view axis at which a body direction gets a place at the rim (30 degrees)."""

SAME_PLACE = np.radians(20.0)
"""Rim labels nearer than this share one line."""

RING_SLACK = 1e-7
"""Two θ nearer than this (rad) are one ring of the grid."""

HALF_CELL_SLACK = 1e-6
"""Share by which rounding may widen half a cell."""


class RimLabel(NamedTuple):
    """A body direction at the rim: its text and its angle on the picture, counter-clockwise from the right."""

    text: str
    angle: float


@dataclass(frozen=True)
class MapView:
    """The map's geometry.

    Attributes:
        turn: Angle on the picture, counter-clockwise from the right, at which β = 0 lies.
        theta_max: θ at the rim, rad.
        rim: Body directions around the rim.
        centre: What the viewer looks at: the body direction that θ = 0 points to, or "".
    """

    turn: float
    theta_max: float
    rim: tuple[RimLabel, ...]
    centre: str

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
    """Unit vectors in the CT frame and what to call them: the patient's, or the axes of a local frame."""
    if str(space) == "local":
        names = ((f"{sign}{axis}", i, s) for i, axis in enumerate("xyz") for sign, s in (("+", 1.0), ("−", -1.0)))
        return {name: s * np.eye(3)[i] for name, i, s in names}
    return {WORDS_LPS[name]: np.array(vector) for name, vector in ANATOMICAL_LPS.items()}


def map_view(case: Any, candidates: Candidates) -> MapView:
    """The view for a case: turned so that head (or front) is up, with its labels."""
    to_entry = np.asarray(case.T_ct_entry)[:3, :3].T
    vectors = {name: to_entry @ v for name, v in body_directions(case.space).items()}
    turn = 0.0
    for name in ("head", "front"):
        if name in vectors and np.hypot(*vectors[name][:2]) > IN_PLANE:
            turn = np.pi / 2 - float(np.arctan2(vectors[name][1], vectors[name][0]))
            break
    theta_max = float(candidates.theta.max(initial=0.0)) + 0.5 * step_of(candidates)
    centre = max(vectors, key=lambda name: vectors[name][2])
    exact = vectors[centre][2] > np.cos(np.radians(1.0))
    return MapView(turn, theta_max, _rim(vectors, turn), centre if exact else "")


def _rim(vectors: dict[str, Floats], turn: float) -> tuple[RimLabel, ...]:
    labels: list[RimLabel] = []
    for name, vector in vectors.items():
        theta, beta = (float(a) for a in angles(vector / np.linalg.norm(vector)))
        if np.sin(theta) < IN_PLANE:
            continue
        sideways = abs(theta - np.pi / 2) < np.radians(1.0)
        text = name if sideways else f"{name} (θ {np.degrees(theta):.0f}°)"
        angle = float(np.mod(beta + turn, 2 * np.pi))
        near = [i for i, other in enumerate(labels) if abs(_turn_between(other.angle, angle)) < SAME_PLACE]
        if near:
            labels[near[0]] = RimLabel(f"{labels[near[0]].text} / {text}", labels[near[0]].angle)
        else:
            labels.append(RimLabel(text, angle))
    return tuple(labels)


def step_of(candidates: Candidates) -> float:
    """The grid's step in θ (else in β), rad; one degree where there is one direction only."""
    for values in (candidates.theta, candidates.beta):
        gaps = np.diff(np.unique(values))
        gaps = gaps[gaps > RING_SLACK]
        if len(gaps):
            return float(gaps.min())
    return float(np.radians(1.0))


def rows_at(candidates: Candidates, theta: Floats, beta: Floats) -> NDArray[np.int64]:
    """The row of the grid cell that holds each direction, -1 outside the grid; same shape as ``theta``.

    A cell reaches half a step to each side in θ and in β. At θ = 0 the cell is the whole circle.
    """
    step = step_of(candidates)
    order = np.argsort(candidates.theta, kind="stable")
    cuts = np.flatnonzero(np.diff(candidates.theta[order]) > RING_SLACK) + 1
    rings = np.split(order, cuts)
    heights = np.array([candidates.theta[ring[0]] for ring in rings])
    edges = (heights[1:] + heights[:-1]) / 2
    ring_of = np.searchsorted(edges, theta)
    rows = np.full(theta.shape, -1, dtype=np.int64)
    half = step / 2 * (1 + HALF_CELL_SLACK)
    inside = (theta <= heights[ring_of] + half) & (theta >= heights[ring_of] - half)
    for index, ring in enumerate(rings):
        here = inside & (ring_of == index)
        if here.any():
            rows[here] = _rows_in_ring(candidates.beta[ring], ring, beta[here], step, heights[index])
    return rows


def _rows_in_ring(
    beta_ring: Floats, ring: NDArray[np.int64], beta: Floats, step: float, theta: float
) -> NDArray[np.int64]:
    wrapped = np.mod(beta_ring, 2 * np.pi)
    order = np.argsort(wrapped, kind="stable")
    wrapped, ring = wrapped[order], ring[order]
    after = np.searchsorted(wrapped, beta) % len(ring)
    before = (after - 1) % len(ring)
    nearer = np.abs(_turn_between(wrapped[after], beta)) < np.abs(_turn_between(wrapped[before], beta))
    pick = np.where(nearer, after, before)
    gaps = np.diff(wrapped)
    half = (float(np.median(gaps)) if len(gaps) else step) / 2 * (1 + HALF_CELL_SLACK)
    pole = theta < RING_SLACK and len(ring) == 1
    near = pole | (np.abs(_turn_between(wrapped[pick], beta)) <= half)
    return np.where(near, ring[pick], -1)


def _turn_between(a: Any, b: Any) -> Any:
    return np.mod(np.asarray(a) - b + np.pi, 2 * np.pi) - np.pi
