"""The simple bodies of the pictures, against trimesh's own."""

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.geometry.mesh import box
from puncture_twin.planning.geometry.rigid import exp_rotation, pose
from puncture_twin.twin.report.scene.scene_parts import ball, bar, revolved, ring

T = pose(exp_rotation(np.array([0.3, -1.1, 0.7])), np.array([40.0, -7.0, 12.0]))

BODIES = {
    "bar": (bar(np.array([1.0, 2.0, 3.0]), np.array([1.0, 2.0, 43.0]), 2.5), trimesh.creation.cylinder(2.5, 40.0, 24)),
    "slanted bar": (bar(np.zeros(3), np.array([3.0, -4.0, 12.0]), 1.0), trimesh.creation.cylinder(1.0, 13.0, 24)),
    "box": (box(T, (2.0, 30.0, 5.0)), trimesh.creation.box((2.0, 30.0, 5.0))),
    "ring": (ring(T, 350.0, 480.0, 60.0), trimesh.creation.annulus(350.0, 480.0, 60.0, 48)),
}


def solid(mesh):
    return trimesh.Trimesh(mesh.vertices, mesh.faces, process=False)


@pytest.mark.parametrize("name", BODIES)
def test_a_body_is_trimeshs_own(name):
    """Closed, facing outwards, of the same volume, area and inertia about its centre."""
    ours, theirs = solid(BODIES[name][0]), BODIES[name][1]
    assert ours.is_watertight and ours.is_winding_consistent
    assert ours.volume == pytest.approx(theirs.volume, rel=1e-9)
    assert ours.area == pytest.approx(theirs.area, rel=1e-9)
    assert np.allclose(ours.principal_inertia_components, theirs.principal_inertia_components, rtol=1e-9)


def test_a_bar_lies_between_its_points():
    start, end = np.array([10.0, -20.0, 5.0]), np.array([-30.0, 15.0, 60.0])
    along = (end - start) / np.linalg.norm(end - start)
    points = bar(start, end, 3.0).vertices
    depth = (points - start) @ along
    assert sorted(set(depth.round(9))) == pytest.approx([0.0, np.linalg.norm(end - start)])
    aside = np.linalg.norm(points - start - depth[:, None] * along, axis=1)
    assert sorted(set(aside.round(9))) == pytest.approx([0.0, 3.0])


def test_a_ball_is_round():
    mesh = solid(ball(np.array([5.0, 6.0, 7.0]), 4.0))
    assert mesh.is_watertight and mesh.is_winding_consistent
    assert np.allclose(np.linalg.norm(mesh.vertices - [5.0, 6.0, 7.0], axis=1), 4.0)
    assert 0.97 < mesh.volume / (4.0 / 3.0 * np.pi * 4.0**3) < 1.0


def test_corners_on_the_axis_are_one():
    cone = solid(revolved(np.array([[0.0, 0.0], [2.0, 0.0], [0.0, 3.0]]), 7))
    assert len(cone.vertices) == 7 + 2 and cone.is_watertight
    assert cone.volume > 0.0
