"""Vectors of 16 lanes against the plain way; axes and triangles in pairs are in `test_plain_kernels`."""

import numba as nb
import numpy as np

from puncture_twin.planning.clearance.kernels.lanes import LANES, lanes_at_most, least_of, lowest_bit


def test_the_lanes_that_pass_are_bits():
    """Lane by lane as numpy says, a lane at the limit and two equal ones among them."""
    rng = np.random.default_rng(3)
    rows = rng.normal(size=(50, LANES)).astype(np.float32)
    rows[7, 3] = rows[7, 9] = rows[7].min() - np.float32(1.0)
    limits = np.append(rng.normal(size=49), 9.0).astype(np.float32)
    limits[0] = rows[0, 5]  # a lane at the limit passes

    @nb.njit
    def asked(rows, row, limit):
        return (
            lanes_at_most(rows, row, limit),
            least_of(rows, row),
            lowest_bit(lanes_at_most(rows, row, least_of(rows, row))),
        )

    for row, limit in enumerate(limits):
        bits, least, place = asked(rows, row, limit)
        assert bits == sum(1 << k for k in range(LANES) if rows[row, k] <= limit)
        assert least == rows[row].min()
        assert place == rows[row].argmin()
