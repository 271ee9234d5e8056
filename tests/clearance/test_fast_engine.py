"""The fast engine against brute force and FCL: hostile meshes, targets and directions."""

import numpy as np
import pytest
from oracles import segment_mesh_distance, units
from refusals import refused

from puncture_twin.planning.clearance.fast_engine import FastEngine
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 150.0
TIGHT_MM = 1e-9
"""Far above rounding of float64, far below any length that matters."""


def soup(rng, count, spread=60.0, size=6.0):
    """Triangles strewn about, no two joined."""
    corners = rng.normal(0, spread, (count, 1, 3)) + rng.normal(0, size, (count, 3, 3))
    return TriangleMesh(corners.reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def slivers(rng, count):
    """Zero-area triangles: collinear corners, two corners in one place, all three in one place."""
    a, d = rng.normal(0, 50, (count, 3)), rng.normal(0, 8, (count, 3))
    share = rng.uniform(-1, 2, (count, 1))
    kinds = np.arange(count)[:, None] % 3
    b = np.where(kinds == 2, a, a + d)
    c = np.where(kinds == 0, a + share * d, np.where(kinds == 1, b, a))
    return TriangleMesh(np.stack([a, b, c], axis=1).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3))


def voxels(rng):
    """The faces of random unit voxels, 4 mm wide: every edge and plane along an axis."""
    filled = np.pad(rng.uniform(size=(6, 6, 6)) < 0.5, 1)
    vertices, faces = [], []
    for axis in range(3):
        p, q = np.eye(3)[(axis + 1) % 3], np.eye(3)[(axis + 2) % 3]
        for corner in np.argwhere(filled != np.roll(filled, 1, axis=axis)):
            first = len(vertices)
            vertices += [corner, corner + p, corner + p + q, corner + q]
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return TriangleMesh(4.0 * np.array(vertices, float) + [8.0, -16.0, -16.0], np.array(faces))


def agrees(mesh, target, directions, length=LENGTH):
    """Every distance equals the triangle-by-triangle oracle."""
    target = np.asarray(target, float)
    found = FastEngine([mesh]).measure(target, directions, length)
    expected = [segment_mesh_distance(target, target + length * u, mesh) for u in directions]
    np.testing.assert_allclose(found.distance[:, 0], expected, atol=TIGHT_MM, rtol=0)
    return found


def test_distance_and_depth_equal_fcl(rng, ball, box):
    """Distances to 1e-9 mm and depths to 1e-6 mm are those of the FCL engine, structure by structure."""
    meshes = [ball(20, (60, 0, 0)), box([30, 20, 10], (0, 50, 20)), ball(4, (5, 5, -30), 1), soup(rng, 300)]
    directions, target = units(rng, 300), np.array([1.0, 2.0, 3.0])
    fast, fcl = (kind(meshes).measure(target, directions, LENGTH) for kind in (FastEngine, FclEngine))
    np.testing.assert_allclose(fast.distance, fcl.distance, atol=TIGHT_MM)
    np.testing.assert_allclose(fast.depth, fcl.depth, atol=1e-6)
    assert (fast.distance == 0).sum() > 20


def test_zero_area_triangles_are_segments_and_points(rng):
    """A triangle without area is its longest edge, or a point: neither lost nor a false hit."""
    found = agrees(slivers(rng, 60), [1.0, 2.0, 3.0], units(rng, 60))
    assert (found.distance > 0.01).all()


def test_a_zero_area_triangle_in_line_with_the_target_is_no_hit(rng):
    """Collinear corners on a line through the target, met by rounding noise on all three edges, stay where they are."""
    for _ in range(50):
        u = units(rng, 1)[0]
        corners = np.array([20.0, 40.0, 55.0])[:, None] * u + rng.normal(0, 1e-15, (3, 3))
        away = np.cross(u, units(rng, 1)[0])
        away /= np.linalg.norm(away)
        directions = np.stack([u, np.cos(0.3) * u + np.sin(0.3) * away])
        found = FastEngine([TriangleMesh(corners, [[0, 1, 2]])]).measure(np.zeros(3), directions, LENGTH)
        np.testing.assert_allclose(found.distance[:, 0], [0, 20 * np.sin(0.3)], atol=1e-9)


def test_triangles_edge_on_to_axis_aligned_needles(rng):
    """A voxel surface seen along its own axes: no false zero from triangles that appear as lines."""
    axes = np.concatenate([np.eye(3), -np.eye(3), units(rng, 15)])
    mesh = voxels(rng)
    for target in ([0.0, 0.5, 0.25], [2.0, 0.0, 0.0], [20.0, 1.0, 2.0]):
        agrees(TriangleMesh(mesh.vertices, mesh.faces[::7]), target, axes)


def test_one_triangle(rng):
    """The smallest surface, from in front, behind, beyond the top and through it."""
    agrees(TriangleMesh([[10.0, -5, -5], [12, 7, -4], [9, 0, 8]], [[0, 1, 2]]), [0, 0, 0], units(rng, 200))
    agrees(TriangleMesh([[160.0, -50, -50], [160, 70, -40], [155, 0, 80]], [[0, 1, 2]]), [0, 0, 0], units(rng, 200))


@pytest.mark.parametrize("place", ["vertex", "edge", "face", "inside", "outside", "far", "plane"])
def test_targets_anywhere(rng, ball, place):
    """The target on a vertex, an edge, in a face, in a face's plane, inside, outside and far away."""
    mesh = ball(30, (5, 5, 5), 1)
    a, b, c = mesh.triangles[7]
    detections = {"vertex": a, "edge": 0.3 * a + 0.7 * b, "face": (a + b + c) / 3, "inside": np.array([6.0, 1, 9])}
    detections |= {"outside": np.array([80.0, 3, 4]), "far": np.array([4000.0, 300, 40]), "plane": 4 * a - 2 * b - c}
    found = agrees(mesh, detections[place], units(rng, 25), 150.0 if place != "far" else 4000.0)
    if place in ("vertex", "edge", "face"):
        np.testing.assert_allclose(found.distance, 0, atol=TIGHT_MM)


def test_poles_seam_and_duplicates(ball):
    """Directions at the poles, at β = 0 and 360° and given twice: equal directions get equal answers, in any order."""
    theta, beta = np.meshgrid(np.radians([0, 1e-7, 1, 90, 179, 180]), np.radians([0, 90, 180, 270, 360]))
    theta, beta = theta.ravel(), beta.ravel()
    directions = np.stack([np.sin(theta) * np.cos(beta), np.sin(theta) * np.sin(beta), np.cos(theta)], axis=1)
    directions = np.concatenate([directions, directions[::-1]])
    found = agrees(ball(20, (10, 30, 25), 1), [0, 0, 0], directions).distance[:, 0]
    np.testing.assert_array_equal(found[:30], found[30:][::-1])


def test_one_direction_and_none(ball):
    """A single direction is answered like many; no direction gives an empty answer."""
    engine = FastEngine([ball(20, (60, 0, 0))])
    assert engine.measure(np.zeros(3), np.array([[1.0, 0, 0]]), LENGTH).distance[0, 0] == 0
    assert engine.measure(np.zeros(3), np.empty((0, 3)), LENGTH).distance.shape == (0, 1)
    assert FastEngine([]).measure(np.zeros(3), np.eye(3), LENGTH).depth.shape == (3, 0)


def test_directions_far_apart_are_not_bundled_wrongly(rng, ball):
    """A handful of directions all over the sphere, where one bundle's cone would be wider than a half space."""
    for count in (2, 5, 13):
        agrees(ball(40, (10, 0, 0), 1), [0, 0, 70.0], units(rng, count))


def test_hundreds_of_thousands_of_triangles(rng):
    """A wavy sheet of a third of a million triangles: FCL's distances."""
    n = 420
    x, y = np.meshgrid(np.linspace(-200, 200, n), np.linspace(-200, 200, n), indexing="ij")
    vertices = np.stack([x, y, 90 + 5 * np.sin(x / 9) * np.cos(y / 7)], axis=-1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate([np.stack([i, i + n, i + 1], 1), np.stack([i + 1, i + n, i + n + 1], 1)])
    sheet, directions = [TriangleMesh(vertices, faces)], units(rng, 20)
    found, fcl = (kind(sheet).measure(np.zeros(3), directions, 60.0) for kind in (FastEngine, FclEngine))
    np.testing.assert_allclose(found.distance, fcl.distance, atol=TIGHT_MM)


def test_a_surface_beyond_the_top_and_one_across_it(rng, ball):
    """Where the needle ends before the surface, or amid it, the distance is that of its top: near, far, aside."""
    directions = np.concatenate([units(rng, 10), [1.0, 0, 0] + 0.05 * rng.normal(size=(40, 3))])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    for center in ((400.0, 30, 0), (LENGTH + 22.0, 0, 0), (LENGTH, 21.0, 0)):
        agrees(ball(20, center, 1), [0, 0, 0], directions)


def test_searches_are_counted(ball):
    """The counts grow with what is searched, and far surfaces behind the target cost no triangle."""
    engine, directions = FastEngine([ball(20, (60, 0, 0))]), np.array([[1.0, 0, 0], [0.9, 0.1, np.sqrt(0.18)]])
    engine.measure(np.zeros(3), -directions, LENGTH)
    assert engine.counts[0] > 0 and engine.counts[-1] == 0
    engine.measure(np.zeros(3), directions, LENGTH)
    assert (engine.counts > 0).all()


@pytest.mark.parametrize("target, direction", [([np.nan, 0, 0], [1.0, 0, 0]), ([0, 0, 0], [np.inf, 0, 0])])
def test_an_axis_that_is_not_finite_is_refused(ball, target, direction):
    """Nothing that is not a number reaches compiled code."""
    with refused("not_finite"):
        FastEngine([ball(20)]).measure(np.array(target), np.array([direction]), LENGTH)


def test_every_axis_may_have_a_length_of_its_own(rng, ball):
    """A length an axis and structure, neighbours in a bundle long and short: the oracle's distance, FCL's depth."""
    meshes, target, directions = [soup(rng, 300), ball(60.0, (5, 8, 90))], np.array([3.0, -2.0, 5.0]), units(rng, 240)
    directions[::2] = directions[1::2] + 0.01 * rng.normal(size=(120, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    lengths = rng.uniform(1.0, 160.0, (240, 2))
    found, fcl = (engine(meshes).measure(target, directions, lengths) for engine in (FastEngine, FclEngine))
    for column, mesh in enumerate(meshes):
        ends = target + lengths[:, column, None] * directions
        expected = [segment_mesh_distance(target, end, mesh) for end in ends]
        np.testing.assert_allclose(found.distance[:, column], expected, atol=TIGHT_MM, rtol=0)
    np.testing.assert_allclose(fcl.distance, found.distance, atol=1e-9)
    assert (found.depth <= lengths).all() and (fcl.depth <= lengths + 1e-9).all()
    crossed = found.distance == 0
    assert crossed.sum() > 20
    np.testing.assert_allclose(found.depth[crossed], fcl.depth[crossed], atol=1e-6)
