"""How far from a waypoint the arm may leave the planned way to round its corner: as far as FCL finds everything free.

Within a blend the controller leaves both straight segments. Its curve is not published; what is taken here is that it
stays, joint by joint, a mix of the two stretches that it replaces: in the triangle of angles between where the blend
begins, the waypoint, and where it ends. All of that triangle is checked, so finely that no body moves more than
``MAX_SWEEP_MM`` between checked states, as on the approach itself.
"""

from __future__ import annotations

import math

import numpy as np

from puncture_twin.planning.arm.kinematics import flange_pose
from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.checker import StateChecker
from puncture_twin.planning.motion.approach import MAX_SWEEP_MM

GRID_MM = MAX_SWEEP_MM / 2.0
"""In two directions: no state of the triangle is farther from a checked one than half of ``MAX_SWEEP_MM``."""

LARGEST_BLEND_MM = 5.0
"""The first radius tried: enough not to stop, small against the room that a plan leaves."""

SMALLEST_BLEND_MM = 1.0
"""Radii are halved down to this; then the arm stops at the waypoint."""

LARGEST_FRACTION = 0.45
"""Of each segment, so that two blends never meet: the controller skips a waypoint whose blend overlaps the next."""

SAMPLES = 400
"""Along a segment, to find where the tip comes within the radius."""


def blend_radii_mm(checker: StateChecker, waypoints: Floats) -> Floats:
    """A radius for each waypoint between the ends; 0 where no corner may be cut.

    Args:
        checker: Judges contacts in the plan's own scene; its tool has the needle whose tip is the TCP.
        waypoints: Shape (k, 6), rad.

    Returns:
        Shape (k - 2,), mm.
    """
    corners = range(1, len(waypoints) - 1)
    return np.array([_radius_mm(checker, waypoints[at - 1 : at + 2]) for at in corners])


def _radius_mm(checker: StateChecker, waypoints: Floats) -> float:
    """The largest radius tried that is free, of the corner between three waypoints (3, 6)."""
    before, corner, after = waypoints
    radius = LARGEST_BLEND_MM
    while radius >= SMALLEST_BLEND_MM:
        starts, ends = (_fraction_within(checker, corner, other, radius) for other in (before, after))
        if max(starts, ends) <= LARGEST_FRACTION and _free(
            checker, corner, starts * (before - corner), ends * (after - corner)
        ):
            return radius
        radius /= 2.0
    return 0.0


def _fraction_within(checker: StateChecker, corner: Floats, other: Floats, radius_mm: float) -> float:
    """The last fraction of the path from a corner at which the tip is still within a radius of it, or the next sample.

    1 where the tip is so near the other end, so that half of the distance between two tips bounds both radii.
    """
    fractions = np.linspace(0.0, 1.0, SAMPLES + 1)
    poses = flange_pose(checker.model, corner + fractions[:, None] * (other - corner))
    tips = poses[:, :3, 3] + checker.tool.needle_length_mm * poses[:, :3, 2]
    far = np.linalg.norm(tips - tips[0], axis=1)
    if radius_mm > LARGEST_FRACTION * far[-1]:
        return 1.0
    return float(fractions[min(SAMPLES, int(np.flatnonzero(far <= radius_mm)[-1]) + 1)])


def _free(checker: StateChecker, corner: Floats, back: Floats, ahead: Floats) -> bool:
    """Whether every state of the triangle corner, corner + back, corner + ahead is free of contact."""
    states = _triangle(checker, corner, back, ahead)
    return all(checker.contact(q, needle_may_touch_patient=False) is None for q in states)


def _triangle(checker: StateChecker, corner: Floats, back: Floats, ahead: Floats) -> Floats:
    """States of a triangle, (m, 6), in rays from its corner: neighbours on a ray or across are within ``GRID_MM``."""
    rays, steps = 1, 1
    while True:
        turn = np.linspace(0.0, 1.0, rays + 1)[:, None, None]
        along = np.linspace(0.0, 1.0, steps + 1)[None, :, None]
        grid = corner + along * ((1.0 - turn) * back + turn * ahead)
        outward = max(float(checker.sweep_mm(ray).max()) for ray in grid)
        across = max(float(checker.sweep_mm(arc).max()) for arc in grid.swapaxes(0, 1)[1:])
        if max(outward, across) <= GRID_MM:
            return grid[:, 1:].reshape(-1, 6)
        rays = math.ceil(rays * max(1.0, across / GRID_MM))
        steps = math.ceil(steps * max(1.0, outward / GRID_MM))
