"""Distance of points from triangles: every region, triangles without area, and two other programs' answers."""

import numpy as np
import pytest
import trimesh
from oracles import point_triangle_distance

from puncture_twin.planning.geometry.triangle_distance import farthest_from, squared_distance

SEED = 4


def scattered(count=4000):
    """Points, and triangles of which a quarter are slivers, near and far."""
    rng = np.random.default_rng(SEED)
    triangles = rng.normal(size=(count, 3, 3)) * 20.0
    thin = slice(count // 4, count // 2)
    triangles[thin, 2] = triangles[thin, 1] + rng.normal(size=triangles[thin, 1].shape) * 1e-3
    return triangles.mean(axis=1) + rng.normal(size=(count, 3)) * 10.0 ** rng.uniform(-2, 2, (count, 1)), triangles


def test_distance_in_every_region():
    """Above the inside, beside an edge, beyond a corner, and for a triangle without area."""
    triangle = np.array([[0.0, 0, 0], [4, 0, 0], [0, 4, 0]])
    points = np.array([[1.0, 1, 2], [2, -3, 0], [7, -4, 0], [-3, 0, 4], [4, 4, 0], [1, 1, 0]])
    assert np.allclose(squared_distance(points, triangle), [4, 9, 25, 25, 8, 0])
    assert np.allclose(squared_distance(points[:1], triangle[[0, 1, 1]]), [5])


def test_without_area_the_edges_count():
    line = np.array([[0.0, 0, 0], [10, 0, 0], [5, 0, 0]])
    assert squared_distance(np.array([4.0, 3.0, 0.0]), line) == pytest.approx(9.0)
    assert squared_distance(np.array([2.0, 2.0, 7.0]), np.full((3, 3), 2.0)) == pytest.approx(25.0)


def test_distance_agrees_with_another_closest_point():
    """Over random, thin and flat triangles, from near and far: trimesh's, and the plain oracle."""
    points, triangles = scattered()
    ours = np.sqrt(squared_distance(points, triangles))
    closest = trimesh.triangles.closest_point(triangles, points)
    assert np.abs(ours - np.linalg.norm(points - closest, axis=1)).max() < 1e-6
    plain = point_triangle_distance(points[:1500], triangles[:1500])
    np.testing.assert_allclose(ours[:1500], plain, atol=1e-9)


def test_broadcast_is_every_pair():
    """Points (a, 1, 3) against triangles (b, 3, 3) give (a, b); nothing against something gives nothing."""
    points, triangles = scattered(12)
    table = squared_distance(points[:5, None], triangles)
    each = [[float(squared_distance(point, one)) for one in triangles] for point in points[:5]]
    np.testing.assert_array_equal(table, each)
    assert squared_distance(points[:0], triangles[:0]).shape == (0,)


def test_the_farthest_point_is_farthest_from_its_nearest_triangle():
    points, triangles = scattered(30)
    table = squared_distance(points[:, None], triangles)
    assert farthest_from(triangles, points) == pytest.approx(np.sqrt(table.min(axis=1).max()))
    assert farthest_from(triangles, points[:0]) == 0.0
