"""Needle to organ: FCL against brute force and geometry, and the laws that clearance obeys."""

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from oracles import segment_mesh_distance
from scipy.spatial.transform import Rotation

from puncture_twin.planning.anatomy.anatomy import Role, Structure
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.clearance.measure import measure
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 150.0


def units(rng, count):
    """Random directions."""
    directions = rng.normal(size=(count, 3))
    return directions / np.linalg.norm(directions, axis=1, keepdims=True)


def organ(mesh, margin=0.0, role=Role.AVOID):
    """A structure of that surface."""
    return Structure("organ", role, margin, mesh, "test")


def clearances(mesh, target, directions, *, radius=0.6, margin=0.0, role=Role.AVOID):
    """Measured by FCL."""
    return measure(
        FclEngine([mesh]),
        (organ(mesh, margin, role),),
        np.asarray(target, float),
        directions,
        length=LENGTH,
        radius=radius,
    )


def test_distance_equals_brute_force(rng, ball, box):
    """Axis distances agree with the triangle-by-triangle oracle to 1e-9 mm, hits included."""
    meshes = [ball(20, (60, 0, 0), 1), box([30, 20, 10], (0, 50, 20)), ball(4, (5, 5, -30), 1)]
    target = np.array([1.0, 2.0, 3.0])
    directions = units(rng, 120)
    found = FclEngine(meshes).measure(target, directions, LENGTH)
    for row, direction in enumerate(directions):
        for column, mesh in enumerate(meshes):
            oracle = segment_mesh_distance(target, target + LENGTH * direction, mesh)
            assert found.distance[row, column] == pytest.approx(oracle, abs=1e-9)


def test_clearance_of_a_ball_is_known_by_geometry(ball):
    """Past a sphere at distance d from the axis the clearance is d minus both radii; behind the target too."""
    mesh = ball(10, (50, 30, 0), 5)
    found = clearances(mesh, [0, 0, 0], np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0]]))
    expected = [30 - 10 - 0.6, 50 - 10 - 0.6, np.hypot(50, 30) - 10 - 0.6]
    np.testing.assert_allclose(found.clearance[:, 0], expected, atol=0.02)
    np.testing.assert_allclose(found.depth[:, 0], [50, 30, 0], atol=1.0)


def test_a_needle_through_a_structure_is_minus_its_radius(ball):
    """Where the axis meets the structure the clearance is minus the needle radius, at the first meeting."""
    found = clearances(ball(10, (50, 3, 0), 5), [0, 0, 0], np.array([[1.0, 0, 0]]))
    assert found.clearance[0, 0] == pytest.approx(-0.6)
    assert found.depth[0, 0] == pytest.approx(50 - np.sqrt(100 - 9), abs=0.05)
    assert found.violated.all()


def test_a_needle_wholly_inside_is_a_hit(rng, ball):
    """FCL sees surfaces only; a needle swallowed by a closed mesh must be a hit all the same."""
    found = clearances(ball(400), [0, 0, 0], units(rng, 20))
    np.testing.assert_array_equal(found.clearance, -0.6)
    assert found.violated.all()


def test_a_needle_wholly_inside_a_badly_wound_mesh_is_a_hit(rng, ball):
    """A third of the triangles wound the other way: still a closed surface, and the needle in it is in the organ."""
    mesh = ball(400)
    flip = rng.random((len(mesh.faces), 1)) < 0.33
    mixed = TriangleMesh(mesh.vertices, np.where(flip, mesh.faces[:, ::-1], mesh.faces))
    assert clearances(mixed, [3.0, 5.0, 7.0], units(rng, 20)).violated.all()


def test_inside_an_open_mesh_distance_stays(rng, ball):
    """An open mesh has no inside: the distance from its surface is what can be said."""
    mesh = ball(400)
    opened = TriangleMesh(mesh.vertices, mesh.faces[1:])
    assert (clearances(opened, [0, 0, 0], units(rng, 5)).clearance > 200).all()


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=15, deadline=None)
def test_clearance_does_not_change_under_a_rigid_motion(seed):
    """Turning and moving the whole scene leaves every clearance alone (1e-9 mm)."""
    rng = np.random.default_rng(seed)
    mesh = TriangleMesh(rng.normal(0, 40, (30, 3)), np.arange(30).reshape(-1, 3))
    directions, target = units(rng, 10), rng.normal(0, 10, 3)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    T[:3, 3] = rng.uniform(-500, 500, 3)
    moved = clearances(mesh.transformed(T), T[:3, :3] @ target + T[:3, 3], directions @ T[:3, :3].T)
    np.testing.assert_allclose(moved.clearance, clearances(mesh, target, directions).clearance, atol=1e-9)


@given(st.integers(0, 2**32 - 1), st.floats(0.01, 30))
@settings(max_examples=15, deadline=None)
def test_clearance_grows_by_no_more_than_the_distance_moved(seed, step):
    """Moving the needle by s changes no clearance by more than s (Lipschitz 1)."""
    rng = np.random.default_rng(seed)
    mesh = TriangleMesh(rng.normal(0, 40, (30, 3)), np.arange(30).reshape(-1, 3))
    directions, target = units(rng, 10), rng.normal(0, 10, 3)
    shift = step * units(rng, 1)[0]
    change = clearances(mesh, target + shift, directions).clearance - clearances(mesh, target, directions).clearance
    assert (np.abs(change) <= step + 1e-9).all()


def test_the_verdict_is_fcls_own_near_the_threshold(rng, ball):
    """With the margin at the exact clearance ± 1e-3 ... 1e-7 mm: FCL's capsule collision decides, and may only add."""
    mesh = ball(20, (60, 10, 5), 3)
    target, radius = np.zeros(3), 0.6
    engine = FclEngine([mesh])
    directions = np.array([[1.0, 0, 0]]) + 0.7 * units(rng, 12)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    exact = clearances(mesh, target, directions).clearance[:, 0]
    decided = 0
    for row in np.flatnonzero(exact > 0):
        for offset in (1e-3, 1e-4, 1e-5, 1e-6, 1e-7):
            for sign in (-1, 1):
                margin = exact[row] + sign * offset
                found = clearances(mesh, target, directions[row : row + 1], margin=margin)
                rated = engine.collides(0, target, directions[row], LENGTH, radius + margin)
                assert bool(found.violated[0, 0]) == (rated or sign > 0)
                decided += 1
    assert decided >= 50


def test_an_overlap_that_fcl_does_not_see_is_too_close(rng, ball):
    """A margin that lacks 1e-7 mm is not kept: FCL calls a capsule free that overlaps by less than its tolerance."""
    mesh, radius, unseen = ball(20, (60, 10, 5), 3), 0.6, 0
    engine, directions = FclEngine([mesh]), np.array([[1.0, 0, 0]]) + 0.7 * units(rng, 20)
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    exact = clearances(mesh, np.zeros(3), directions).clearance[:, 0]
    for row in np.flatnonzero(exact > 0):
        margin = exact[row] + 1e-7
        unseen += not engine.collides(0, np.zeros(3), directions[row], LENGTH, radius + margin)
        assert clearances(mesh, np.zeros(3), directions[row : row + 1], margin=margin).violated.all()
    assert unseen > 0


def test_far_from_the_threshold_distance_and_collision_agree(rng, ball, box):
    """The distance verdict equals FCL's capsule collision over random directions and margins."""
    meshes = [ball(20, (60, 0, 0), 3), box([30, 20, 10], (0, 50, 20))]
    engine = FclEngine(meshes)
    directions = units(rng, 150)
    for column, mesh in enumerate(meshes):
        for radius in (0.5, 3.0, 5.5):
            found = clearances(mesh, [0, 0, 0], directions, radius=radius)
            rated = [engine.collides(column, np.zeros(3), u, LENGTH, radius) for u in directions]
            np.testing.assert_array_equal(found.violated[:, 0], rated)


def test_roles_without_a_margin_are_never_violated(ball):
    """A structure that may be crossed has a clearance, and no say."""
    found = clearances(ball(10, (50, 0, 0)), [0, 0, 0], np.array([[1.0, 0, 0]]), role=Role.TRAVERSE)
    assert found.clearance[0, 0] == pytest.approx(-0.6)
    assert not found.violated.any()
