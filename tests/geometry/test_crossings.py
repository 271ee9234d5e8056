"""Every crossing of every ray: against brute force, and rays through edges and corners."""

import numpy as np
import pytest
import trimesh
from oracles import ray_crossings

from puncture_twin.planning.geometry.containment import (
    Side,
    consistent_crossings,
    contains,
    crossings,
    inside_each,
    side_of,
    winding_number,
)
from puncture_twin.planning.geometry.mesh import TriangleMesh


def by_ray(found, count):
    return [found.depth[found.ray == row].tolist() for row in range(count)]


def soup(rng, count, spread, size):
    centers = rng.normal(0, spread, (count, 1, 3))
    return TriangleMesh(
        (centers + rng.normal(0, size, (count, 3, 3))).reshape(-1, 3), np.arange(3 * count).reshape(-1, 3)
    )


@pytest.mark.parametrize(("spread", "size"), [(60, 10), (60, 100), (3, 3), (500, 1)])
def test_crossings_equal_brute_force(rng, spread, size):
    """Small, huge, near and far triangles, seen from among them: the same depths as triangle by triangle."""
    mesh = soup(rng, 60, spread, size)
    directions = rng.normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    origin = rng.normal(0, 2, 3)
    found = by_ray(crossings(mesh, origin, directions), len(directions))
    for depths, direction in zip(found, directions, strict=True):
        np.testing.assert_allclose(depths, ray_crossings(origin, direction, mesh), atol=1e-8)


@pytest.mark.parametrize(("spread", "size"), [(60, 10), (60, 100), (3, 3)])
def test_a_ray_crosses_the_same_among_few_and_among_many(rng, spread, size):
    """The bins are as coarse as the rays are few: alone, with some or with tens of thousands, to the bit."""
    mesh = soup(rng, 60, spread, size)
    directions = rng.normal(size=(40_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    every = crossings(mesh, np.zeros(3), directions)
    assert len(every.ray) > 1000
    hit = int(every.ray[0])
    for rows in (slice(hit, hit + 1), slice(0, 8), slice(0, 9), slice(0, 150), slice(0, 5000)):
        found, begin = crossings(mesh, np.zeros(3), directions[rows]), rows.start
        kept = (every.ray >= begin) & (every.ray < rows.stop)
        np.testing.assert_array_equal(found.ray + begin, every.ray[kept])
        for name in ("depth", "face"):
            np.testing.assert_array_equal(getattr(found, name), getattr(every, name)[kept])


def test_no_ray_has_no_crossings(ball):
    found = crossings(ball(10.0), np.zeros(3), np.zeros((0, 3)))
    assert [len(one) for one in (found.ray, found.depth, found.face, found.count, found.first)] == [0] * 5


@pytest.mark.parametrize(("spread", "size"), [(60, 10), (60, 100), (3, 3), (40, 4), (100, 2000)])
def test_a_length_leaves_out_what_lies_beyond_and_nothing_else(rng, spread, size):
    """Of small and huge triangles the crossings of a length are those of no length that are no deeper, to the bit."""
    mesh = soup(rng, 400, spread, size)
    directions = rng.normal(size=(150, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    every = crossings(mesh, np.zeros(3), directions)
    assert len(every.depth) > 5
    for length in (*np.quantile(every.depth, [0.05, 0.3, 0.7]), every.depth[0]):
        found, kept = crossings(mesh, np.zeros(3), directions, length), every.depth <= length
        for name in ("ray", "depth", "face"):
            np.testing.assert_array_equal(getattr(found, name), getattr(every, name)[kept])


def test_a_surface_holds_what_lies_inside_of_it(rng, ball):
    """The points whose side is inside, in the box of a closed surface and beyond; an open one holds none."""
    mesh, points = ball(50), rng.uniform(-70, 70, (200, 3))
    inside = [side_of(mesh, point) is Side.INSIDE for point in points]
    assert [contains(mesh, point) for point in points] == inside and 20 < sum(inside) < 180
    assert not any(contains(TriangleMesh(mesh.vertices, mesh.faces[1:]), point) for point in points)


def test_triangles_given_again_the_other_way_do_not_hide_an_inside(ball):
    """A closed ball whose near triangles are given twice more, reversed: their solid angles do not undo the inside."""
    mesh, point = ball(50, subdivisions=1), np.array([0.0, 0, 40.0])
    near = mesh.faces[np.argsort(np.linalg.norm(mesh.triangles.mean(axis=1) - [0, 0, 50.0], axis=1))[:6], ::-1]
    again = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, near, near]))
    assert again.closed and abs(winding_number(again, point)) < 0.5
    assert side_of(again, point) is Side.INSIDE


@pytest.mark.parametrize("welded", [True, False])
def test_a_surface_given_both_ways_round_has_its_inside(ball, welded):
    """As some programs write organs, to be seen from either side: the solid angles add up to nothing."""
    mesh = ball(50, subdivisions=2)
    faces = np.concatenate([mesh.faces, mesh.faces[:, ::-1]])
    both = TriangleMesh(mesh.vertices, faces)
    if not welded:
        both = TriangleMesh(both.triangles.reshape(-1, 3), np.arange(3 * len(faces)).reshape(-1, 3))
    points = np.array([[1.0, 2, 3], [40, 0, 0], [0, 0, 49], [45, 45, 0], [0, 0, 51]])
    assert both.closed and winding_number(both, points[0]) == pytest.approx(0.0)
    assert [side_of(both, point) is Side.INSIDE for point in points] == [True, True, True, False, False]
    assert inside_each(both, points).tolist() == [True, True, True, False, False]


def test_shells_within_shells_keep_their_hollows(ball):
    """An inner shell that is wound against the outer one is a hollow; wound alike it is solid throughout."""
    outer, inner = ball(50), ball(20)
    for faces, expected in ((inner.faces[:, ::-1], Side.OUTSIDE), (inner.faces, Side.INSIDE)):
        both = TriangleMesh(
            np.concatenate([outer.vertices, inner.vertices]), np.concatenate([outer.faces, faces + len(outer.vertices)])
        )
        assert side_of(both, np.zeros(3)) is expected
        assert side_of(both, np.array([35.0, 0, 0])) is Side.INSIDE


def test_rays_in_the_plane_of_triangles_meet_the_same_alone_and_among_many():
    """There the edge functions are rounding alone: which triangles are asked must not hang on the other rays."""
    rng = np.random.default_rng(4)
    at = np.stack(np.meshgrid(np.arange(13.0), np.arange(13.0), indexing="ij"), axis=-1).reshape(-1, 2) * 10.0 - 37.0
    corner = (np.arange(12)[:, None] * 13 + np.arange(12)).ravel()
    faces = np.concatenate([[corner, corner + 13, corner + 1], [corner + 1, corner + 13, corner + 14]], axis=1).T
    others = rng.normal(size=(30_000, 3))
    for _ in range(10):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        mesh = TriangleMesh(np.column_stack([at, np.zeros(len(at))]) @ turn.T, faces)
        angles = rng.uniform(0, 2 * np.pi, 60)
        directions = np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1) @ turn.T
        crowd = np.concatenate([directions, others / np.linalg.norm(others, axis=1, keepdims=True)])
        among = by_ray(crossings(mesh, np.zeros(3), crowd), len(directions))
        alone = [by_ray(crossings(mesh, np.zeros(3), one[None]), 1)[0] for one in directions]
        assert alone == among
        assert any(alone)


@pytest.mark.parametrize("off", [0.0, 1e-15, -1e-12, 1e-9, -1e-7, 1e-4])
def test_no_ray_through_a_triangle_is_lost_however_small_it_is_and_long_the_ray(off):
    """Seen under a hundredth of a radian to a millionth; rounding, and a direction that is not quite unit."""
    rng = np.random.default_rng(8)
    third = 2 * np.pi / 3 * np.arange(3)
    shape = np.stack([np.cos(third), np.sin(third), 0 * third], axis=1)
    for size in 10.0 ** rng.uniform(-6, -2, 300):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        corners = 10.0 ** rng.uniform(-3, 4) * ((size * shape + [0, 0, 1]) @ turn.T)
        toward = (0.9 * rng.dirichlet([1, 1, 1], 20) + 0.1 / 3) @ corners
        directions = toward / np.linalg.norm(toward, axis=1, keepdims=True) * (1 + off)
        found = crossings(TriangleMesh(corners, np.array([[0, 1, 2]])), np.zeros(3), directions)
        assert found.count.tolist() == [1] * 20


def shells(vertices, faces, count, off):
    """Copies of a surface about a point, each twice as large as the last, far from or at the origin."""
    points = np.concatenate([vertices * 2.0**k for k in range(count)]) + off
    return TriangleMesh(points, np.concatenate([faces + k * len(vertices) for k in range(count)]))


@pytest.mark.parametrize(("off", "count"), [(0.0, 1), (7.3, 3), (5e3, 2)])
@pytest.mark.parametrize("form", ["geodesic", "meridians"])
def test_a_ray_through_corners_and_edges_leaves_every_shell_once(rng, form, off, count):
    """Rounding tells at random on which side of a corner's edges a ray passes: it must not be between all of them."""
    for _ in range(8):
        ball = trimesh.creation.icosphere(3) if form == "geodesic" else trimesh.creation.uv_sphere(count=[19, 24])
        turned = ball.vertices @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
        mesh = shells(turned * rng.uniform(30, 40, (len(turned), 1)), ball.faces, count, off)
        a, b, c = (mesh.triangles[: len(ball.faces)] - off).swapaxes(0, 1)
        toward = np.concatenate([a, b, (a + b) / 2, 0.3 * a + 0.7 * c, (1 - 1e-6) * a + 5e-7 * (b + c)])
        directions = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        assert np.unique(crossings(mesh, np.full(3, off), directions).count).tolist() == [count]


def box_between(low, high):
    box = trimesh.creation.box(np.subtract(high, low))
    return (box.vertices + np.add(low, high) / 2)[box.faces]


def soup_of(*solids):
    """Triangles of several solids as one mesh, each with its own corners."""
    triangles = np.concatenate(solids)
    return TriangleMesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))


WHOLE = box_between([-300, -430, -300], [300, 200, 300])
INNER = box_between([-250, -400, -250], [250, -60, 250])
STACK = [
    ([-300, -60, -300], [300, 200, 300]),
    ([-300, -400, -300], [300, -60, 300]),
    ([-300, -430, -300], [300, -400, 300]),
]


@pytest.mark.parametrize("turned", [False, True], ids=["outward", "inward"])
@pytest.mark.parametrize(
    ("solids", "ways", "settled"),
    [
        pytest.param([WHOLE], [1], True, id="one"),
        pytest.param([WHOLE, INNER[:, ::-1]], [1, -1, 1], True, id="a hollow"),
        pytest.param([WHOLE, INNER], [-1, 1, 1], False, id="a shell wound alike"),
        pytest.param([box_between(*part) for part in STACK], [0, 0, 1], False, id="shared walls"),
    ],
)
def test_the_first_crossing_is_the_way_out_or_nothing_is_settled(solids, ways, settled, turned):
    """An odd count is not enough: where shells lie in shells or share walls, the body goes on behind the first."""
    mesh = soup_of(*(solid[:, ::-1] if turned else solid for solid in solids))
    directions = np.array([[0.01, -1.0, 0.02], [-0.1, -1.0, 0.03]])
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found, adds_up = consistent_crossings(mesh, np.zeros(3), directions)
    assert mesh.closed and mesh.wound_alike
    assert adds_up.tolist() == [settled] * 2
    assert found.sense.tolist() == [-way if turned else way for way in ways] * 2


@pytest.mark.parametrize("height", [0.0, 1e-15, 1e-14, 1e-13, 1e-12, 1e-11])
def test_a_sliver_that_closes_a_gap_does_not_say_where_a_ray_leaves(rng, height):
    """A corner in the middle of a neighbour's edge: where a ray meets the sliver between them rounding alone tells."""
    for _ in range(40):
        ball = trimesh.creation.icosphere(1)
        points = ball.vertices * rng.uniform(50, 150, (len(ball.vertices), 1))
        a, b, c = ball.faces[0]
        middle = points[a] + rng.uniform(0.05, 0.95) * (points[b] - points[a]) + 100 * height * rng.normal(size=3)
        new = len(points)
        faces = np.concatenate([ball.faces[1:], [[a, new, c], [new, b, c], [a, b, new]]])
        mesh = TriangleMesh(np.concatenate([points, middle[None]]), faces)
        toward = rng.dirichlet([1, 1, 1], 200) @ mesh.vertices[[a, b, new]]
        directions = toward / np.linalg.norm(toward, axis=1, keepdims=True)
        found, settled = consistent_crossings(mesh, np.zeros(3), directions)
        assert mesh.closed and mesh.wound_alike
        assert found.count[settled].max() == 1
        depth = found.depth[found.first[settled]]
        np.testing.assert_allclose(depth, np.linalg.norm(toward[settled], axis=1), atol=0.01)
        assert settled.mean() > 0.9
