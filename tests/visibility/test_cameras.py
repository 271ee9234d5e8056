"""What two cameras see: lines of sight against closed forms and another ray caster, and the embedded abdomen."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from refusals import refused

from puncture_twin.planning.arm.kinematics import link_poses
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.case.case import bed_frame
from puncture_twin.planning.collision.bodies import arm_bodies
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import apply, frame_about, inverse, pose
from puncture_twin.planning.visibility import cameras as cameras_module
from puncture_twin.planning.visibility.cameras import (
    BALL_MM,
    BASELINE_MM,
    CAMERA_MM,
    DISTANCE_MM,
    LOWEST,
    camera_view,
    candidate_pairs,
    hidden_by,
)

OBLIQUE_DEG = 42.0
"""From behind, past the wrist, which hides a side of the ball around the holder, but not its middle."""

LEFT_AND_RIGHT = np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
MIRROR = np.diag([-1.0, 1.0, 1.0])


@pytest.fixture(scope="module")
def view(abdomen):
    return camera_view(*abdomen)


def segment_box(start, ends, half):
    """Whether segments from a point (3,) to points (n, 3) pass through a box about the origin: slabs."""
    with np.errstate(divide="ignore"):
        a, b = (-half - start) / (ends - start), (half - start) / (ends - start)
    return np.minimum(a, b).max(axis=1).clip(0.0) <= np.maximum(a, b).min(axis=1).clip(None, 1.0)


def test_a_point_is_seen_over_the_horizon_of_a_sphere(ball, rng):
    """From h over a sphere of R a line is free where it starts less than acos(R / (R + h)) + 90° from straight up."""
    mesh = ball(radius=100.0, subdivisions=5)
    for high in (2.0, 10.0, 40.0):
        ways = rng.normal(size=(400, 3))
        ways /= np.linalg.norm(ways, axis=1)[:, None]
        dip = np.arccos(100.0 / (100.0 + high))
        off = np.arccos(ways[:, 2]) - (np.pi / 2 + dip)
        clear = np.abs(off) > 0.02  # the mesh lies within the sphere, by .1 mm at most
        point = np.array([0.0, 0.0, 100.0 + high])
        hidden = hidden_by([("skin", mesh)], point[None], point + 900.0 * ways) == "skin"
        assert clear.sum() > 350
        np.testing.assert_array_equal(hidden[clear], off[clear] > 0.0)


def test_a_camera_behind_a_box_is_blind_and_the_box_is_named(rng):
    """As the slabs of either box say; the first of the list is named."""
    half = np.array([50.0, 80.0, 20.0])
    shift = np.array([0.0, 0.0, 130.0])
    surfaces = [("table", box(np.eye(4), 2 * half)), ("screen", box(pose(np.eye(3), shift), 2 * half))]
    point = np.array([3.0, 5.0, 60.0])
    cameras = rng.uniform(-400.0, 400.0, (600, 3))
    table = segment_box(point, cameras, half)
    screen = segment_box(point - shift, cameras - shift, half)
    expected = np.where(table, "table", np.where(screen, "screen", ""))
    assert min((expected == name).sum() for name in ("table", "screen", "")) > 50
    np.testing.assert_array_equal(hidden_by(surfaces, point[None], cameras), expected)


def test_what_lies_behind_the_camera_or_next_to_a_marker_hides_nothing():
    """A wall beyond the camera, and a skin within the error of its reading."""
    wall = [("wall", box(pose(np.eye(3), [0.0, 0.0, 200.0]), (400.0, 400.0, 2.0)))]
    point = np.zeros((1, 3))
    assert hidden_by(wall, point, np.array([[0.0, 0.0, 190.0], [0.0, 0.0, 210.0]])).tolist() == ["", "wall"]
    skin = [("patient", box(pose(np.eye(3), [0.0, 0.0, -98.0]), (400.0, 400.0, 200.0)))]  # 2 mm over the point
    up_and_down = np.array([[0.0, 0.0, 900.0], [0.0, 0.0, -900.0]])
    assert hidden_by(skin, point, up_and_down, 5.0).tolist() == ["", "patient"]
    assert hidden_by(skin, point, up_and_down).tolist() == ["patient", "patient"]
    assert hidden_by(wall, point, np.concatenate([point, up_and_down])).tolist() == ["", "wall", ""]


def test_all_points_of_a_ball_must_be_seen():
    surfaces = [("box", box(pose(np.eye(3), [0.0, 13.0, 50.0]), (20.0, 20.0, 20.0)))]  # from y = 3 on
    camera = np.array([[0.0, 0.0, 1e6]])
    middle, side = np.zeros((1, 3)), np.array([[0.0, BALL_MM, 0.0]])
    assert hidden_by(surfaces, middle, camera)[0] == "" and hidden_by(surfaces, side, camera)[0] == "box"
    assert hidden_by(surfaces, np.concatenate([middle, side]), camera)[0] == "box"


def test_a_mirrored_scene_hides_the_same(ball, rng):
    mesh = ball(radius=60.0, center=(30.0, 10.0, 0.0))
    mirrored = TriangleMesh(mesh.vertices @ MIRROR, mesh.faces[:, ::-1].copy())
    points, cameras = np.array([[100.0, 0.0, 5.0], [110.0, 0.0, 5.0]]), rng.uniform(-900.0, 900.0, (300, 3))
    names = hidden_by([("skin", mesh)], points, cameras)
    assert 20 < (names == "skin").sum() < 280
    np.testing.assert_array_equal(names, hidden_by([("skin", mirrored)], points @ MIRROR, cameras @ MIRROR))


def test_proposed_pairs_stand_as_stated():
    """A meter from the target, half a meter apart, over the bed; about x and y they are their own mirror image."""
    T_ct_bed = pose([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [-1.0, 0.0, 0.0]], [10.0, 20.0, 30.0])
    pairs, middles = candidate_pairs(T_ct_bed)
    bed = apply(inverse(T_ct_bed), pairs)
    assert len(pairs) > 300
    assert np.linalg.norm(bed, axis=2) == pytest.approx(DISTANCE_MM)
    assert np.linalg.norm(bed[:, 0] - bed[:, 1], axis=1) == pytest.approx(BASELINE_MM)
    assert bed[:, :, 2].min() >= DISTANCE_MM * np.sin(LOWEST) - 1e-6
    middle = bed.mean(axis=1)
    assert middle / np.linalg.norm(middle, axis=1)[:, None] == pytest.approx(middles @ T_ct_bed[:3, :3])
    whole = {tuple(sorted(map(tuple, pair.round(3).tolist()))) for pair in bed}
    for side in (0, 1):
        flipped = bed * np.where(np.arange(3) == side, -1.0, 1.0)
        assert {tuple(sorted(map(tuple, pair.round(3).tolist()))) for pair in flipped} == whole


def arm_in_ct(plan, tool, row):
    """The arm's convex pieces by body, but the needle's, as trimesh has hulls, CT frame."""
    poses = inverse(plan.T_base_ct) @ link_poses(plan.model, plan.insertion.q[row])
    for body in arm_bodies(plan.model, tool, 0.0)[:-1]:
        T = poses[body.frame] @ body.T_frame_body
        yield body.name, [trimesh.convex.convex_hull(apply(T, corners)) for corners in body.bare.hulls]


def test_the_abdomen_against_another_ray_caster(abdomen, view, rng):
    """Balls and markers from stated cameras, at the standoff and at the end, as trimesh's rays say."""
    context, plan = abdomen
    anatomy, tool = context.anatomy, context.reach.checker.tool
    still = [
        trimesh.Trimesh(one.vertices, one.faces) for one in (anatomy.skin.mesh, *(s.mesh for s in anatomy.surroundings))
    ]
    c, s = np.cos(np.radians(OBLIQUE_DEG)), np.sin(np.radians(OBLIQUE_DEG))
    oblique = c * plan.outward_ct + s * frame_about(plan.outward_ct)[:, :2].T
    places = plan.target_ct + 900.0 * np.concatenate([[[0.2, -0.9, 0.4], [-0.3, -0.25, 0.92]], oblique])
    places[2:] += 160.0 * plan.outward_ct
    markers = context.placement.registration.markers.points_ct
    seen, agreed = 0, 0
    for pair, row, step in ((places[:2], 0, 0), (places[2:], len(plan.insertion.q) - 1, -1)):
        stereo = replace(context.case.stereo, cameras_ct=pair, balls_mm=(80.0, 140.0, 160.0))
        answer = camera_view(replace(context, case=replace(context.case, stereo=stereo)), plan)
        assert not answer.proposed and (answer.cameras_ct == pair).all()
        pieces = dict(arm_in_ct(plan, tool, row))
        tip = plan.target_ct + (plan.standoff_mm if row == 0 else 0.0) * plan.outward_ct
        about = np.concatenate([np.zeros((1, 3)), np.eye(3), -np.eye(3)])
        balls = ((80.0, BALL_MM, ()), (140.0, BALL_MM, ()), (160.0, BALL_MM + 15.0, ("holder",)))
        things = [(tip + mm * plan.outward_ct + radius * about, 0.0, but) for mm, radius, but in balls]
        things += [(marker[None], 5.0, ()) for marker in markers]
        for column, (points, near, but) in enumerate(things):
            solids = [*still, *(piece for name in pieces if name not in but for piece in pieces[name])]
            hidden = any(blocked(solid, points, camera, near) for camera in pair for solid in solids)
            assert hidden == (not answer.seen[step, column]), (step, answer.names[column])
            agreed += 1
            seen += not hidden
    assert 0.2 * agreed < seen < 0.9 * agreed


def blocked(solid, points, camera, near):
    """Whether trimesh finds a hit on the lines from points to a camera."""
    ways = camera - points
    far = np.linalg.norm(ways, axis=1)
    at, ray, _ = solid.ray.intersects_location(points, ways / far[:, None])
    depth = np.linalg.norm(at - points[ray], axis=1)
    return bool(((depth >= near) & (depth <= far[ray])).any())


def test_proposed_cameras_see_the_needle_of_the_abdomen(abdomen, view):
    """During the whole insertion, with markers; nothing comes near them."""
    context, plan = abdomen
    assert view.proposed and view.clear and view.lost_mm is None and view.seen[:, :2].all()
    assert view.seen[:, 2:].all(axis=0).sum() >= 3
    assert view.names[:3] == ("ball 80 mm", "ball 160 mm", "marker M1") and view.balls == 2
    assert view.tip_to_target_mm[[0, -1]] == pytest.approx([plan.standoff_mm, 0.0], abs=1e-6)
    assert np.linalg.norm(view.cameras_ct - plan.target_ct, axis=1) == pytest.approx(DISTANCE_MM)
    assert (apply(inverse(bed_frame(context.case)), view.cameras_ct)[:, 2] >= DISTANCE_MM * np.sin(LOWEST) - 1e-6).all()
    for mesh in (context.anatomy.skin.mesh, *(one.mesh for one in context.anatomy.surroundings)):
        near = trimesh.proximity.closest_point_naive(trimesh.Trimesh(mesh.vertices, mesh.faces), view.cameras_ct)[1]
        assert near.min() >= CAMERA_MM - 1e-6


def test_a_ball_in_the_body_is_lost_where_its_way_ends(stated):
    """50 mm behind the tip, it is hidden by the patient as soon as its near side is deeper than the skin."""
    context, plan = stated("stereo", balls_mm=(50.0,))
    deep = np.linalg.norm(plan.entry_ct - plan.target_ct)
    view = camera_view(context, plan)
    inside = view.tip_to_target_mm + 50.0 - BALL_MM < deep
    assert inside[-1] and not inside[0]
    assert all(row[0] == "patient" for row, deeper in zip(view.hidden, inside, strict=True) if deeper)
    assert view.lost_mm == view.tip_to_target_mm[inside].max() and "patient" in view.sentence


def test_a_ball_in_the_body_is_lost_though_the_skin_is_open_there(stated):
    """Without the skin about the entry a camera over it looks into the body, and still sees no ball there."""
    context, plan = stated("stereo", balls_mm=(30.0,), cameras_ct=LEFT_AND_RIGHT + [-700.0, -700.0, 50.0])
    skin = context.anatomy.skin
    kept = np.linalg.norm(skin.mesh.triangles.mean(axis=1) - plan.entry_ct, axis=1) > 80.0
    mesh = TriangleMesh(skin.mesh.vertices, skin.mesh.faces[kept])
    opened = replace(context.anatomy, skin=replace(skin, mesh=mesh, cut_faces=skin.cut_faces[kept]))
    view = camera_view(replace(context, anatomy=opened), plan)
    inside = view.tip_to_target_mm + 30.0 - BALL_MM < np.linalg.norm(plan.entry_ct - plan.target_ct)
    assert not mesh.closed and inside[-1] and [row[0] == "patient" for row in view.hidden] == inside.tolist()


def test_the_arm_that_hides_a_ball_is_named(stated, abdomen):
    """From behind the wrist, along the needle, the wrist hides what is in front of it."""
    _, plan = abdomen
    behind = plan.target_ct + 1500.0 * plan.outward_ct
    context, plan = stated("stereo", cameras_ct=np.stack([behind, behind + [5.0, 0.0, 0.0]]))
    view = camera_view(context, plan)
    assert {row[0] for row in view.hidden} <= {"wrist_3", "wrist_2", "wrist_1", "forearm", "holder"}
    assert view.lost_mm == view.tip_to_target_mm[0] and not view.seen[:, :2].any()
    assert view.clear and "nearer" not in view.sentence
    assert any(name not in ("", "patient") for row in view.hidden for name in row[2:])  # of markers


def test_a_stated_camera_in_the_way_of_the_arm_is_named(stated, abdomen):
    """Where the wrist will be at the end, and where it is at the standoff; one in the patient is refused."""
    _, plan = abdomen
    away = plan.target_ct + [0.0, -1200.0, 0.0]
    wrist = plan.target_ct + (plan.needle_length_mm + 30.0) * plan.outward_ct
    for place in (wrist, wrist + plan.standoff_mm * plan.outward_ct):
        view = camera_view(*stated("stereo", cameras_ct=np.stack([away, place])))
        assert not view.clear and "nearer than" in view.sentence
    context, _ = abdomen
    front = context.anatomy.skin.mesh.vertices[np.argmin(context.anatomy.skin.mesh.vertices[:, 1])]
    assert not camera_view(*stated("stereo", cameras_ct=np.stack([away, front - [0.0, CAMERA_MM / 2, 0.0]]))).clear
    with refused("camera_in_patient", "cameras_mm"):
        camera_view(*stated("stereo", cameras_ct=np.stack([away, plan.target_ct])))


def test_without_cameras_or_a_place_for_them_it_is_refused(stated, monkeypatch):
    """The table is named; a place is none where a camera would be in the way everywhere."""
    with refused("no_stereo", "[stereo]"):
        camera_view(*stated("stereo"))
    monkeypatch.setattr(cameras_module, "CAMERA_MM", 1e4)
    monkeypatch.setattr(cameras_module, "AZIMUTHS", 4)
    with pytest.raises(NoAnswerError) as caught:
        camera_view(*stated("stereo", balls_mm=(160.0,)))
    assert caught.value.code == "no_camera_place" and caught.value.counts["pairs"] > 30
