"""An open head for the stereo way: a skull without its cap, markers outside on it, targets in the hollow.

Its frame is the image's: x to the left ear, y to the back of the head, z up, origin in the middle of the brain, mm.
The shapes are our own; the sizes are those of an adult's head. The cap is off so that two cameras see a ball that
stands on a target; a target is a place in the air of the hollow, as the end of a pin that is taken out.
"""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.mesh import TriangleMesh
from tools.phantoms.implicit import Field, above, below, capsule, carve, ellipsoid, union, within
from tools.phantoms.mesher import SamplingBox, mesh_field

RIM_MM = 22.0
"""Height at which the cap is cut off."""
FOOT_MM = -105.0
"""Where the neck stands on the table."""
SKULL_RADII_MM = (76.0, 94.0, 88.0)
WALL_MM = 9.0
"""Skull and skin together."""
FLOOR_MM = -42.0
"""Depth of the hollow."""

MARKERS_MM = {
    "M1": (-42.0, -79.0, 26.0),
    "M2": (42.0, -79.0, 26.0),
    "M3": (-76.0, 5.0, 26.0),
    "M4": (76.0, 5.0, 26.0),
    "M5": (-45.0, 76.0, 26.0),
    "M6": (45.0, 76.0, 26.0),
    "M7": (0.0, -101.0, -12.0),
}
"""Centres of the marker balls: six about the rim, and one on the forehead, lower, that keeps them from one plane."""
SPACING_MM = 3.8
_ROUNDING_MM = 4.0


def head_field() -> Field:
    """The head's solid, negative inside: skull, face and neck, without the cap and the hollow."""
    skull = ellipsoid((0.0, 0.0, 0.0), SKULL_RADII_MM)
    face = ellipsoid((0.0, -46.0, -58.0), (52.0, 44.0, 46.0))
    nose = capsule((0.0, -84.0, -36.0), (0.0, -98.0, -56.0), 7.0, 9.0)
    neck = capsule((0.0, 18.0, -60.0), (0.0, 18.0, -130.0), 52.0)
    outside = union([skull, face, nose, neck], 14.0)
    inner = ellipsoid((0.0, 0.0, 0.0), [radius - WALL_MM for radius in SKULL_RADII_MM])
    hollow = within(inner, [above(2, FLOOR_MM)], 10.0)
    return carve(within(outside, [below(2, RIM_MM), above(2, FOOT_MM)], _ROUNDING_MM), [hollow], 1e-3, _ROUNDING_MM)


def head_mesh() -> TriangleMesh:
    """The head, closed, triangles outward, its own frame, mm."""
    return mesh_field(head_field(), SamplingBox((-88.0, -122.0, -118.0), (88.0, 106.0, 38.0), SPACING_MM))


def head_targets() -> dict[str, Floats]:
    """Sixteen targets T1 to T16 in the hollow: two rings of eight, the lower one narrower and turned by half a step."""
    targets = []
    for radius, height, turn in ((36.0, 12.0, 0.0), (24.0, -8.0, np.pi / 8)):
        angles = turn + np.arange(8) * np.pi / 4
        rises = 4.0 * np.cos(2 * angles)
        targets += [np.array([radius * np.cos(a), 1.2 * radius * np.sin(a), height + r])
                    for a, r in zip(angles, rises, strict=True)]  # fmt: skip
    return {f"T{number}": np.round(target, 3) for number, target in enumerate(targets, start=1)}
