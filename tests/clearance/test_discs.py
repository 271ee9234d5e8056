"""The discs from which the search takes its bounds: what one of them leaves out, the search never sees."""

import numpy as np
import pytest
from hypothesis import example, given, settings, strategies as st

from puncture_twin.planning.clearance.kernels.blocks import pack
from puncture_twin.planning.clearance.kernels.lanes import LANES
from puncture_twin.planning.geometry.mesh import TriangleMesh


def a_surface(rng, count, spread, size):
    """Loose triangles, some of them slivers, some points, some lines, some far from all others."""
    middle = rng.normal(0, spread, (count, 1, 3)) * rng.choice([0.0, 1.0, 1.0, 30.0], (count, 1, 1))
    corners = middle + rng.normal(0, size, (count, 3, 3)) * rng.choice([1e-6, 1.0], (count, 1, 3))
    corners[::7, 2] = corners[::7, 1]
    corners[3::11] = corners[3::11, :1]
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def lowest(blocks, level, node):
    """The blocks below a node of a level: from the first, to before the last."""
    many = LANES**level
    return node * many, min((node + 1) * many, len(blocks.local))


def counts(blocks):
    """How many nodes each level has."""
    many = [len(blocks.local)]
    while many[-1] > LANES:
        many.append(-(-many[-1] // LANES))
    return many


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 2**32 - 1),
    count=st.integers(1, 9000),
    spread=st.sampled_from([0.0, 1.0, 100.0, 1e5]),
    size=st.sampled_from([1e-3, 1.0, 50.0]),
)
@example(seed=19412, count=1649, spread=1.0, size=50.0)  # one flat triangle whose rounded normal left a corner outside
def test_every_disc_holds_the_corners_below_it(seed, count, spread, size):
    """On all levels, without a tolerance: the discs are grown by more than rounding."""
    blocks = pack(a_surface(np.random.default_rng(seed), count, spread, size))
    corners = blocks.triangles.reshape(len(blocks.local), -1, 3)
    assert len(counts(blocks)) == len(blocks.base)
    for level, many in enumerate(counts(blocks)):
        for node in range(many):
            at = LANES * blocks.base[level] + node
            n, rho, h = blocks.disc[:3, at].astype(float), float(blocks.disc[3, at]), float(blocks.disc[4, at])
            assert np.linalg.norm(n) == pytest.approx(1.0, abs=1e-6)
            first, last = lowest(blocks, level, node)
            d = corners[first:last].reshape(-1, 3) - blocks.center[at]
            up = d @ n
            assert np.abs(up).max() <= h
            assert np.linalg.norm(d - up[:, None] * n, axis=1).max() <= rho


@pytest.mark.parametrize("least", [1e-81, 1.6e-162, 1e-161, 1e-155, 1e-142, 1e-139])
def test_no_area_too_small_to_square_spoils_a_block(least):
    """Lines, and a whisker whose area, squared, is lost or keeps a digit: a text file may state one."""
    line, whisker = [[0.0, 0, -100], [0, 0, 100], [0, 0, 0]], [[0.0, 0, 0], [least, 0, 0], [0, 1, 0]]
    assert_sound_discs(np.array([*(15 * [line]), whisker]))


@pytest.mark.parametrize("size", [1e-162, 1.3e-81, 1e-80, 1e-75, 1e-71, 1e-69])
def test_no_radius_too_small_to_square_spoils_a_parent(size):
    """Two blocks of equal triangles so small that the square of their disc's area is lost or keeps a digit."""
    assert_sound_discs(np.array(32 * [[[0.0, 0, 0], [size, 0, size], [0, size, 0]]]))


def assert_sound_discs(triangles):
    """Their normals have length one, and the highest disc holds all corners."""
    blocks = pack(TriangleMesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)))
    at = [LANES * base + node for base, many in zip(blocks.base, counts(blocks), strict=True) for node in range(many)]
    np.testing.assert_allclose(np.linalg.norm(blocks.disc[:3, at].astype(float), axis=0), 1.0, atol=1e-6)
    assert np.hypot(*blocks.disc[3:, at[-1]]) >= np.linalg.norm(triangles - blocks.center[at[-1]], axis=2).max()


def test_a_flat_round_block_has_a_flat_round_disc():
    """By hand: 16 triangles about a point, in a tilted plane, half of them turned over: no thicker than rounding."""
    turn = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    angles = np.pi / 8 * np.arange(16)
    rim = 5.0 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    vertices = np.concatenate([[[0.0, 0.0, 0.0]], rim]) @ turn.T + [10.0, 20.0, 30.0]
    faces = np.array([[0, 1 + k, 1 + (k + 1) % 16] for k in range(16)])
    faces[::2] = faces[::2, ::-1]
    blocks = pack(TriangleMesh(vertices, faces))
    assert abs(blocks.disc[:3, 0] @ turn[:, 2]) == pytest.approx(1.0, abs=1e-6)
    assert blocks.disc[4, 0] < 1e-5
    assert 5.0 <= blocks.disc[3, 0] < 6.0


def test_local_corners_are_those_of_the_triangles():
    """Relative to the centre of their block, in float32."""
    blocks = pack(a_surface(np.random.default_rng(5), 333, 100.0, 5.0))
    rows = blocks.triangles.reshape(-1, LANES, 3, 3)
    expected = rows - blocks.center[: len(rows), None, None]
    found = blocks.local.reshape(-1, 3, 3, LANES).transpose(0, 3, 1, 2)
    np.testing.assert_array_equal(found, expected.astype(np.float32))
