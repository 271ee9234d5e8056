"""The skin along a path: a body of boxes and tents whose crossings, angles and second looks are known by hand."""

import importlib

import numpy as np
import pytest
import trimesh

from puncture_twin.planning.anatomy.skin import Skin, skin_from_mesh, skin_paths
from puncture_twin.planning.geometry.mesh import TriangleMesh, joined

UP = np.array([[0.0, 0.0, 1.0]])


def pyramid():
    """A square pyramid from z = -10 to its top at (0, 0, 30): four faces meet in the corner that UP runs through."""
    base = [[-20.0, -20, -10], [20, -20, -10], [20, 20, -10], [-20, 20, -10]]
    faces = [[0, 1, 4], [1, 2, 4], [2, 3, 4], [3, 0, 4], [0, 2, 1], [0, 3, 2]]
    return TriangleMesh(np.array([*base, [0.0, 0, 30]]), np.array(faces))


def touched_by_an_edge():
    """A box about the origin, and above it a roof whose ridge along x the vertical ray from the origin only touches.

    The roof is upside down: its ridge, at z = 80, is its lowest line, beside the ray's way on one side only.
    """
    box = trimesh.creation.box([40, 40, 40])
    wedge = np.array([[-10.0, 0, 80], [10, 0, 80], [-10, 10, 90], [10, 10, 90], [-10, 10, 80], [10, 10, 80]])
    faces = np.array([[0, 1, 2], [1, 3, 2], [0, 4, 1], [1, 4, 5], [2, 3, 4], [3, 5, 4], [0, 2, 4], [1, 5, 3]])
    return joined([TriangleMesh(box.vertices, box.faces), TriangleMesh(wedge, faces)])


def test_a_path_that_only_touches_an_edge_is_looked_at_again():
    """A ray that grazes an edge counts two crossings; a nudge aside counts one or three, and the entry is the box's."""
    mesh = touched_by_an_edge()
    assert mesh.closed
    paths = skin_paths(skin_from_mesh(mesh), np.zeros(3), UP, 200.0)
    assert paths.path_length[0] == pytest.approx(20.0, abs=1e-5)
    assert np.isnan(paths.unknown_depth[0])


def test_crossings_that_add_up_are_not_asked_again(monkeypatch, box):
    """One look suffices where every ray leaves the body an odd number of times; an open skin is never asked twice."""
    module = importlib.import_module("puncture_twin.planning.geometry.containment")
    looks, plain = [], module.crossings
    monkeypatch.setattr(module, "crossings", lambda *a, **k: looks.append(1) or plain(*a, **k))
    mesh = box([100, 100, 100])
    skin_paths(skin_from_mesh(mesh), np.array([1.0, 2, 3]), np.array([[0.1, 0.2, 0.97]]), 200.0)
    assert len(looks) == 1
    skin_paths(skin_from_mesh(TriangleMesh(mesh.vertices, mesh.faces[:-1])), np.array([1.0, 2, 90]), UP, 200.0)
    assert len(looks) == 2


def test_crossings_that_never_add_up_are_unknown_from_the_target_on(box):
    """From a target outside a closed skin each path crosses an even number of times: nothing is known of it."""
    paths = skin_paths(skin_from_mesh(box([100, 100, 100])), np.array([0.0, 1, -80]), np.vstack([UP, -UP]), 200.0)
    np.testing.assert_array_equal(paths.unknown_depth, 0.0)
    opened = box([100, 100, 100])
    opened = TriangleMesh(opened.vertices, opened.faces[:-1])
    away = skin_paths(skin_from_mesh(opened), np.array([0.0, 1, -80]), -UP, 200.0)
    assert np.isnan([away.unknown_depth[0], away.path_length[0], away.skin_angle[0]]).all()


def test_through_a_corner_the_entry_is_the_corner():
    """Where four faces meet in the path there is one entry, and the angle is between the path and their mean normal."""
    paths = skin_paths(skin_from_mesh(pyramid()), np.zeros(3), UP, 200.0)
    np.testing.assert_allclose(paths.entry_ct, [[0, 0, 30]], atol=1e-4)
    assert np.isnan(paths.reentry_depth[0]) and np.isnan(paths.unknown_depth[0])


def three_boxes(box, top):
    """The body, and two plates above it: the first from z = 80 to 85, the second from ``top`` on."""
    plates = [box([30, 30, 5], (0, 0, z + 2.5)) for z in (80.0, top)]
    return skin_from_mesh(joined([box([100, 100, 100]), *plates]))


def test_reentry_is_the_second_crossing_and_counts_up_to_the_needles_top(box):
    """Of two plates over the skin the nearer is named; a plate at the needle's top exactly still counts, beyond not."""
    target = np.array([1.0, 2.0, 0.0])
    assert skin_paths(three_boxes(box, 120), target, UP, 200.0).reentry_depth[0] == pytest.approx(80)
    assert skin_paths(three_boxes(box, 120), target, UP, 80.0).reentry_depth[0] == pytest.approx(80)
    assert np.isnan(skin_paths(three_boxes(box, 120), target, UP, 79.9).reentry_depth[0])
    several = np.array([[0.0, 0, 1], [1, 0, 0], [0, 0, 1]])
    found = skin_paths(three_boxes(box, 120), target, several, 200.0)
    np.testing.assert_allclose(found.reentry_depth, [80, np.nan, 80])
    np.testing.assert_allclose(found.path_length, [50, 49, 50])
    np.testing.assert_allclose(found.entry_ct, [[1, 2, 50], [50, 2, 0], [1, 2, 50]])


def test_a_cut_face_is_no_entry_and_the_unknown_begins_there(box):
    """Through a face at which the body was cut there is no path length, no entry point and no angle."""
    mesh = box([100, 100, 100])
    top = np.all(mesh.triangles[:, :, 2] == 50, axis=1)
    paths = skin_paths(Skin(mesh, top, None, ()), np.array([1.0, 2, 0]), np.vstack([UP, -UP]), 200.0)
    np.testing.assert_allclose(paths.unknown_depth, [50, np.nan])
    np.testing.assert_allclose(paths.path_length, [np.nan, 50])
    assert np.isnan(paths.entry_ct[0]).all() and np.isnan(paths.skin_angle[0])
    np.testing.assert_allclose(paths.entry_ct[1], [1, 2, -50])


def tent(left, right):
    """An open roof with its ridge at z = 50 along y, 40 mm long, of two unlike slopes of these widths."""
    sides = [(0.0, 50), (-left, 20), (right, 50 - 0.2 * right)]
    vertices = np.array([[x, y, z] for x, z in sides for y in (-20, 20)])
    return TriangleMesh(vertices, np.array([[0, 1, 3], [0, 3, 2], [0, 4, 5], [0, 5, 1]]))


def sheet_of(mesh):
    """An open skin."""
    return Skin(mesh, np.zeros(len(mesh.faces), bool), None, ())


@pytest.mark.parametrize(("left", "right"), [(40.0, 40.0), (10.0, 90.0)])
def test_the_normal_at_a_point_is_blended_from_the_corners_by_their_nearness(left, right):
    """Across a smooth pair of slopes the angle follows the corners' normals, weighted by area and by where one is."""
    mesh = tent(left, right)
    a, b, c = mesh.triangles.swapaxes(0, 1)
    areas = np.cross(b - a, c - a)
    corner = np.zeros((6, 3))
    for face, area in zip(mesh.faces, areas, strict=True):
        corner[face] += area
    corner /= np.linalg.norm(corner, axis=1, keepdims=True)
    target, point = np.array([-3.0, 4.0, 0.0]), np.array([-left / 4, 5.0, 50.0 - 30 / 4])
    toward, face = (point - target) / np.linalg.norm(point - target), mesh.faces[0]
    normal = np.linalg.solve(mesh.vertices[face].T, point) @ corner[face]
    cosine = abs(normal @ toward) / np.linalg.norm(normal)
    found = skin_paths(sheet_of(mesh), target, toward[None], 200.0)
    np.testing.assert_allclose(found.entry_ct[0], point, atol=1e-9)
    assert found.skin_angle[0] == pytest.approx(np.arccos(cosine), abs=1e-9)


def test_a_second_sheet_is_a_reentry_also_where_crossings_are_even():
    """Of an open skin nothing must add up: the second of two sheets over the target is met again."""
    upper = TriangleMesh(tent(40.0, 40.0).vertices + [0, 0, 25.0], tent(40.0, 40.0).faces)
    found = skin_paths(sheet_of(joined([tent(40.0, 40.0), upper])), np.zeros(3), UP, 200.0)
    assert (found.path_length[0], found.reentry_depth[0]) == (50, 75)


def test_a_corner_whose_faces_cancel_has_no_say():
    """Where faces of opposite winding meet and their areas cancel, the other corners' normals decide."""
    flat = np.array([[0.0, 0, 50], [30, 0, 50], [0, 30, 50], [-30, 0, 50], [0, -30, 50]])
    sheet = TriangleMesh(flat, np.array([[0, 1, 2], [0, 4, 3]]))
    found = skin_paths(sheet_of(sheet), np.zeros(3), np.array([[0.1, 0.1, 0.99]]), 200.0)
    assert found.skin_angle[0] == pytest.approx(np.arccos(0.99), abs=1e-9)


def test_the_angle_does_not_depend_on_how_fine_the_skin_is():
    """A skin of triangles far smaller than a square millimetre is a skin."""
    angles = []
    for scale in (1.0, 0.01):
        mesh = TriangleMesh(scale * tent(10.0, 90.0).vertices, tent(10.0, 90.0).faces)
        angles.append(skin_paths(sheet_of(mesh), np.zeros(3), UP, 200.0).skin_angle[0])
    assert angles[0] > 0.1
    assert angles[1] == pytest.approx(angles[0], abs=1e-9)


def test_straight_in_is_an_angle_of_zero_at_any_tilt(rng):
    """A cosine that rounding makes a little more than one is an angle of zero, not of nothing."""
    for _ in range(60):
        R = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        corners = np.array([[-9.0, -9, 30], [9, -9, 30], [0, 9, 30]]) @ R.T
        sheet = sheet_of(TriangleMesh(corners, np.array([[0, 1, 2]])))
        found = skin_paths(sheet, np.zeros(3), R[:, 2][None], 200.0)
        assert found.skin_angle[0] == pytest.approx(0, abs=1e-6)
