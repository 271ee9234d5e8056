"""A mesh holds arrays that nobody writes to, copies what somebody might, and joins with others."""

from collections.abc import Callable

import numpy as np
import pytest

from puncture_twin.planning.formats.guard import guard_mesh
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined, spread_on

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
