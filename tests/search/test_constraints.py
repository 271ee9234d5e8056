"""Each reason, in a scene where geometry knows the answer."""

import numpy as np
import pytest

from puncture_twin.planning.anatomy.anatomy import Anatomy
from puncture_twin.planning.anatomy.body.cut_ends import FieldOfView
from puncture_twin.planning.anatomy.skin import Skin, skin_from_mesh, skin_paths
from puncture_twin.planning.anatomy.structure import Role, Structure
from puncture_twin.planning.anatomy.unseen import beyond_image
from puncture_twin.planning.base.reasons import Reason
from puncture_twin.planning.case.settings import Needle
from puncture_twin.planning.clearance.engine import measure_clearances
from puncture_twin.planning.clearance.fcl_engine import FclEngine
from puncture_twin.planning.geometry.mesh import TriangleMesh
from puncture_twin.planning.search.constraints import first_broken

NEEDLE = Needle(200.0, 150.0, 1.0, None, 10.0, 30.0)
UP = np.array([[0.0, 0.0, 1.0]])


def verdict(skin, structures=(), direction=UP, needle=NEEDLE):
    target = np.zeros(3)
    direction = np.asarray(direction, float).reshape(-1, 3)
    paths = skin_paths(skin, target, direction, needle.length_mm)
    engine = FclEngine([s.mesh for s in structures])
    found = measure_clearances(engine, structures, target, direction, length=needle.length_mm, radius=needle.radius_mm)
    rated = first_broken(paths, found, structures, needle=needle, max_skin_angle=np.radians(60.0))
    return str(rated.reason[0]), str(rated.structure[0]), rated.depth[0], rated.amount[0]


def both(*meshes):
    offsets = np.cumsum([0, *(len(m.vertices) for m in meshes[:-1])])
    return TriangleMesh(
        np.concatenate([m.vertices for m in meshes]),
        np.concatenate([m.faces + o for m, o in zip(meshes, offsets, strict=True)]),
    )


def test_path_length_and_angle_are_geometry(box):
    assert verdict(skin_from_mesh(box([100, 100, 100])))[0] == ""
    skin = skin_from_mesh(box([400, 400, 100]))
    tilt = np.radians(np.array([0.0, 20, 45]))
    directions = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
    paths = skin_paths(skin, np.zeros(3), directions, 200.0)
    np.testing.assert_allclose(paths.path_length, 50 / np.cos(tilt), atol=1e-9)
    np.testing.assert_allclose(paths.entry_ct[:, 2], 50, atol=1e-9)
    needle = Needle(200.0, 150.0, 1.0, 60.0, 10.0, 30.0)
    assert needle.longest_path_mm == 50
    assert verdict(skin_from_mesh(box([100, 100, 99])), needle=needle)[0] == ""
    assert verdict(skin_from_mesh(box([100, 100, 101])), needle=needle)[0] == Reason.TOO_LONG


def test_skin_angle_on_a_ball(ball):
    """From the centre of a ball every path meets the skin straight on; off centre, as the sine law says."""
    skin = skin_from_mesh(ball(100, subdivisions=5))
    directions = np.array([[0, 0, 1.0], [1, 0, 0]])
    centred = skin_paths(skin, np.zeros(3), directions, 300.0)
    np.testing.assert_allclose(np.degrees(centred.skin_angle), 0, atol=0.5)
    shifted = skin_paths(skin, np.array([0, 0, 60.0]), np.array([[1.0, 0, 0]]), 300.0)
    assert np.degrees(shifted.skin_angle[0]) == pytest.approx(np.degrees(np.arcsin(0.6)), abs=0.5)


@pytest.mark.parametrize("welded", [True, False])
def test_skin_angle_does_not_blend_over_an_edge(box, welded):
    """On a box the angle is to the face that is crossed, however the file stores its corners."""
    mesh = box([200, 200, 100])
    if not welded:
        mesh = TriangleMesh(mesh.triangles.reshape(-1, 3), np.arange(36).reshape(-1, 3))
    tilt = np.radians(np.array([5.0, 20, 40, 55]))
    for around in np.radians([0, 36, 45, 80]):
        directions = np.stack([np.sin(tilt) * np.cos(around), np.sin(tilt) * np.sin(around), np.cos(tilt)], axis=1)
        paths = skin_paths(skin_from_mesh(mesh), np.zeros(3), directions, 300.0)
        np.testing.assert_allclose(paths.skin_angle, tilt, atol=1e-9)


def test_a_smooth_skin_is_blended_even_without_shared_corners(ball):
    """A sphere stored triangle by triangle gives the same angles as a welded one."""
    mesh = ball(100, subdivisions=3)
    loose = TriangleMesh(mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3))
    directions = np.array([[1.0, 0, 0], [0.6, 0, 0.8], [0.36, 0.48, 0.8]])
    angles = [
        skin_paths(skin_from_mesh(m), np.array([0, 0, 60.0]), directions, 300.0).skin_angle for m in (mesh, loose)
    ]
    np.testing.assert_allclose(angles[0], angles[1], atol=1e-9)


def test_a_doubled_open_skin_stays_open(ball):
    mesh = ball(100)
    half = mesh.faces[mesh.triangles[:, :, 2].min(axis=1) > 0]
    doubled = skin_from_mesh(TriangleMesh(mesh.vertices, np.concatenate([half, half])))
    assert not doubled.mesh.closed
    assert doubled.warnings
    whole = TriangleMesh(mesh.vertices, np.concatenate([mesh.faces, mesh.faces]))
    assert whole.closed


def test_reenters_skin(ball):
    """A second body part within the needle's length is named with its depth; beyond it, it is not the needle's."""
    arm = both(ball(50, subdivisions=4), ball(20, (0, 0, 120), 4))
    reason, _, depth, _ = verdict(skin_from_mesh(arm))
    assert (reason, depth) == (Reason.REENTERS_SKIN, pytest.approx(100, abs=0.2))
    far = both(ball(50), ball(20, (0, 0, 240)))
    assert verdict(skin_from_mesh(far))[0] == ""


def test_margins_and_roles_decide_the_reason(ball, box):
    near = Structure("vessel", Role.AVOID, 5.0, ball(10, (14, 0, 30), 4), "")
    other = Structure("rib", Role.AVOID, 1.0, ball(10, (-11, 0, 40), 4), "")
    reason, structure, depth, amount = verdict(skin_from_mesh(box([100, 100, 100])), (other, near))
    assert (reason, structure) == (Reason.TOO_CLOSE, "vessel")
    assert depth == pytest.approx(30, abs=0.5)
    assert amount == pytest.approx(14 - 10 - 0.5, abs=0.05)
    for margin, expected in ((3.4, ""), (3.6, Reason.TOO_CLOSE)):
        structure = Structure("organ", Role.AVOID, margin, ball(10, (14, 0, 30), 6), "")
        assert verdict(skin_from_mesh(box([100, 100, 100])), (structure,))[0] == expected
    cloud = Structure("fog", Role.UNKNOWN, 0.0, ball(10, (0, 0, 30)), "")
    assert verdict(skin_from_mesh(box([100, 100, 100])), (cloud,))[:2] == (Reason.UNKNOWN_REGION, "fog")
    anatomy = Anatomy((Structure("liver", Role.TARGET, 0, ball(10), ""),), skin_from_mesh(box([100, 100, 100])), ())
    assert anatomy.structure("liver").role is Role.TARGET
    with pytest.raises(Exception, match="no structure 'lver'.*liver"):
        anatomy.structure("lver")


def cut_skin(box, cut_high_z):
    mesh = box([100, 100, 100])
    top = np.all(mesh.triangles[:, :, 2] == 50, axis=1)
    T = np.eye(4)
    T[:3, 3] = [-80, -80, -80]
    cut = np.zeros((3, 2), bool)
    cut[2, 1] = cut_high_z
    field = FieldOfView(T, np.array([160.0, 160, 130]), cut)
    return Skin(mesh, top if cut_high_z else np.zeros(len(top), bool), field, ())


def test_what_leaves_through_a_cut_or_a_hole_is_unknown(box):
    assert verdict(cut_skin(box, True))[0] == Reason.UNKNOWN_REGION
    assert verdict(cut_skin(box, True))[2] == pytest.approx(50)
    assert verdict(cut_skin(box, False))[0] == ""
    flat = np.array([0.7, 0, 0.5])
    flat /= np.linalg.norm(flat)
    skin = cut_skin(box, True)
    for wider, expected in ((np.inf, Reason.UNKNOWN_REGION), (10.0, "")):  # it passes 20 mm beside the body
        solid = beyond_image(skin.field_of_view, skin.mesh.vertices, wider)
        unseen = Structure("beyond", Role.UNKNOWN, 0.0, solid, "")
        reason, _, depth, _ = verdict(skin, (unseen,), direction=flat)
        assert reason == expected
        assert reason == "" or depth == pytest.approx(50 / flat[2])
    mesh = box([100, 100, 100])
    top = np.all(mesh.triangles[:, :, 2] == 50, axis=1)
    opened = skin_from_mesh(TriangleMesh(mesh.vertices, mesh.faces[~top]))
    assert opened.warnings
    assert verdict(opened)[0] == Reason.NO_SKIN_ENTRY
    assert verdict(opened, direction=[0, 0, -1])[0] == ""


def test_a_ray_through_a_corner_is_judged_like_its_neighbours(box):
    skin = skin_from_mesh(box([100, 100, 100]))
    for direction in ([1, 1, 1], [1, 0, 1], [1, 1, 0.5]):
        u = np.array(direction, float) / np.linalg.norm(direction)
        paths = skin_paths(skin, np.zeros(3), u[None], 200.0)
        assert np.isfinite(paths.path_length[0])
        assert np.isnan(paths.reentry_depth[0])
        assert np.isnan(paths.unknown_depth[0])


def test_a_skin_mesh_may_say_where_the_body_was_cut(box):
    """With the head side declared cut, the box's top (+z) is no skin."""
    skin = skin_from_mesh(box([100, 100, 100]), ["head"])
    assert skin.cut_faces.sum() == 2
    assert skin.field_of_view.cut.tolist() == [[False, False], [False, False], [False, True]]
    assert verdict(skin)[0] == Reason.UNKNOWN_REGION
    assert verdict(skin, direction=[1, 0, 0])[0] == ""
    with pytest.raises(Exception, match="no flat end at side left"):
        ball_like = box([100, 100, 100]).transformed(TURNED)
        skin_from_mesh(ball_like, ["left"])


TURNED = np.array([[0.6, -0.8, 0, 0], [0.8, 0.6, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
