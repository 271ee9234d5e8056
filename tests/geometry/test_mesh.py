"""A mesh holds arrays that nobody writes to, copies what somebody might, and joins with others."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined, smooth_normals, split_at_creases, spread_on

VERTICES = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32)
CLOSED, OPEN = TriangleMesh(VERTICES, FACES), TriangleMesh(VERTICES, FACES[:3])


def of_bytes() -> np.ndarray:
    """Vertices as the cache has them: in bytes, which cannot be changed."""
    return np.frombuffer(VERTICES.tobytes()).reshape(-1, 3)


def frozen() -> np.ndarray:
    """Vertices in an array that is read-only and has its own memory."""
    vertices = VERTICES.copy()
    vertices.setflags(write=False)
    return vertices


@pytest.mark.parametrize("make", [of_bytes, frozen, lambda: frozen()[:4]])
def test_what_nobody_writes_to_is_taken_as_it_is(make: Callable[[], np.ndarray]) -> None:
    """A copy of each surface of a whole body would cost more than to check it."""
    given = make()
    assert TriangleMesh(given, FACES).vertices is given


def behind() -> np.ndarray:
    look = VERTICES.copy()[:]
    look.setflags(write=False)
    return look


@pytest.mark.parametrize(
    "make",
    [
        VERTICES.copy,
        behind,
        lambda: np.frombuffer(bytearray(VERTICES.tobytes())).reshape(-1, 3),
        lambda: np.asfortranarray(of_bytes()),
        lambda: frozen().astype(np.float32),
        lambda: frozen()[::-1],
    ],
)
def test_what_somebody_may_write_to_is_copied(make: Callable[[], np.ndarray]) -> None:
    """Writable itself or where it looks at, of another order or type: the mesh does not change with it."""
    given = make()
    mesh, expected = TriangleMesh(given, FACES), np.array(given, np.float64)
    assert not np.shares_memory(mesh.vertices, given)
    if isinstance(given.base, np.ndarray) and given.base.flags.writeable:
        given.base[:] = 7.0
    elif given.flags.writeable:
        given[:] = 7.0
    assert np.array_equal(mesh.vertices, expected)
    assert not mesh.vertices.flags.writeable and mesh.vertices.flags.c_contiguous
    assert mesh.vertices.dtype == np.float64


def test_surfaces_join_in_order_and_one_alone_is_itself() -> None:
    """Each keeps its triangles, whose numbers go up by the vertices before it."""
    both = joined([CLOSED, OPEN])
    assert np.array_equal(both.triangles, np.concatenate([CLOSED.triangles, OPEN.triangles]))
    assert (len(both.vertices), both.faces.dtype) == (8, np.int32)
    assert joined([OPEN]) is OPEN


def test_what_is_known_of_a_mesh_is_not_looked_for_again() -> None:
    assert CLOSED.closed and CLOSED.wound_alike and not OPEN.closed and not OPEN.wound_alike
    told = TriangleMesh(VERTICES, FACES).known(closed=False, wound_alike=False)
    assert not told.closed and not told.wound_alike


def test_areas_and_volume_are_those_of_the_cross_products(rng: np.random.Generator) -> None:
    """To the bit, so that points are spread as before; flat triangles in front do not hide the rest."""
    vertices, faces = rng.normal(size=(50, 3)), rng.integers(0, 50, (300, 3))
    faces[:20] = 7
    mesh = TriangleMesh(vertices, faces)
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    assert np.array_equal(mesh.areas, np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2.0)
    middle = mesh.bounds.mean(axis=0)
    assert mesh.volume == pytest.approx(np.einsum("ij,ij->", a - middle, np.cross(b - middle, c - middle)) / 6.0)
    assert np.array_equal(guard_mesh(vertices, faces, where="test").areas, mesh.areas)


def test_points_are_spread_by_area() -> None:
    """As many on each triangle as its part of the area, to one; normals are its own."""
    mesh = TriangleMesh([[0, 0, 0], [3, 0, 0], [0, 2, 0], [3, 0, 1.0]], [[0, 1, 2], [0, 0, 1], [0, 3, 1]])
    found = spread_on(mesh, 900)
    up = np.abs(found.normals[:, 2]) == 1.0
    assert up.sum() == pytest.approx(600, abs=1) and (~up).sum() == pytest.approx(300, abs=1)
    assert np.all(found.points[up, 2] == 0.0) and np.all(np.abs(found.points[~up, 1]) < 1e-12)


def both_ways(faces, rng):
    return np.concatenate([faces, faces[:, ::-1]])


def some_turned(share):

    def turn(faces, rng):
        return np.where((rng.random(len(faces)) < share)[:, None], faces[:, ::-1], faces)

    return turn


def off_deg(normals, points):
    """Between normals and the radii of a ball, whichever way round, degrees."""
    cosine = np.abs(np.einsum("ij,ij->i", normals, points)) / np.linalg.norm(points, axis=1)
    return np.degrees(np.arccos(np.minimum(cosine, 1.0)))


@pytest.mark.parametrize(
    "wound",
    [
        pytest.param(lambda faces, rng: faces, id="alike"),
        pytest.param(both_ways, id="both ways round"),
        pytest.param(some_turned(0.5), id="half against the others"),
        pytest.param(some_turned(0.1), id="a tenth against the others"),
    ],
)
def test_normals_are_a_balls_however_its_triangles_are_wound(rng, wound):
    """Blended where triangles agree, off by a fraction of what flat ones are; by no more than twice that anywhere.

    Areas whose sum keeps half of them, each off by an angle, are off by no more than twice its sine together.
    """
    ball = trimesh.creation.icosphere(4, radius=100.0)
    flat = off_deg(np.repeat(ball.face_normals, 3, axis=0), ball.triangles.reshape(-1, 3)).max()
    mesh = split_at_creases(TriangleMesh(ball.vertices, wound(ball.faces, rng)))
    face = rng.integers(0, len(mesh.faces), 3000)
    points = np.einsum("ij,ijk->ik", rng.dirichlet([1, 1, 1], 3000), mesh.triangles[face])
    off = off_deg(smooth_normals(mesh, face, points), points)
    assert off.max() <= (flat / 5 if mesh.wound_alike else 2 * flat)


@pytest.mark.parametrize("wound", [lambda faces, rng: faces, both_ways, some_turned(0.5)])
@pytest.mark.parametrize("ridge_deg", [20.0, 40.0, 59.0, 90.0, 110.0])
def test_the_sides_of_a_ridge_keep_their_normals(rng, ridge_deg, wound):
    """However sharp: the normals of a ridge of 40 degrees lie 140 apart, though their lines only 40."""
    half = np.radians(ridge_deg / 2)
    left, right = np.array([-np.sin(half), -np.cos(half)]) * 50, np.array([np.sin(half), -np.cos(half)]) * 50
    prism = trimesh.creation.extrude_triangulation(np.array([left, right, [0.0, 0.0]]), [[0, 1, 2]], height=80.0)
    prism = prism.subdivide().subdivide()
    mesh = split_at_creases(TriangleMesh(prism.vertices, wound(prism.faces, rng)))
    face = np.arange(len(mesh.faces))
    found = smooth_normals(mesh, face, mesh.triangles.mean(axis=1))
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    own = np.cross(b - a, c - a)
    own /= np.linalg.norm(own, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs(np.einsum("ij,ij->i", found, own)), 1.0, atol=1e-9)
