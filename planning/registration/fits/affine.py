"""The unconstrained fit of Table 6 of the paper, for comparison alone."""

from __future__ import annotations

import numpy as np

from puncture_twin.planning.base.arrays import Floats


def fit_affine(points_ct: Floats, points_base: Floats) -> Floats:
    """The unconstrained 12-parameter least squares of the paper's Table 6, shape (4, 4). Not a rigid motion.

    With fewer than four markers that span space it is not unique, and the solution of least norm is taken.
    """
    homogeneous = np.column_stack([points_ct, np.ones(len(points_ct))])
    solution, *_ = np.linalg.lstsq(homogeneous, points_base, rcond=None)
    T = np.eye(4)
    T[:3] = solution.T
    return T
