"""What lies beyond an image that cuts the body, against closed forms and the voxels of a body that goes on."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from puncture_twin.planning.anatomy.anatomy import ball
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.unseen import OUTLINE_MM, REACH_MM, USUAL_MM, assumed, beyond_image
from puncture_twin.planning.case.settings import CtSettings
from puncture_twin.planning.geometry.containment import Side, side_of
from puncture_twin.planning.geometry.mesh import joined
from puncture_twin.planning.geometry.rigid import exp_rotation

SIZE = np.array([300.0, 240.0, 180.0])
HEAD, LEFT = (2, 1), (0, 1)
TRUNK, RIGHT_ARM, LEFT_ARM = [((0, 0, 0), 150)], ((-350, 0, 0), 50), ((350, 40, 0), 50)
"""Balls."""


def box_with(*faces, T_ct_box=None):
    """An image of 300 x 240 x 180 mm that cuts the body at these faces."""
    cut = np.zeros((3, 2), bool)
    for axis, end in faces:
        cut[axis, end] = True
    return FieldOfView(np.eye(4) if T_ct_box is None else T_ct_box, SIZE, cut)


def cylinder(radius=80.0, middle=(150.0, 120.0)):
    """Points on a round body along z, as a fine surface has them; box frame."""
    angles = np.linspace(0, 2 * np.pi, 721)
    ring = np.stack([middle[0] + radius * np.cos(angles), middle[1] + radius * np.sin(angles)], axis=1)
    return np.concatenate([np.insert(ring, 2, z, axis=1) for z in np.arange(0.0, SIZE[2] + 1, 5.0)])


def inside(mesh, points):
    """Which points lie in a closed solid whose parts may overlap."""
    return np.array([side_of(mesh, point) is Side.INSIDE for point in points])


@pytest.mark.parametrize("wider", [0.0, 150.0])
def test_a_round_body_goes_on_as_a_wider_cylinder(rng, wider):
    """Beyond the plane, and there alone; nearer to the axis than radius and growth, and no farther by 1 %."""
    mesh = beyond_image(box_with(HEAD), cylinder(), wider)
    assert mesh.closed
    far = rng.uniform([-400, -400, SIZE[2] - 50], [700, 640, SIZE[2] + REACH_MM + 50], (3000, 3))
    beyond = (far[:, 2] > SIZE[2]) & (far[:, 2] < SIZE[2] + REACH_MM)
    away = np.hypot(far[:, 0] - 150.0, far[:, 1] - 120.0)
    found, limit = inside(mesh, far), 80.0 + wider
    assert found[beyond & (away < limit)].all()
    assert not found[~beyond | (away > limit / np.cos(np.pi / 32) + 1e-6)].any()
    assert found.sum() > 30


def test_without_a_bound_all_beyond_the_plane_is_unknown(rng):
    """The half space, as far as a needle and its arm reach, and nothing before the plane."""
    mesh = beyond_image(box_with(HEAD, LEFT), cylinder(), np.inf)
    points = rng.uniform(-1500, 1700, (2000, 3))
    expected = (points[:, 2] > SIZE[2]) | (points[:, 0] > SIZE[0])
    np.testing.assert_array_equal(inside(mesh, points), expected)


def test_where_two_neighbouring_faces_cut_the_body_the_corner_is_unknown_too():
    """A body that leaves at the left and at the head goes on beyond both, also without any growth."""
    points = cylinder(middle=(260.0, 120.0))
    points = points[points[:, 0] <= SIZE[0]]
    points = np.concatenate([points, [[SIZE[0], y, z] for y in (60.0, 180.0) for z in (0.0, 90.0, SIZE[2])]])
    corner = np.array([[SIZE[0] + 380, 120.0, SIZE[2] + 300], [SIZE[0] + 20, 120.0, SIZE[2] + 1500]])
    assert inside(beyond_image(box_with(HEAD, LEFT), points, 0.0), corner).all()
    alone = inside(beyond_image(box_with(HEAD), points, 0.0), corner)
    assert not alone.any()


def test_a_turned_image_turns_its_solid(rng):
    """An image whose axes are not those of the bed: the same solid in its own frame, normals outward."""
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = exp_rotation(np.array([0.3, -0.4, 0.5])), [10.0, -20.0, 30.0]
    turned = beyond_image(box_with(HEAD, (1, 0), T_ct_box=T), cylinder() @ T[:3, :3].T + T[:3, 3], 50.0)
    straight = beyond_image(box_with(HEAD, (1, 0)), cylinder(), 50.0)
    np.testing.assert_allclose(turned.vertices, straight.vertices @ T[:3, :3].T + T[:3, 3], atol=1e-9)
    a, b, c = np.moveaxis(straight.triangles, 1, 0)
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0


def test_less_air_beside_the_body_changes_nothing():
    """Rows of air cut off the image: the outline is the body's, not the image's."""
    view, points = box_with(HEAD, (2, 0)), cylinder()
    whole = beyond_image(view, points, 40.0)
    narrow = beyond_image(replace(view, size_mm=SIZE - [0.0, 30.0, 0.0]), points, 40.0)
    np.testing.assert_allclose(narrow.vertices, whole.vertices)


def test_a_body_that_narrows_is_taken_as_wide_as_in_its_last_slices():
    """A cone: the widest of the last 10 mm counts, so that a slice thinner than the outline never narrows it."""
    points = cylinder()
    narrowing = 1.0 - 0.5 * points[:, 2:] / SIZE[2]
    points[:, :2] = [150.0, 120.0] + narrowing * (points[:, :2] - [150.0, 120.0])
    reach = beyond_image(box_with(HEAD), points, 0.0).vertices[:, 0].max() - 150.0
    assert 80.0 * (1 - 0.5) <= reach <= 80.0 * (1 - 0.5 * (SIZE[2] - OUTLINE_MM) / SIZE[2]) + 0.5


def test_a_breath_brings_it_nearer():
    """What moves by up to 12 mm along the bed may come 12 mm nearer, and be as much wider."""
    still, moved = (beyond_image(box_with(HEAD), cylinder(), 0.0, by) for by in (None, np.array([0.0, 0.0, 12.0])))
    assert moved.vertices[:, 2].min() == pytest.approx(still.vertices[:, 2].min() - 12.0)
    assert moved.vertices[:, 0].max() == pytest.approx(still.vertices[:, 0].max() + 12.0)


@pytest.mark.parametrize(
    ("stated", "region", "cut", "parts", "wider"),
    [
        ({}, "abdomen", [HEAD], TRUNK, np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, ((350, 0, 0), 20)], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, ((0, 250, 0), 50)], np.inf),
        ({}, "abdomen", [HEAD], [*TRUNK, RIGHT_ARM, LEFT_ARM], USUAL_MM),
        ({}, "abdomen", [HEAD, LEFT], [*TRUNK, RIGHT_ARM, LEFT_ARM], np.inf),
        ({"arms": "none"}, "abdomen", [HEAD], TRUNK, USUAL_MM),
        ({}, "phantom", [HEAD], TRUNK, USUAL_MM),
        ({"arms": "present"}, "abdomen", [HEAD], TRUNK, USUAL_MM),
        ({"arms": "present"}, "abdomen", [HEAD, LEFT], TRUNK, np.inf),
        ({"arms": "none", "beyond_mm": np.inf}, "phantom", [HEAD], TRUNK, np.inf),
        ({"beyond_mm": 0.0}, "abdomen", [HEAD, LEFT], TRUNK, 0.0),
    ],
)
def test_what_is_assumed(stated, region, cut, parts, wider):
    """A person's word first; the usual where no arm can lie beyond, or both are seen; else nothing is excluded."""
    case = SimpleNamespace(ct=CtSettings(**stated), region=region)
    skin = SimpleNamespace(mesh=joined([ball(np.array(middle, float), radius) for middle, radius in parts]))
    assert assumed(case, box_with(*cut), skin).wider_mm == wider
