"""Every error that Chen et al. 2019 print (Tables 3, 5, 6, 7), from touches of either setup; many at once."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from puncture_twin.planning.base.arrays import Floats
from puncture_twin.planning.registration.fits.least_squares import fit_affine, fit_triad
from puncture_twin.twin.experiment.chen2019_tables import TABLE_1, TABLE_2, TABLE_4, Point

NAMES = tuple(TABLE_1)
"""Of all points, in the order of the rows below."""

READ: Floats = np.array(list(TABLE_1.values()), dtype=np.float64)
"""Table 1, shape (8, 3): what was read in the CT."""
READ.setflags(write=False)

SETUPS: tuple[Mapping[str, Point], ...] = (TABLE_2, TABLE_4)
"""What was touched in either setup."""

TRIADS = ((0, "ABC", "L"), (0, "ABC", "M"), (0, "ABC", "H"), (1, "ABC", "M"), (1, "ABE", "M"), (1, "ACD", "M"))
"""Setup, markers and lesion of Tables 3 and 5."""

AFFINE = ((1, "ABCE", "M"), (1, "ABCDE", "M"))
"""Of Table 6, where least squares of twelve parameters are meant."""


def rows_of(names: str) -> list[int]:
    """Rows of points in `READ` by their names."""
    return [NAMES.index(name) for name in names]


def measured() -> tuple[Floats, ...]:
    """What the paper touched in each setup, shape (1, 8, 3), mm, base frame; NaN where a point was not touched."""
    return tuple(
        np.array([[touched.get(name, (np.nan, np.nan, np.nan)) for name in NAMES]], dtype=np.float64)
        for touched in SETUPS
    )


def printed_errors(touched: tuple[Floats, ...]) -> dict[str, Floats]:
    """Every printed error of n experiments, by name, each of shape (n,), mm.

    Args:
        touched: Of each setup, shape (n, 8, 3), rows as `NAMES`, mm.
    """
    found = {}
    for setup, markers, lesion in TRIADS:
        rows = rows_of(markers)
        T = fit_triad(np.broadcast_to(READ[rows], (len(touched[setup]), 3, 3)), touched[setup][:, rows])
        found[f"{lesion} by {'-'.join(markers)}, setup {setup + 1}"] = _misses(T, touched[setup], lesion)[:, 0]
        if (setup, lesion) == (0, "M"):
            found["mean residual of A-B-C, setup 1"] = _misses(T, touched[setup], markers).mean(axis=1)
    for setup, markers, lesion in AFFINE:
        T = np.array([fit_affine(READ[rows_of(markers)], one[rows_of(markers)]) for one in touched[setup]])
        found[f"{lesion} by {'-'.join(markers)} (affine), setup {setup + 1}"] = _misses(T, touched[setup], lesion)[:, 0]
    return found


def _misses(T: Floats, touched: Floats, names: str) -> Floats:
    rows = rows_of(names)
    fitted = READ[rows] @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    return np.asarray(np.linalg.norm(fitted - touched[:, rows], axis=2))
