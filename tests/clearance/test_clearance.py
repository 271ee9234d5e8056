"""Needle to organ: verdicts near their threshold. What every engine obeys is in tests/laws."""

import numpy as np
import pytest
from oracles import units

from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.clearance.engine import measure_clearances
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh

LENGTH = 150.0


def organ(mesh, margin=0.0, role=Role.AVOID):
    """A structure of that surface."""
    return Structure("organ", role, margin, mesh, "test")


def clearances(mesh, target, directions, *, radius=0.6, margin=0.0, role=Role.AVOID):
    """Measured by FCL."""
    return measure_clearances(
        FclEngine([mesh]),
        (organ(mesh, margin, role),),
        np.asarray(target, float),
        directions,
        length=LENGTH,
        radius=radius,
    )


def test_a_needle_through_a_structure_is_minus_its_radius(ball):
    """Where the axis meets the structure the clearance is minus the needle radius, at the first meeting."""
    found = clearances(ball(10, (50, 3, 0), 5), [0, 0, 0], np.array([[1.0, 0, 0]]))
    assert found.clearance[0, 0] == pytest.approx(-0.6)
    assert found.depth[0, 0] == pytest.approx(50 - np.sqrt(100 - 9), abs=0.05)
    assert found.violated.all()


def test_inside_an_open_mesh_distance_stays(rng, ball):
    """An open mesh has no inside: the distance from its surface is what can be said."""
    mesh = ball(400)
    opened = TriangleMesh(mesh.vertices, mesh.faces[1:])
    assert (clearances(opened, [0, 0, 0], units(rng, 5)).clearance > 200).all()


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


def test_roles_without_a_margin_are_never_violated(ball):
    """A structure that may be crossed has a clearance, and no say."""
    found = clearances(ball(10, (50, 0, 0)), [0, 0, 0], np.array([[1.0, 0, 0]]), role=Role.TRAVERSE)
    assert found.clearance[0, 0] == pytest.approx(-0.6)
    assert not found.violated.any()
