"""The needle's direction V in its flange frame, from the directions seen in the image or from the image plane alone."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.twin.guidance.ultrasound.axp_ybq.estimate import Estimate
from puncture_twin.twin.guidance.ultrasound.axp_ybq.recording import Recording
from puncture_twin.twin.guidance.ultrasound.axp_ybq.residuals.direction_residuals import (
    direction_residuals,
    directions_end2,
    directions_image,
    needle_in_image,
)

HALF_NORMAL = 0.6745
"""Median of |x| for a standard normal x."""
FAR = 5.0
"""A direction this many standard deviations from the median one does not agree with it."""
LEAST_ANGLE = 1e-6
"""Rad: closer than this all directions agree; it is rounding."""
LEAST_SPREAD = 1e-9
"""Rad: no spread is taken to be less."""


class SeenDirection(NamedTuple):
    """The needle's direction as the poses agree on it."""

    V: Floats
    """Shape (3,), unit, frame end2."""
    agrees: NDArray[np.bool_]
    """Shape (n,)."""
    spread_rad: float
    """Root mean square angle inside the image between what was measured and what V gives."""
    lean_rad: float
    """The same across the image."""


def needle_direction(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_]) -> SeenDirection:
    """V, from the directions that agree, or from the image plane alone.

    Args:
        estimate: R_X, R_Y and t_Q.
        recording: The poses.
        kept: Shape (n,): poses whose tip is trusted.
    """
    if recording.v is not None:
        return agreed_direction(estimate, recording, kept)
    V = direction_from_plane(estimate, recording.subset(kept))
    V = V if V @ estimate.t_Q > 0 else -V  # the tip lies ahead of the flange
    return SeenDirection(V, np.ones(len(recording), dtype=bool), 1.0, 1.0)


def mean_direction(estimate: Estimate, recording: Recording) -> Floats:
    """V = normalise(sum M_i^T v_i), shape (3,), frame end2.

    Every M_i is a rotation from end2 to image, so that M_i^T v_i is the direction itself, seen by pose i.

    Args:
        estimate: R_X and R_Y.
        recording: With directions.
    """
    total = directions_end2(estimate, recording).sum(axis=0)
    return np.asarray(total / np.linalg.norm(total))


def agreed_direction(estimate: Estimate, recording: Recording, kept: NDArray[np.bool_]) -> SeenDirection:
    """V from the poses that agree on it: the mean without those far from the median direction.

    Args:
        estimate: R_X and R_Y.
        recording: With directions.
        kept: Shape (n,): poses whose tip is trusted; only these make the mean.
    """
    seen = directions_end2(estimate, recording)
    middle = np.median(seen[kept], axis=0)
    angles = np.arccos(np.clip(seen @ middle / np.linalg.norm(middle), -1.0, 1.0))
    limit = max(FAR * float(np.median(angles[kept])) / HALF_NORMAL, LEAST_ANGLE)
    agrees = angles <= limit
    total = (agrees & kept) @ seen
    V = np.asarray(total / np.linalg.norm(total))
    found = direction_residuals(estimate._replace(V=V), recording, directions_image(recording, estimate))
    inside, across = np.sqrt(np.mean(found[agrees & kept] ** 2, axis=0))
    return SeenDirection(V, agrees, max(float(inside), LEAST_SPREAD), max(float(across), LEAST_SPREAD))


def direction_from_plane(estimate: Estimate, recording: Recording) -> Floats:
    """V from nothing but the fact that the needle lies in the image: z.M_i V = 0 for every pose. Its sign is not known.

    Needs poses between which the needle turned about itself; otherwise V is not unique.
    """
    across_image = needle_in_image(estimate, recording)[:, 2, :]
    return np.asarray(np.linalg.svd(across_image)[2][-1])
