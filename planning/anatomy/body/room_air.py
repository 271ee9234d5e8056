"""The ambient air inside a skin that comes from elsewhere: the CT beside it is shifted, or of another position."""

from __future__ import annotations

import numpy as np
import scipy
from numpy.typing import NDArray

from puncture_twin.planning.anatomy.body.body_mask import BODY_HU
from puncture_twin.planning.base.arrays import Bools, Floats

WIDE_MM = 5.0
"""Air into which a ball of this radius fits and that goes on outside is the room's; a nose's is narrower."""


def outside_air_fraction(hu: NDArray[np.float32], body: Bools, spacing_mm: Floats, tolerance_mm: float) -> float:
    """How much of a body is air that holds together with the room's, 0..1.

    Args:
        hu: Shape (nx, ny, nz), Hounsfield units.
        body: Same shape, what a skin from elsewhere encloses, widened by twice the tolerance at most.
        spacing_mm: Shape (3,).
        tolerance_mm: How far the skin may be off.
    """
    air = hu < BODY_HU
    wide = (
        scipy.ndimage.distance_transform_edt(np.pad(air, 1, mode="edge"), sampling=spacing_mm)[1:-1, 1:-1, 1:-1]
        > WIDE_MM
    )
    labels, _ = scipy.ndimage.label(wide)
    outside = np.unique(labels[~body])
    ambient = np.isin(labels, outside[outside > 0])
    near_ambient = (
        scipy.ndimage.distance_transform_edt(~ambient, sampling=spacing_mm) <= WIDE_MM if ambient.any() else ambient
    )
    deep = scipy.ndimage.distance_transform_edt(np.pad(body, 1, mode="edge"), sampling=spacing_mm)[1:-1, 1:-1, 1:-1]
    inside = deep > 2.0 * tolerance_mm
    return float((air & near_ambient)[inside].mean()) if inside.any() else 0.0
