"""Circles in a grey picture by Hough's transform: good for finding, not for measuring (Liu 2007, section 3)."""

from __future__ import annotations

from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from puncture_twin.planning.base.arrays import Floats

RADIUS_RANGE = (0.7, 1.4)
"""Radii that are looked for, in parts of the predicted one: wider than the gate, so that the gate can say no."""
VOTES = 8
"""Edge pixels that must agree on a centre: few, since every circle is measured afterwards."""
EDGE_FRACTION = 0.5
"""Canny's upper threshold in parts of the strongest slope in the picture."""
SOBEL_GAIN = 4.0
"""Height of Sobel's answer to a step of one grey level."""
MOST = 8
"""Circles that are handed on."""


class FoundCircle(NamedTuple):
    """Circles, best first."""

    centers: Floats
    """Shape (n, 2), px, in the picture given."""
    radii: Floats
    """Shape (n,), px."""


def find_circles(grey: NDArray[np.uint8], radius_px: float) -> FoundCircle:
    """Circles of about a radius, by the gradient method of OpenCV (Yuen et al. 1990).

    Args:
        grey: Shape (h, w).
        radius_px: As predicted.
    """
    smooth = cv2.GaussianBlur(grey, (5, 5), 1.0)
    contrast = float(np.percentile(smooth, 99.5) - np.percentile(smooth, 0.5))
    threshold = max(EDGE_FRACTION * SOBEL_GAIN * contrast / 2, 4.0)
    circles = cv2.HoughCircles(
        smooth,
        cv2.HOUGH_GRADIENT,
        dp=1.0,
        minDist=max(radius_px / 3, 1.0),
        param1=threshold,
        param2=VOTES,
        minRadius=int(np.floor(RADIUS_RANGE[0] * radius_px)),
        maxRadius=int(np.ceil(RADIUS_RANGE[1] * radius_px)),
    )
    if circles is None:
        return FoundCircle(np.zeros((0, 2)), np.zeros(0))
    rows = np.asarray(circles, dtype=np.float64).reshape(-1, np.shape(circles)[-1])[:MOST]
    return FoundCircle(rows[:, :2], rows[:, 2])
