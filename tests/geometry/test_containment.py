"""Inside, outside or not known: points against shapes whose inside is known by formula."""

import numpy as np
import pytest

from puncture_twin.planning.geometry.containment import RAYS, SEED, Side, inside_each, side_of
from puncture_twin.planning.geometry.mesh import TriangleMesh


def mixed(mesh, rng, fraction=0.5):
    """The same surface, some of its triangles wound the other way."""
    flip = rng.random((len(mesh.faces), 1)) < fraction
    return TriangleMesh(mesh.vertices, np.where(flip, mesh.faces[:, ::-1], mesh.faces))


@pytest.mark.parametrize("scale", [0.02, 1.0, 50.0])
@pytest.mark.parametrize("winding", ["alike", "mixed"])
def test_points_about_a_box_are_on_the_side_where_they_lie(rng, box, winding, scale):
    """Within each half width inside, beyond it outside, along every axis and toward every corner, at any scale."""
    size, center = scale * np.array([40.0, 20.0, 10.0]), scale * np.array([5.0, -7.0, 3.0])
    mesh = box(size, center) if winding == "alike" else mixed(box(size, center), rng)
    assert mesh.closed and mesh.wound_alike == (winding == "alike")
    for way in np.array([[x, y, z] for x in (-1, 0, 1) for y in (-1, 0, 1) for z in (-1, 0, 1) if x or y or z]):
        assert side_of(mesh, center + 0.49 * size * way) is Side.INSIDE
        assert side_of(mesh, center + 0.51 * size * way) is Side.OUTSIDE


@pytest.mark.parametrize("left_out", [0, 1])
def test_corners_in_one_place_are_one(box, left_out):
    """However corners are numbered, and whatever zero's sign: closed, wound alike and distinct are of places alone."""
    shared = box(np.array([40.0, 20.0, 10.0]), np.array([20.0, 10.0, 0.0]))
    faces = shared.faces[left_out:]
    apart = shared.vertices[faces].reshape(-1, 3)
    apart[::2][apart[::2] == 0.0] = -0.0
    for vertices, numbers in ((shared.vertices, faces), (apart, np.arange(len(apart)).reshape(-1, 3))):
        once, twice = (TriangleMesh(vertices, np.tile(numbers, (times, 1))) for times in (1, 2))
        assert once.closed == once.wound_alike == (left_out == 0)
        assert once.distinct.all() and twice.distinct.tolist() == [True] * len(faces) + [False] * len(faces)
        assert np.array_equal(once.bounds, [[0, 0, -5], [40, 20, 5]])


@pytest.mark.parametrize("winding", ["alike", "mixed"])
def test_a_point_in_the_box_of_a_surface_may_lie_outside(rng, ball, winding):
    """Near a corner of a ball's bounding box there is no ball; behind a face and before it are different sides."""
    mesh = ball(50, subdivisions=2) if winding == "alike" else mixed(ball(50, subdivisions=2), rng)
    assert side_of(mesh, np.array([40.0, 40, 40])) is Side.OUTSIDE
    for triangle in mesh.triangles[::9]:
        middle = triangle.mean(axis=0)
        assert side_of(mesh, 0.99 * middle) is Side.INSIDE
        assert side_of(mesh, 1.01 * middle) is Side.OUTSIDE


def test_a_ring_of_mixed_winding_has_a_hole(rng):
    """In the hole of a torus rays leave through two walls or none: outside; in its tube through one or three."""
    import trimesh

    ring = trimesh.creation.torus(30, 10, major_sections=24, minor_sections=12)
    mesh = mixed(TriangleMesh(ring.vertices, ring.faces), rng)
    assert side_of(mesh, np.array([1.0, 2, 3])) is Side.OUTSIDE
    assert side_of(mesh, np.array([30.0, 1, 2])) is Side.INSIDE
    assert side_of(mesh, np.array([-2.0, -29, 3])) is Side.INSIDE


def test_three_walls_are_as_good_as_one(rng, ball):
    """Amid three shells every ray crosses three walls: inside; between two shells it is one or two."""
    shells = [mixed(ball(radius, subdivisions=1), rng) for radius in (60, 40, 20)]
    offsets = np.cumsum([0, *(len(shell.vertices) for shell in shells[:-1])])
    faces = np.concatenate([shell.faces + offset for shell, offset in zip(shells, offsets, strict=True)])
    mesh = TriangleMesh(np.concatenate([shell.vertices for shell in shells]), faces)
    for x, side in ((1.0, Side.INSIDE), (28.0, Side.OUTSIDE), (47.0, Side.INSIDE), (61.0, Side.OUTSIDE)):
        assert side_of(mesh, np.array([x, 2.0, 3.0])) is side


def test_one_ray_that_meets_an_edge_is_outvoted(ball):
    """From points from which one of the rays runs exactly into a corner, the others still tell."""
    mesh, few = ball(50, subdivisions=1), np.random.default_rng(SEED).normal(size=(3, RAYS)).T
    flipped = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces[:7, ::-1], mesh.faces[7:]]))
    for ray in few:
        for corner in mesh.vertices[::5]:
            for reach in (5.0, 20.0):
                point = corner - reach * ray / np.linalg.norm(ray)
                away = np.linalg.norm(point)
                if away < 40 or away > 51:
                    assert side_of(flipped, point) is (Side.INSIDE if away < 50 else Side.OUTSIDE)


def test_a_triangle_given_twice_closes_nothing_and_crosses_once(ball):
    mesh = ball(50, subdivisions=1)
    doubled = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces[::2]]))
    assert doubled.closed and not doubled.wound_alike
    assert side_of(doubled, np.array([1.0, 2, 3])) is Side.INSIDE
    assert side_of(doubled, np.array([30.0, 30, 45])) is Side.OUTSIDE
    opened = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces[1:], mesh.faces[1:]]))
    assert side_of(opened, np.array([1.0, 2, 3])) is Side.UNKNOWN


@pytest.mark.parametrize("winding", ["alike", "mixed"])
def test_many_points_are_inside_where_each_of_them_is(rng, ball, winding):
    """About a ball away from the origin: within its radius, in its box beyond that, and outside of the box."""
    center = np.array([7.0, -3.0, 5.0])
    mesh = ball(20, center=center) if winding == "alike" else mixed(ball(20, center=center), rng)
    points = center + rng.uniform(-27, 27, (300, 3))
    away = np.linalg.norm(points - center, axis=1)
    points, away = points[abs(away - 20) > 0.5], away[abs(away - 20) > 0.5]
    inside = inside_each(mesh, points)
    assert inside.shape == away.shape and inside.dtype == bool
    assert np.array_equal(inside, away < 20) and 30 < inside.sum() < len(inside) - 30
    assert np.array_equal(inside, [side_of(mesh, point) is Side.INSIDE for point in points])
    assert inside_each(mesh, points[:0]).shape == (0,)


def test_an_open_surface_has_no_inside_for_many_points_either(ball):
    mesh = ball(50, subdivisions=1)
    with pytest.raises(ValueError, match="open"):
        inside_each(TriangleMesh(mesh.vertices, mesh.faces[1:]), np.zeros((2, 3)))
