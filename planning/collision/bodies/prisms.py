"""Prisms about cylinders."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.collision.bodies.sphere_tree import SLACK_MM

PRISM_SIDES = 24
"""Of the prism about a cylinder: 0.9 % fuller than it."""


FINE_SIDES = 96
"""Of the prism about a cylinder that is held against triangles: 0.05 % fuller than it."""


def prism(radius_mm: float, length_mm: float, sides: int = PRISM_SIDES) -> Floats:
    """Corners of a prism about a cylinder along z, centred: shape (2 ``sides``, 3), mm; those of one end first."""
    turn = 2.0 * np.pi * np.arange(sides) / sides
    outer = (radius_mm + SLACK_MM) / np.cos(np.pi / sides)
    ring = outer * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    half = length_mm / 2.0 + SLACK_MM
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in (-half, half)])


def finer_prism(corners: Floats) -> Floats:
    """Corners of a prism of ``FINE_SIDES`` about the cylinder that :func:`prism` gave these corners about, as there."""
    radius_mm = float(np.hypot(corners[:, 0], corners[:, 1]).max()) * np.cos(2.0 * np.pi / len(corners))
    return prism(radius_mm, float(np.ptp(corners[:, 2])), FINE_SIDES)
