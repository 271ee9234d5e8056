"""Axes and triangles in pairs, and vectors of 16 lanes, against the plain ways."""

import numba as nb
import numpy as np
import pytest

from puncture_twin.planning.clearance.kernels.lanes import LANES, lanes_at_most, least_of, lowest_bit
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle
from puncture_twin.planning.clearance.kernels.side_by_side import (
    BEYOND,
    PAIR_ROWS,
    UNDECIDED,
    bring_into_frame,
    measure_lateral,
    measure_marked,
)

LENGTH = 80.0
COUNT = 4000


@nb.njit(error_model="numpy")
def _in_pairs(axes, triangles, origin, length, pairs):
    for k in range(len(axes)):
        u, e, f = (
            (axes[k, 0, 0], axes[k, 0, 1], axes[k, 0, 2]),
            (axes[k, 1, 0], axes[k, 1, 1], axes[k, 1, 2]),
            (axes[k, 2, 0], axes[k, 2, 1], axes[k, 2, 2]),
        )
        bring_into_frame(u, e, f, triangles, k, (origin[0], origin[1], origin[2]), pairs, k)
    pairs[11] = length
    measure_lateral(pairs, len(axes))
    marks = pairs[9].copy()
    for k in range(len(axes)):
        if pairs[9, k] < 0.0:
            pairs[9, k], pairs[10, k] = measure_marked(pairs, k)
    return marks


def _frames(rng, count):
    """Direction u, and e and f across it, for each axis."""
    q, _ = np.linalg.qr(rng.normal(size=(count, 3, 3)))
    return np.ascontiguousarray(q.transpose(0, 2, 1))


def _triangles(rng, axes, kind):
    """Triangles of one kind, placed along their axes; corners one after the other."""
    depths = {"beside": (5, 75), "pierced": (5, 75), "beyond": (85, 160), "behind": (-60, -5)}.get(kind, (-40, 120))
    size = 40.0 if kind in ("anywhere", "along") else 2.0
    along = rng.uniform(*depths, len(axes))
    corners = rng.normal(0.0, size, (len(axes), 3, 3)) + (along[:, None] * axes[:, 0])[:, None]
    if kind == "beyond":  # never back below the top
        corners += (
            np.maximum(0.0, LENGTH + 1.0 - np.einsum("ncj,nj->nc", corners, axes[:, 0]))[..., None] * axes[:, None, 0]
        )
    if kind == "along":  # the axis runs in the triangle's plane
        corners -= np.einsum("ncj,nj->nc", corners, axes[:, 1])[..., None] * axes[:, None, 1]
    if kind == "pierced":
        corners -= corners.mean(axis=1, keepdims=True) - (along[:, None] * axes[:, 0])[:, None]
    if kind == "degenerate":
        corners[::3, 2] = corners[::3, 1]
        corners[1::3, 2] = 0.5 * (corners[1::3, 0] + corners[1::3, 1])
        corners[2::3] = corners[2::3, :1]
    return corners.reshape(-1, 9)


@pytest.mark.parametrize("kind", ["anywhere", "beside", "pierced", "beyond", "behind", "degenerate", "along"])
def test_pairs_answer_what_one_triangle_answers(kind):
    """Beside, pierced, beyond the top, behind the target, anywhere, degenerate: the same distance and depth."""
    rng = np.random.default_rng(7)
    axes, origin = _frames(rng, COUNT), np.array([30.0, -200.0, 410.0])
    triangles = _triangles(rng, axes, kind)
    pairs = np.full((PAIR_ROWS, COUNT), np.nan)
    marks = _in_pairs(axes, triangles + np.tile(origin, 3), origin, LENGTH, pairs)
    expected = np.array(
        [axis_triangle(tuple(a[0]), LENGTH, *map(tuple, t.reshape(3, 3))) for a, t in zip(axes, triangles, strict=True)]
    )
    np.testing.assert_allclose(np.sqrt(pairs[9]), np.sqrt(expected[:, 0]), atol=1e-10)
    apart = expected[:, 0] > 1e-6
    depths = np.abs(pairs[10] - expected[:, 1])
    assert np.median(depths[apart]) < 1e-10 if apart.any() else True
    np.testing.assert_allclose(pairs[10][~apart], expected[~apart, 1], atol=1e-6)
    answered = {
        "beside": marks >= 0.0,
        "pierced": marks == 0.0,
        "beyond": marks == BEYOND,
        "behind": marks == UNDECIDED,
    }
    assert answered.get(kind, np.ones(1, bool)).mean() > 0.9  # each kind really goes its own way


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
