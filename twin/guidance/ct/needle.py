"""A needle in a CT: its axis by a line through the middles of its cross sections, its tip where half of it is left."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy import ndimage

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.base.errors import InputError
from puncture_twin.planning.formats.volumes.volume_files import Volume
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.ct.metal import Metal, centroid, metal_pieces, metal_weights

SHORTEST_MM = 20.0
"""A shorter piece of metal is no needle."""
STEP_MM = 0.25
"""Along the needle."""
WIDE_MM = 4.0
"""About the axis, so far a cross section is looked at."""
SHAFT_MM = (5.0, 25.0)
"""Behind the tip, where the needle is whole: what a full cross section shows."""


class FoundNeedle(NamedTuple):
    """What was found, LPS mm.

    Attributes:
        tip_ct: Shape (3,).
        forward_ct: Shape (3,), unit, to the tip.
        width_mm: Root mean square distance of its metal from the axis.
    """

    tip_ct: Floats
    forward_ct: Floats
    width_mm: float


def find_needle(volume: Volume, target_ct: Floats) -> FoundNeedle:
    """Find the needle of a control CT.

    Args:
        volume: The CT.
        target_ct: Shape (3,), LPS mm: its tip is the end nearer to this.

    Raises:
        InputError: No long piece of metal.
    """
    rods = [piece for piece in metal_pieces(volume) if piece.size_mm >= SHORTEST_MM]
    if not rods:
        allowed = f"a piece of metal of {SHORTEST_MM:g} mm or more"
        raise InputError("no needle in the image", where=volume.path, allowed=allowed)
    metal = min(rods, key=lambda piece: _gap(piece, volume, target_ct))
    middle, forward, width = _axis(volume, metal, target_ct)
    return FoundNeedle(_tip(volume, metal, middle, forward), forward, width)


def _gap(metal: Metal, volume: Volume, point_ct: Floats) -> float:
    index = np.argwhere(metal.voxels) + [axis.start for axis in metal.box]
    return float(np.linalg.norm(apply(volume.T_ct_index, index.astype(float)) - point_ct, axis=1).min())


def _axis(volume: Volume, metal: Metal, target_ct: Floats) -> tuple[Floats, Floats, float]:
    """Middle and direction of the weighted line of least squares, and how far the metal lies from it."""
    weights = metal_weights(volume, metal)
    at = np.argwhere(weights > 0)
    heavy = weights[tuple(at.T)]
    points = apply(volume.T_ct_index, at + np.array([axis.start for axis in metal.box], dtype=float))
    middle = centroid(weights, metal.box, volume.T_ct_index)
    spread = (points - middle) * np.sqrt(heavy / heavy.sum())[:, None]
    _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
    forward = axes[0] if (target_ct - middle) @ axes[0] > 0 else -axes[0]
    return middle, forward, float(np.hypot(sizes[1], sizes[2]))


def _tip(volume: Volume, metal: Metal, middle: Floats, forward: Floats) -> Floats:
    """Where the metal of a cross section falls to half of what the shaft behind shows."""
    weights = metal_weights(volume, metal)
    T_index_ct = np.linalg.inv(volume.T_ct_index)
    along = np.arange(-np.ceil(np.linalg.norm(middle - _corner(volume, metal, forward))), WIDE_MM * 4, STEP_MM)
    end = _corner(volume, metal, forward)
    stations = middle + ((end - middle) @ forward + along[:, None]) * forward
    side = np.linalg.svd(forward[None])[2][1:]
    grid = np.arange(-WIDE_MM, WIDE_MM + STEP_MM, 2 * STEP_MM)
    u, v = (one.ravel() for one in np.meshgrid(grid, grid))
    disc = np.hypot(u, v) <= WIDE_MM
    section = u[disc, None] * side[0] + v[disc, None] * side[1]
    index = apply(T_index_ct, stations[:, None] + section) - [axis.start for axis in metal.box]
    profile = ndimage.map_coordinates(weights, np.moveaxis(index, -1, 0), order=1, cval=0.0).sum(axis=1)
    return _half(profile, stations, forward)


def _corner(volume: Volume, metal: Metal, forward: Floats) -> Floats:
    """The voxel of the piece that lies foremost, LPS mm."""
    index = np.argwhere(metal.voxels) + [axis.start for axis in metal.box]
    points = apply(volume.T_ct_index, index.astype(float))
    return np.asarray(points[np.argmax(points @ forward)])


def _half(profile: Floats, stations: Floats, forward: Floats) -> Floats:
    """The foremost station at half of the shaft's level, between two stations."""
    above = int(np.flatnonzero(profile > 0.5 * profile.max())[-1])
    behind = (stations[above] - stations) @ forward
    shaft = (behind >= SHAFT_MM[0]) & (behind <= SHAFT_MM[1])
    level = 0.5 * float(np.median(profile[shaft] if shaft.any() else profile[: above + 1]))
    last = int(np.flatnonzero(profile > level)[-1])
    drop = profile[last] - (profile[last + 1] if last + 1 < len(profile) else 0.0)
    return np.asarray(stations[last] + (profile[last] - level) / drop * STEP_MM * forward)
