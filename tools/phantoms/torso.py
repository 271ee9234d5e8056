"""The walls of the trunk: rib cage, skin, diaphragm, and what stands around the spine.

Patient space LPS, mm: x to the left, y to the back, z to the head; z = 0 is the middle of the second lumbar
vertebra, the patient lies on the back. Measures are those of an adult of middle height and weight.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import PchipInterpolator

from puncture_twin.planning.base.arrays import Floats
from tools.phantoms.implicit import Field, smooth_max, smooth_min

TOP_MM, BOTTOM_MM = 258.0, -192.0
"""The trunk ends here, with rounded rims; like the edge of a scan, these two ends are not real skin."""
CONTENT_TOP_MM, CONTENT_BOTTOM_MM = 236.0, -170.0
"""Organs that go on beyond the trunk (lungs, ribs, great vessels, spine) end here."""
_ROUNDNESS = 2.3
"""Exponent of the section: 2 is an ellipse, larger is more square."""
_Z = (-230.0, -150.0, -90.0, -40.0, 0.0, 40.0, 80.0, 130.0, 180.0, 230.0, 290.0)
_HALF_WIDTH = PchipInterpolator(_Z, (142, 138, 132, 130, 132, 135, 137, 133, 125, 115, 98))
_HALF_DEPTH = PchipInterpolator(_Z, (82, 82, 81, 82, 84, 87, 90, 90, 87, 82, 72))
_CENTRE_Y = PchipInterpolator(_Z, (0, 0, -1, -2, -2, -2, -1, 1, 4, 8, 12))
_FAT = PchipInterpolator(_Z, (26, 26, 24, 23, 22, 21, 20, 20, 21, 22, 22))

VERTEBRA_Z = (-140.0, -108.0, -73.0, -36.0, 0.0, 35.0, 67.0, 97.0, 125.0, 152.0, 178.0, 203.0, 228.0, 252.0, 275.0)
"""Middles of S1, L5 ... L1, T12 ... T4, mm."""
spine_y = PchipInterpolator(
    (-180, -140, -108, -73, -36, 0, 35, 97, 152, 203, 280), (64, 50, 41, 36, 34, 35, 39, 49, 56, 58, 56)
)
"""Where the vertebral bodies' middle lies in y at height z, mm; then their half width and half depth there."""
body_half_width = PchipInterpolator(
    (-180, -150, -125, -100, -36, 35, 97, 152, 203, 280), (50, 43, 30, 26, 24.5, 22.5, 19.5, 17.5, 16, 15)
)
body_half_depth = PchipInterpolator((-180, -125, -73, 0, 97, 203, 280), (17, 18, 17.5, 17, 16, 14.5, 13.5))


def cage(points: Floats) -> Floats:
    """Field of the surface in which the ribs' middle lines lie, and its continuation in the wall of the belly."""
    z = np.clip(points[:, 2], _Z[0], _Z[-1])
    return _section(points[:, 0], points[:, 1] - _CENTRE_Y(z), _HALF_WIDTH(z), _HALF_DEPTH(z))


def on_cage(angle_rad: Floats, z: Floats) -> Floats:
    """Points of the cage (n, 3), mm, at angles (n,) from the back (0) over the right side to the front (pi)."""
    sine, cosine = np.sin(angle_rad), np.cos(angle_rad)
    radius = 1.0 / _superellipse(sine / _HALF_WIDTH(z), cosine / _HALF_DEPTH(z))
    return np.stack([-radius * sine, _CENTRE_Y(z) + radius * cosine, z], axis=1)


def inside_cage(inset_mm: float) -> Field:
    """The room inside the cage, ``inset_mm`` away from it."""
    return lambda points: cage(points) + inset_mm


def skin(points: Floats) -> Floats:
    """Field of the trunk's surface, with navel and furrow of the back."""
    x, y, z = points.T
    height = np.clip(z, _Z[0], _Z[-1])
    fat = _FAT(height)
    navel = 7.0 * np.exp(-(x**2 + (z + 78.0) ** 2) / 55.0) * (y < 0)
    furrow = 5.0 * np.exp(-((x / 16.0) ** 2)) * (y > 0)
    linea = 2.0 * np.exp(-((x / 18.0) ** 2)) * (y < 0)
    wall = _section(x, y - _CENTRE_Y(height), _HALF_WIDTH(height) + fat, _HALF_DEPTH(height) + fat)
    ends = smooth_max(z - TOP_MM, BOTTOM_MM - z, 1.0)
    return smooth_max(wall + navel + furrow + linea, ends, 34.0)


def diaphragm(points: Floats) -> Floats:
    """Field of the workcell below the diaphragm: a high right dome, a lower left one, and the saddle of the heart."""
    right = _dome(points, (-58.0, 0.0), (71.0, 80.0, 112.0))
    left = _dome(points, (64.0, 2.0), (66.0, 78.0, 94.0))
    middle = _dome(points, (-2.0, -10.0), (62.0, 84.0, 94.0))
    return smooth_min(smooth_min(right, left, 20.0), middle, 20.0)


def spinal_mass(points: Floats) -> Floats:
    """Field of the spine with the muscles and crura around it: no organ of the belly or chest enters it."""
    x, y, z = points.T
    height = np.clip(z, -180.0, 280.0)
    middle = spine_y(height)
    psoas = 14.0 / (1.0 + np.exp((z + 5.0) / 22.0))
    bodies = _section(x, y - middle, body_half_width(height) + 7.0 + psoas, body_half_depth(height) + 6.0)
    back = _section(x, y - middle - 45.0, np.full(len(x), 48.0), np.full(len(x), 37.0))
    return smooth_min(bodies, back, 12.0)


def _dome(points: Floats, centre: tuple[float, float], radii: tuple[float, float, float]) -> Floats:
    """An upright half ellipsoid from z = 42 upward, a cylinder below."""
    lift = np.maximum(points[:, 2] - 42.0, 0.0)
    local = np.stack([points[:, 0] - centre[0], points[:, 1] - centre[1], lift], axis=1)
    k = np.linalg.norm(local / radii, axis=1)
    slope = np.linalg.norm(local / np.square(radii), axis=1)
    return np.asarray(k * (k - 1.0) / np.maximum(slope, 1e-9))


def _superellipse(u: Floats, v: Floats) -> Floats:
    return np.asarray((np.abs(u) ** _ROUNDNESS + np.abs(v) ** _ROUNDNESS) ** (1.0 / _ROUNDNESS))


def _section(x: Floats, y: Floats, half_width: Floats, half_depth: Floats) -> Floats:
    """Distance along the ray from the middle of a section to its rim, mm."""
    radius = np.hypot(x, y)
    k = np.maximum(_superellipse(x / half_width, y / half_depth), 1e-9)
    return np.asarray(radius * (1.0 - 1.0 / k))
