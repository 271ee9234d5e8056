"""Probe calibration from wires: where the image lies on the probe, from points seen on straight wires of known place.

The unknowns are those of a PLUS calibration: T_probe_image without its third column, which no image point excites (9
numbers: the two axes in mm per pixel, with their lengths and the angle between them free, and the origin). A point
(u, v), seen on a wire through a with unit direction d, satisfies (I - d d^T)(R_i (u x1 + v x2 + t) + t_i - a) = 0: it
is linear in the unknowns, so that the least squares of the distances need no start.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.errors import refuse

Floats = NDArray[np.float64]
LEAST_FRAMES = 3
"""Fewer frames of one probe orientation could not tell the nine numbers apart."""
LEAST_RATIO = 1e-4
"""Least over largest singular value of the system (pixels in hundreds) below which the fit is refused."""
PIXELS = 100.0
"""Pixels are counted in this unit, so that the columns of the system are of one size."""


@dataclass(frozen=True, eq=False)
class Wires:
    """Straight wires in the reference frame; directions (k, 3), unit."""

    names: tuple[str, ...]
    points: Floats
    directions: Floats


@dataclass(frozen=True, eq=False)
class WireFrames:
    """Images of the wires, and where each wire was seen, (n, k, 2), pixels."""

    T_reference_probe: Floats
    points_px: Floats


def point_to_wire_mm(T_probe_image: Floats, frames: WireFrames, wires: Wires) -> Floats:
    """Distance of every seen point from its wire, shape (n, k), mm."""
    in_probe = frames.points_px @ T_probe_image[:3, :2].T + T_probe_image[:3, 3]
    T = frames.T_reference_probe
    offset = np.einsum("nij,nkj->nki", T[:, :3, :3], in_probe) + T[:, None, :3, 3] - wires.points
    along = np.einsum("nki,ki->nk", offset, wires.directions)
    return np.asarray(np.linalg.norm(offset - along[:, :, None] * wires.directions, axis=2))


def fit_image(frames: WireFrames, wires: Wires) -> Floats:
    """T_probe_image of least squared distances, (4, 4); its third column is the normal, as long as a mean pixel."""
    if len(frames.points_px) < LEAST_FRAMES:
        refuse(f"{len(frames.points_px)} frames", "wires", f"{LEAST_FRAMES} or more", "too_few_points")
    across = np.eye(3) - wires.directions[:, :, None] * wires.directions[:, None, :]
    T, scaled = frames.T_reference_probe, frames.points_px / PIXELS
    weights = np.concatenate([scaled, np.ones((*scaled.shape[:2], 1))], axis=2)
    blocks = np.einsum("nkc,kij,njm->nkicm", weights, across, T[:, :3, :3])
    right = np.einsum("kij,nkj->nki", across, wires.points - T[:, None, :3, 3])
    system = blocks.reshape(-1, 9)
    solution, _, _, values = np.linalg.lstsq(system, right.ravel(), rcond=None)
    if values[-1] < LEAST_RATIO * values[0]:
        what = f"the probe hardly moved (singular value ratio {values[-1] / values[0]:.1e})"
        refuse(what, "wires", "frames from several sides of the wires", "undetermined")
    x1, x2, origin = solution.reshape(3, 3) / np.array([[PIXELS], [PIXELS], [1.0]])
    normal = np.cross(x1, x2)
    T_probe_image = np.eye(4)
    T_probe_image[:3] = np.column_stack([x1, x2, normal / np.sqrt(np.linalg.norm(normal)), origin])
    return T_probe_image
