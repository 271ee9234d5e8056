"""T_base_ct from the frames that three markers span."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.geometry.rigid import frame_of_points
from puncture_twin.planning.registration.fits.least_squares import _rigid


def fit_triad(points_ct: Floats, points_base: Floats) -> Floats:
    """T_base_ct by the frames that three markers span (Chen 2019, Eq. 1-9).

    R_base_ct = R_base R_ct^T; the translation is the mean over the three markers.

    Args:
        points_ct: Shape (..., 3, 3), rows M1, M2, M3, mm; one set, or many.
        points_base: Shape (..., 3, 3), the same markers.
    """
    R_ct = np.swapaxes(frame_of_points(points_ct), -1, -2)
    R = frame_of_points(points_base) @ R_ct
    return _rigid(R, np.mean(points_base - points_ct @ np.swapaxes(R, -1, -2), axis=-2))
