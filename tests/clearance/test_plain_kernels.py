"""The kernels of one axis and one triangle, asked directly: against the triangle-by-triangle oracle, and by hand.

They run compiled, or as plain Python where NUMBA_DISABLE_JIT=1 (as the mutants do).
"""

import numpy as np
import pytest
from oracles import ray_crossings, segment_triangle_distance

from puncture_twin.planning.clearance.fast_engine import placed_surface
from puncture_twin.planning.clearance.kernels.blocks import pack
from puncture_twin.planning.clearance.kernels.segment_triangle import axis_triangle
from puncture_twin.planning.clearance.kernels.side_by_side import (
    BEYOND,
    PAIR_ROWS,
    UNDECIDED,
    bring_into_frame,
    measure_lateral,
    measure_marked,
)
from puncture_twin.planning.geometry.containment import crossings
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 40.0
TIGHT_MM = 1e-9


def unit(rng):
    """A random direction."""
    u = rng.normal(size=3)
    return u / np.linalg.norm(u)


def triangles(rng, count):
    """Triangles of many shapes about an axis of 40 mm: near, far, long, thin, flat, behind and beyond."""
    middle = rng.normal(0, 1, (count, 1, 3)) * rng.choice([2.0, 15.0, 60.0], (count, 1, 1))
    found = middle + rng.normal(0, 1, (count, 3, 3)) * rng.choice([0.5, 8.0, 50.0], (count, 1, 1))
    found[::9, 2] = 0.3 * found[::9, 0] + 0.7 * found[::9, 1]
    found[4::9, 2] = found[4::9, 1]
    found[7::9, 1:] = found[7::9, :1]
    return found


def depth_distance(u, s, triangle):
    """Distance of the axis point at a depth from a triangle."""
    return segment_triangle_distance(s * u, s * u, triangle)


def asked(u, length, triangle):
    """`axis_triangle` of one triangle: distance and depth."""
    square, depth = axis_triangle(tuple(u), np.float64(length), *(tuple(corner) for corner in triangle))
    return np.sqrt(square), depth


@pytest.mark.parametrize(("scale", "count"), [(1.0, 250), (0.005, 120)])
def test_axis_triangle_equals_the_oracle(rng, scale, count):
    """Any triangle, degenerate and tiny ones too: the oracle's distance, and a depth at which the axis is that near."""
    length = scale * LENGTH
    for triangle in scale * triangles(rng, count):
        u = unit(rng)
        distance, depth = asked(u, length, triangle)
        assert distance == pytest.approx(segment_triangle_distance(np.zeros(3), length * u, triangle), abs=TIGHT_MM)
        assert -TIGHT_MM <= depth <= length + TIGHT_MM
        assert depth_distance(u, depth, triangle) == pytest.approx(distance, abs=1e-7)


def test_axis_triangle_of_a_point_is_its_distance_from_the_start(rng):
    """An axis without length is the target itself."""
    for triangle in triangles(rng, 60):
        distance, depth = asked(np.array([0.0, 0, 1]), 0.0, triangle)
        assert distance == pytest.approx(segment_triangle_distance(np.zeros(3), np.zeros(3), triangle), abs=TIGHT_MM)
        assert depth == 0.0


def square_on(z, half=5.0):
    """A triangle across the z axis at a height."""
    return np.array([[-half, -half, z], [half, -half, z], [0.0, half, z]])


@pytest.mark.parametrize(
    ("triangle", "distance", "depth"),
    [
        (square_on(7.0), 0.0, 7.0),
        (square_on(LENGTH), 0.0, LENGTH),
        (square_on(0.0), 0.0, 0.0),
        (square_on(-3.0), 3.0, 0.0),
        (square_on(LENGTH + 3.0), 3.0, LENGTH),
        ([[2.0, 0, 5], [2, 0, 15], [9, 0, 10]], 2.0, None),
        ([[0.0, 0, 9], [0, 0, 15], [9, 0, 12]], 0.0, 9.0),
        ([[0.0, 0, 15], [0, 0, 9], [0, 9, 12]], 0.0, 9.0),
        ([[-4.0, 0, 12], [4, 0, 6], [0, 9, 20]], 0.0, 9.0),
        ([[3.0, 4, -5], [3, 4, 50], [60, 80, 20]], 5.0, None),
        ([[1.0, 0, -9], [-1, 0, -9], [0, 0, -2]], 2.0, 0.0),
        ([[1.0, 0, 49], [-1, 0, 49], [0, 0, 43]], 3.0, LENGTH),
        ([[0.0, 0, -9], [0, 0, -2], [0, 0, -5]], 2.0, 0.0),
        ([[6.0, 8, 20], [6, 8, 20], [6, 8, 20]], 10.0, 20.0),
        ([[-5.0, 3, 10], [5, 3, 10], [0, 3, 10]], 3.0, 10.0),
        ([[5e-11, 0, 10], [9, 0, 10], [9, 1, 10]], 0.0, 10.0),
        ([[2e-10, 0, 10], [9, 0, 10], [9, 1, 10]], 2e-10, 10.0),
    ],
)
def test_cases_by_hand(triangle, distance, depth):
    """Through the face, at its ends, beside it, along it, behind and beyond, for any order of corners."""
    triangle, z = np.array(triangle), np.array([0.0, 0, 1])
    for order in ([0, 1, 2], [1, 2, 0], [2, 0, 1], [0, 2, 1], [2, 1, 0], [1, 0, 2]):
        found = asked(z, LENGTH, triangle[order])
        assert found[0] == pytest.approx(distance, abs=1e-13)
        assert depth is None or found[1] == pytest.approx(depth, abs=1e-9)


def frame(rng):
    """A direction and two that complete it to a frame."""
    u = unit(rng)
    e = np.cross(u, unit(rng))
    e /= np.linalg.norm(e)
    return u, e, np.cross(u, e)


def beside(rows, length, frames, origin, count=None):
    """`measure_lateral`, and `measure_marked` where it marks a pair, of one triangle each: distances, depths, marks."""
    count = len(rows) if count is None else count
    pairs = np.full((PAIR_ROWS, len(rows)), 7.0)
    pairs[11] = length
    for k, (u, e, f) in enumerate(frames):
        bring_into_frame(tuple(u), tuple(e), tuple(f), rows, k, tuple(origin), pairs, k)
    with np.errstate(divide="ignore", invalid="ignore"):
        measure_lateral(pairs, count)
    marks, found = pairs[9].copy(), np.empty((len(rows), 2))
    for k in range(count):
        square, depth = pairs[9, k], pairs[10, k]
        if square < 0.0:
            square, depth = measure_marked(pairs, k)
        found[k] = np.sqrt(square), depth
    return found[:, 0], found[:, 1], marks


def test_side_by_side_equals_the_oracle(rng):
    """Every pair in its own frame: the oracle's distance and a depth that near; all three kinds of answer occur."""
    shapes = np.concatenate([triangles(rng, 300), [square_on(z) for z in (5.0, 20.0, 39.0, -2.0, 44.0)]])
    origin = np.array([3.0, -2.0, 5.0])
    frames = [frame(rng) for _ in shapes[:-5]] + [(np.eye(3)[2], np.eye(3)[0], np.eye(3)[1])] * 5
    distance, depth, marks = beside((shapes + origin).reshape(-1, 9), LENGTH, frames, origin)
    for k, (triangle, (u, _, _)) in enumerate(zip(shapes, frames, strict=True)):
        assert distance[k] == pytest.approx(segment_triangle_distance(np.zeros(3), LENGTH * u, triangle), abs=TIGHT_MM)
        assert depth_distance(u, depth[k], triangle) == pytest.approx(distance[k], abs=1e-7)
    np.testing.assert_allclose(distance[-5:], [0, 0, 0, 2, 4], atol=TIGHT_MM)
    np.testing.assert_allclose(depth[-5:], [5, 20, 39, 0, 40], atol=TIGHT_MM)
    assert (marks >= 0).sum() > 50 and (marks == UNDECIDED).sum() > 50 and (marks == BEYOND).sum() > 10


def test_triangles_beyond_the_top_over_it_and_beside_it(rng):
    """Tilted faces over the axis' end are as far as their foot, those beside it as far as their rim."""
    shapes = rng.normal(0, 12, (80, 3, 3)) * [1, 1, 0.3] + [0, 0, LENGTH + 15.0]
    shapes = shapes[shapes[:, :, 2].min(axis=1) > LENGTH]
    distance, depth, marks = beside(shapes.reshape(-1, 9), LENGTH, [Z_FRAME] * len(shapes), np.zeros(3))
    top = np.array([0.0, 0, LENGTH])
    expected = segment_triangle_distance(top, top, shapes)
    rims = [min(segment_triangle_distance(top, top, t[[i, j, j]]) for i, j in ((0, 1), (1, 2), (2, 0))) for t in shapes]
    np.testing.assert_allclose(distance, expected, atol=TIGHT_MM)
    np.testing.assert_array_equal(marks, BEYOND)
    np.testing.assert_array_equal(depth, LENGTH)
    assert 5 < np.sum(np.array(rims) > distance + 1e-6) < len(shapes)


Z_FRAME = (np.eye(3)[2], np.eye(3)[0], np.eye(3)[1])


def test_pairs_beside_the_axis_need_no_second_answer():
    """Between start and end, ends included, and not around the axis a triangle is answered in the loop."""
    shapes = np.array(
        [
            [[2.0, 0, 5], [6, 1, 15], [9, 0, 10]],
            [[3.0, 1, 0], [4, 1, 20], [9, 0, 40]],
            [[3.0, 1, -1e-9], [4, 1, 20], [9, 0, 10]],
            [[3.0, 1, 5], [4, 1, LENGTH + 1e-9], [9, 0, 10]],
            [[3.0, 1, 41], [4, 1, 40.5], [9, 0, 42]],
            [[3.0, 1, 41], [4, 1, 40.0], [9, 0, 42]],
            square_on(10.0),
            [[0.0, -5, 4], [0, 5, 6], [9, 0, 10]],
        ]
    )
    _, _, marks = beside(shapes.reshape(-1, 9), LENGTH, [Z_FRAME] * len(shapes), np.zeros(3))
    np.testing.assert_allclose(marks[:2], [4.0, 10.0])
    np.testing.assert_array_equal(marks[2:], [UNDECIDED, UNDECIDED, BEYOND, UNDECIDED, 0.0, UNDECIDED])


def test_only_the_pairs_that_are_there_are_answered():
    """What lies behind the count in the buffer stays as it is."""
    shapes = np.array([square_on(10.0), square_on(12.0), square_on(14.0)])
    marks = beside(shapes.reshape(-1, 9), LENGTH, [Z_FRAME] * 3, np.zeros(3), count=2)[2]
    np.testing.assert_array_equal(marks, [0.0, 0.0, 7.0])


@pytest.mark.parametrize("place", ["amid", "aside", "far", "on a corner"])
def test_the_nearest_triangle_of_a_packed_surface(rng, place):
    """Of some hundreds of triangles, in blocks under a tree: the least distance of all, and the row of who has it."""
    corners = rng.normal(0, 30, (300, 1, 3)) + rng.normal(0, 4, (300, 3, 3))
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3))
    detections = {"amid": [1.0, 2, 3], "aside": [70.0, -20, 9], "far": [900.0, 0, -400], "on a corner": corners[17, 1]}
    target, blocks = np.array(detections[place]), pack(mesh)
    placed = placed_surface(blocks, target)
    each = segment_triangle_distance(target, target, blocks.triangles.reshape(-1, 3, 3))
    assert placed.distance == pytest.approx(min(each), abs=TIGHT_MM)
    assert each[placed.nearest] == pytest.approx(min(each), abs=TIGHT_MM)


@pytest.mark.parametrize("away_mm", [40.0, 5000.0])
def test_of_two_far_specks_the_nearer_one_is_nearest(away_mm):
    """Two groups of tiny triangles on either side, one nearer by 4e-6 of the way: a bound may not hide it for that."""
    speck = np.array([[-1e-4, -1e-4, 0], [2e-4, 0, 0], [0, 1e-4, 0]])
    for nearer in (-1, 1):
        groups = [np.array([0, 0, side * away_mm * (1 - 4e-6 * (side == nearer))]) for side in (-1, 1)]
        corners = np.concatenate([speck + place for place in groups for _ in range(32)])
        blocks = pack(TriangleMesh(corners, np.arange(len(corners)).reshape(-1, 3)))
        placed = placed_surface(blocks, np.zeros(3))
        assert placed.distance == pytest.approx(away_mm * (1 - 4e-6), abs=TIGHT_MM)
        assert np.sign(blocks.triangles[placed.nearest][2]) == nearer


def test_the_row_of_the_nearest_triangle_is_its_own(rng):
    """From beside each of the first triangles of the packed order, that row is the nearest one."""
    corners = rng.normal(0, 60, (40, 1, 3)) + rng.normal(0, 1, (40, 3, 3))
    blocks = pack(TriangleMesh(corners.reshape(-1, 3), np.arange(120).reshape(-1, 3)))
    for row in range(4):
        placed = placed_surface(blocks, blocks.triangles[row].reshape(3, 3).mean(axis=0) + 0.01)
        assert placed.nearest == row and placed.distance < 0.02


def test_a_surface_of_one_triangle_has_a_nearest_one():
    """The smallest surface: one block, filled up with one triangle."""
    placed = placed_surface(pack(TriangleMesh(square_on(7.0), np.array([[0, 1, 2]]))), np.array([0.0, 0, 3]))
    assert placed.distance == pytest.approx(4.0, abs=TIGHT_MM)


def test_every_crossing_of_a_small_surface(rng):
    """Rays from amid a dozen triangles, narrow and wide, near the poles and all around: depths, faces and counts."""
    corners = rng.normal(0, 20, (12, 1, 3)) + rng.normal(0, 1, (12, 3, 3)) * rng.choice([3.0, 30.0], (12, 1, 1))
    corners[0] = [[5.0, 0, 20], [-5, 5, 20], [-5, -5, 20]]
    corners[1] = [[5.0, 0, -20], [-5, 5, -20], [-5, -5, -20]]
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    rays = np.concatenate([[unit(rng) for _ in range(60)], np.eye(3), -np.eye(3), [[-1.0, 1e-9, 0], [-1.0, -1e-9, 0]]])
    middles = corners.mean(axis=1)
    rays = np.concatenate([rays, middles / np.linalg.norm(middles, axis=1, keepdims=True)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    origin = np.array([0.5, -0.25, 0.125])
    found = crossings(mesh, origin, rays)
    assert found.count.sum() > 15
    for row, ray in enumerate(rays):
        depths = found.depth[found.first[row] : found.first[row] + found.count[row]] if found.count[row] else []
        np.testing.assert_allclose(depths, ray_crossings(origin, ray, mesh), atol=1e-9)
    points = origin + found.depth[:, None] * rays[found.ray]
    for point, face in zip(points, found.face, strict=True):
        assert segment_triangle_distance(point, point, corners[face]) < 1e-9


def wide_and_narrow(rng, scale):
    """Triangles from a degree to over ninety wide, corners near and far: at the poles, along -x, elsewhere."""
    axes = np.concatenate([np.eye(3), -np.eye(3), [[-1.0, 0.02, 0.3], [-1, -0.02, -0.6]], rng.normal(0, 1, (12, 3))])
    found = []
    for axis in axes:
        for width in (0.02, 0.3, 1.2):
            corners = axis / np.linalg.norm(axis) + width * rng.normal(0, 1, (3, 3))
            found.append(corners * scale * rng.uniform(1.0, 30.0, (3, 1)))
    return np.array(found)


@pytest.mark.parametrize("scale", [0.01, 10.0])
def test_a_ray_into_a_triangle_crosses_it_however_near_its_rim(rng, scale):
    """Rays just within each corner, just within each edge and through the middle: the crossing is where they aim."""
    corners = wide_and_narrow(rng, scale)
    near = 1e-6
    weights = np.array([[1 - 2 * near, near, near], [0.5 - near, 0.5 - near, 2 * near], [1 / 3, 1 / 3, 1 / 3]])
    weights = np.concatenate([np.roll(weights[:2], k, axis=1) for k in range(3)] + [weights[2:]])
    points = np.einsum("wk,tkx->twx", weights, corners)
    away = np.linalg.norm(points, axis=-1)
    mesh = TriangleMesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3))
    found = crossings(mesh, np.zeros(3), (points / away[..., None]).reshape(-1, 3))
    met = {(int(ray), int(face)): depth for ray, face, depth in zip(found.ray, found.face, found.depth, strict=True)}
    for triangle in range(len(corners)):
        for w in range(len(weights)):
            depth = met.get((triangle * len(weights) + w, triangle))
            assert depth == pytest.approx(away[triangle, w], rel=1e-6)
    outside = np.array([[1.02, -0.01, -0.01], [0.51, 0.51, -0.02]])
    outside = np.concatenate([np.roll(outside, k, axis=1) for k in range(3)])
    beyond = np.einsum("wk,tkx->twx", outside, corners[::3])
    out = crossings(mesh, np.zeros(3), (beyond / np.linalg.norm(beyond, axis=-1)[..., None]).reshape(-1, 3))
    assert not any(face == 3 * (ray // 6) for ray, face in zip(out.ray.tolist(), out.face.tolist(), strict=True))


def test_triangles_about_the_poles(rng):
    """Three corners evenly about the z axis: their mean direction is z to rounding, and the axis crosses them all."""
    corners = []
    for turn, height in zip(rng.uniform(0, 2, 40), rng.choice([-1.0, 1.0], 40) * rng.uniform(1, 9, 40), strict=True):
        angles = turn + np.radians([0.0, 120, 240])
        corners.append(np.stack([np.cos(angles), np.sin(angles), np.full(3, height)], axis=1))
    mesh = TriangleMesh(np.concatenate(corners), np.arange(120).reshape(-1, 3))
    found = crossings(mesh, np.zeros(3), np.array([[0.0, 0, 1], [0, 0, -1]]))
    heights = np.array([c[0, 2] for c in corners])
    expected = [np.sort(heights[heights > 0]), np.sort(-heights[heights < 0])]
    np.testing.assert_allclose(found.depth, np.concatenate(expected), atol=1e-12)


@pytest.mark.parametrize("along", ["down", "up", "left", "right"])
def test_a_corner_that_leaves_its_bin_by_a_hair_is_met_there(along):
    """A triangle's corner reaches 5e-8 rad across a border between bins: rays there and on this side both cross it.

    Beside (1, 0, 0) lie borders of rows (90 degrees of polar angle) and of columns (0 degrees of azimuth).
    """
    turn = {"up": 0, "left": 90, "down": 180, "right": 270}[along]
    c, s = np.round([np.cos(np.radians(turn)), np.sin(np.radians(turn))])
    tip, rim = 5e-8, 0.1
    corners = np.array([[1.0, 0, tip], [1, 0.02, -rim], [1, -0.02, -rim]]) * 30.0
    rays = np.array([[1.0, 0, 2e-8], [1, 0, -2e-8], [1, 0, -0.05], [1, 0, 8e-8]])
    rolled = np.array([[1.0, 0, 0], [0, c, -s], [0, s, c]]).T
    rays = rays @ rolled / np.linalg.norm(rays, axis=1, keepdims=True)
    found = crossings(TriangleMesh(corners @ rolled, [[0, 1, 2]]), np.zeros(3), rays)
    assert found.count.tolist() == [1, 1, 1, 0]
    np.testing.assert_allclose(found.depth, 30.0, rtol=2e-3)


@pytest.mark.parametrize("order", [[0, 1, 2], [0, 2, 1]])
def test_an_edge_is_crossed_whichever_way_the_faces_are_wound(order):
    """Rays through the three edges and corners of a single triangle cross it."""
    corners = np.array([[4.0, 0, 8], [-4, 4, 8], [-4, -4, 8]])
    at = np.concatenate([corners, [[-4, 0, 8.0], [0, 2, 8], [0, -2, 8]]])
    found = crossings(TriangleMesh(corners, [order]), np.zeros(3), at / np.linalg.norm(at, axis=1, keepdims=True))
    assert found.count.tolist() == [1] * 6


@pytest.mark.parametrize("order", [[0, 1, 2], [0, 2, 1]])
def test_a_triangle_whose_weights_add_up_to_one_is_crossed(order):
    """Half a square millimetre across the ray: the three weights are twice areas, their sum exactly 1."""
    corners = np.array([[-0.25, -0.25, 5.0], [0.75, -0.25, 5.0], [-0.25, 0.75, 5.0]])
    found = crossings(TriangleMesh(corners, [order]), np.zeros(3), np.array([[0.0, 0.0, 1.0]]))
    assert found.depth.tolist() == [5.0]


def test_crossings_behind_beyond_and_at_the_length():
    """Nothing is crossed behind the origin or beyond the length; at the length it is; an edge counts once."""
    sheets = np.concatenate([square_on(10.0), square_on(-10.0), square_on(30.0), square_on(10.0) - [0, 10.0, 0]])
    mesh = TriangleMesh(sheets, np.arange(12).reshape(-1, 3))
    up = np.array([[0.0, 0, 1]])
    for length, depths in ((np.inf, [10, 30]), (30.0, [10, 30]), (29.9, [10]), (10.0, [10]), (9.9, [])):
        np.testing.assert_allclose(crossings(mesh, np.zeros(3), up, length).depth, depths)
    quad = TriangleMesh([[-5.0, -5, 8], [5, -5, 8], [5, 5, 8], [-5, 5, 8]], [[0, 1, 2], [0, 2, 3]])
    assert crossings(quad, np.zeros(3), up).count.tolist() == [1]


def test_rays_from_a_corner_of_the_surface():
    """From a corner rays into the solid leave once more; the corner's own triangles have no bounding cone."""
    corners = np.array([[0.0, 0, 0], [20, 0, 0], [0, 20, 0], [0, 0, 20]])
    mesh = TriangleMesh(corners, [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    inward = np.array([[1.0, 1, 1], [3.0, 1, 1], [1.0, 4, 2]])
    inward /= np.linalg.norm(inward, axis=1, keepdims=True)
    found = crossings(mesh, np.zeros(3), inward)
    last = [found.depth[found.ray == row].max() for row in range(3)]
    np.testing.assert_allclose(last, 20 / inward.sum(axis=1), atol=1e-9)
    np.testing.assert_array_equal(found.depth[found.first], 0.0)
