"""Where the probe goes: footprints and acoustic windows of simple bodies in closed form, and the embedded abdomen."""

from dataclasses import replace
from types import SimpleNamespace

import fcl
import numpy as np
import pytest
import trimesh
from refusals import refused

from puncture_twin.planning.anatomy.anatomy import UNNAMED_DENSE, UNNAMED_GAS
from puncture_twin.planning.anatomy.skin import skin_from_mesh
from puncture_twin.planning.anatomy.structure import Role
from puncture_twin.planning.anatomy.unseen import BEYOND_LABELS
from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.case.settings import Obstacle
from puncture_twin.planning.collision.bodies import arm_bodies
from puncture_twin.planning.collision.two_arms import handle_tool
from puncture_twin.planning.geometry.mesh import TriangleMesh, box
from puncture_twin.planning.geometry.rigid import apply, inverse, pose
from puncture_twin.planning.visibility.probe import (
    ASIDE,
    BASES_APART_MM,
    CLEARANCE_MM,
    HANDLE_MM,
    HEAD_MM,
    LENGTH_MM,
    TILT,
    Ruled,
    footprints,
    opaque,
    passing,
    probe_mount,
    probe_view,
)

UP = np.array([0.0, 0.0, 1.0])
MIRROR = np.diag([-1.0, 1.0, 1.0])
ORDER = list(Ruled)


@pytest.fixture(scope="module")
def body(ball):
    """The skin of a ball of 100 mm about the origin."""
    return skin_from_mesh(ball(radius=100.0, subdivisions=5))


@pytest.fixture(scope="module")
def view(abdomen):
    return probe_view(*abdomen)


def ruled_by(feet, why):
    return feet.ruled == ORDER.index(why)


def test_footprints_of_a_ball_look_at_its_middle_in_the_needle_plane(body):
    """Depth R; x, y, z right-handed, y to the target, z square to the needle, x toward it: closed form."""
    outward = np.array([0.6, 0.0, 0.8])
    feet = footprints(body, np.zeros(3), outward, 150.0)
    R, face = feet.T_ct_image[:, :3, :3], feet.T_ct_image[:, :3, 3]
    assert (feet.ruled == -1).all() and len(feet.ruled) == 24 * len(ASIDE)
    assert feet.depth == pytest.approx(100.0, abs=0.1) and np.linalg.det(R) == pytest.approx(1.0)
    assert face == pytest.approx(-100.0 * R[:, :, 1], abs=0.2)
    assert R[:, :, 2] @ outward == pytest.approx(0.0, abs=1e-9)
    angle = np.arccos(-R[:, :, 1] @ outward)
    assert np.unique(angle.round(9)) == pytest.approx(ASIDE)
    assert R[:, :, 0] @ outward == pytest.approx(np.sin(angle))


def test_what_is_too_deep_or_too_tilted_is_ruled_out(body):
    """From h beside the middle the skin is sqrt(R² - h² sin²) - h cos away; its normal leans by asin(h sin / R)."""
    high = 60.0
    feet = footprints(body, np.array([0.0, 0.0, high]), UP, 60.0)
    a = np.arccos(-feet.T_ct_image[:, :3, 1] @ UP)
    depth, tilt = np.sqrt(100.0**2 - (high * np.sin(a)) ** 2) - high * np.cos(a), np.arcsin(high * np.sin(a) / 100.0)
    deep, leans = depth > 60.0, tilt > TILT
    clear = (np.abs(depth - 60.0) > 0.5) & (np.abs(tilt - TILT) > 0.02)
    assert 0 < deep.sum() < len(deep) and (leans & ~deep).any() and (~leans & ~deep).any()
    np.testing.assert_array_equal(ruled_by(feet, Ruled.TOO_DEEP)[clear], deep[clear])
    np.testing.assert_array_equal(ruled_by(feet, Ruled.TILTED)[clear], (leans & ~deep)[clear])
    nearest_first = feet.depth[feet.left]
    assert (np.diff(nearest_first.round(6)) >= 0.0).all() and np.ptp(nearest_first) > 5.0


def test_where_the_image_cuts_the_body_there_is_no_skin(box):
    """Through the flat end of a block that a scan has cut no footprint lies."""
    skin = skin_from_mesh(box((200.0, 200.0, 200.0)), cut=("head",))
    feet = footprints(skin, np.zeros(3), np.array([1.0, 0.0, 0.0]), 400.0)
    face = -feet.T_ct_image[:, :3, 1]
    through_head = face[:, 2] > np.abs(face[:, :2]).max(axis=1) + 1e-6
    assert through_head.any()
    np.testing.assert_array_equal(ruled_by(feet, Ruled.NO_SKIN)[through_head], True)
    assert not ruled_by(feet, Ruled.NO_SKIN)[face[:, 2] < -1e-6].any()


def bars(gap_mm, height_mm=60.0, wide_mm=60.0):
    """Two long bars along x over the origin, with a gap between them along y."""
    place = (gap_mm + wide_mm) / 2.0
    return [box(pose(np.eye(3), [0.0, side * place, height_mm]), (400.0, wide_mm, 4.0)) for side in (-1.0, 1.0)]


def test_a_rib_cage_is_open_exactly_where_the_sector_fits_between_two_bars(body):
    """The sector of a face of 2 w at depth R has, at a height, a width of its own: it must lie within the gap."""
    gap, width = 24.0, 40.0
    feet = footprints(body, np.zeros(3), UP, 150.0)
    passing(feet, {Ruled.BONE: bars(gap)}, None, width)
    R, face = feet.T_ct_image[:, :3, :3], feet.T_ct_image[:, :3, 3]
    ends = face[:, None] + np.array([-0.5, 0.5])[:, None] * width * R[:, None, :, 0]  # of the face
    free, clear = np.ones(len(face), bool), np.ones(len(face), bool)
    for low in (58.0, 62.0):  # a bar is met where the sector crosses its heights
        with np.errstate(divide="ignore", invalid="ignore"):
            across = ends[:, :, 1] * (low / ends[:, :, 2])
        met = (ends[:, :, 2] > low).all(axis=1)
        reach = np.abs(across).max(axis=1)
        free &= ~met | (reach < gap / 2.0)
        clear &= (ends[:, :, 2].min(axis=1) > 70.0) & ((np.abs(reach - gap / 2.0) > 0.5) & (reach < 70.0))
    assert free[clear].any() and (~free[clear]).any() and clear.sum() > 50
    np.testing.assert_array_equal((feet.ruled == -1)[clear], free[clear])
    np.testing.assert_array_equal(ruled_by(feet, Ruled.BONE)[clear], ~free[clear])


def test_a_wall_of_bone_or_air_leaves_no_window(body, ball):
    """A shell about the target, or a target within: nothing passes; bone is named where both are in the way."""
    shell, far = ball(radius=50.0), ball(radius=5.0, center=(0.0, 0.0, -90.0))
    for why in (Ruled.BONE, Ruled.AIR, Ruled.UNKNOWN):
        feet = footprints(body, np.zeros(3), UP, 150.0)
        passing(feet, {why: [far, shell]}, None, 40.0)
        assert feet.counts == {str(why): len(feet.ruled)}
    feet = footprints(body, np.zeros(3), UP, 150.0)
    passing(feet, {Ruled.AIR: [shell], Ruled.BONE: [shell]}, None, 40.0)
    assert feet.counts == {"bone": len(feet.ruled)}


def test_air_in_the_ct_closes_the_window_that_names_leave_open(body):
    """Gas in a half-space of the image: the footprints whose sector enters it more than the rim deep are ruled out."""
    scan = SimpleNamespace(hu_at=lambda points: np.where(points[:, 0] > 30.0, -950.0, 40.0))
    feet = footprints(body, np.zeros(3), UP, 150.0)
    passing(feet, {}, scan, 20.0)
    ends = feet.T_ct_image[:, None, :3, 3] + np.array([-10.0, 10.0])[:, None] * feet.T_ct_image[:, None, :3, 0]
    most = ends[:, :, 0].max(axis=1)
    assert ruled_by(feet, Ruled.AIR)[most > 36.0].all() and not ruled_by(feet, Ruled.AIR)[most < 30.0].any()
    assert (most > 36.0).any() and (most < 30.0).any()
    around = SimpleNamespace(hu_at=lambda points: np.where(np.linalg.norm(points, axis=1) > 98.5, -950.0, 40.0))
    feet = footprints(body, np.zeros(3), UP, 150.0)
    passing(feet, {}, around, 60.0)  # the face's ends are 4 mm outside of the body
    assert feet.counts == {"free": len(feet.ruled)}


def test_names_decide_what_sound_passes():
    """Not bone and implants, not lungs, the bowel where no CT says where its gas is; nor what nobody knows."""

    def named(*names, scan=None, role=Role.AVOID):
        structures = [SimpleNamespace(name=name, mesh=name, role=role) for name in names]
        return opaque(SimpleNamespace(structures=structures, scan=scan), "abdomen")

    bone = ["rib_left_7", "vertebrae_L2", "sternum", "hip_right", "stent", UNNAMED_DENSE]
    air = ["lung_upper_lobe_left", "trachea", "free_air", "Bowel Gas", UNNAMED_GAS]
    soft = ("liver", "aorta", "lesion", "bone_metastasis_lesion", "kidney_left", "something")
    found = named(*bone, *air, *soft, "colon", "small_bowel")
    assert found == {Ruled.UNKNOWN: [], Ruled.AIR: [*air, "colon", "small_bowel"], Ruled.BONE: bone}
    assert list(found) == [Ruled.UNKNOWN, Ruled.AIR, Ruled.BONE]
    assert named(*air, "colon", scan="a CT")[Ruled.AIR] == air
    assert named(BEYOND_LABELS, "liver", role=Role.UNKNOWN)[Ruled.UNKNOWN] == [BEYOND_LABELS, "liver"]


def test_a_mirrored_body_has_mirrored_windows(body, ball):
    """The same footprints pass, at mirrored places with mirrored planes."""
    mesh = ball(radius=100.0, subdivisions=4, center=(5.0, 0.0, 0.0))
    rib = box(pose(np.eye(3), [40.0, 10.0, 50.0]), (30.0, 80.0, 10.0))
    target, outward = np.array([10.0, 20.0, 5.0]), np.array([0.36, 0.48, 0.8])

    def window(surface, bone, at, way):
        feet = footprints(skin_from_mesh(surface), at, way, 150.0)
        passing(feet, {Ruled.BONE: [bone]}, None, 40.0)
        return feet

    def mirrored(one):
        return TriangleMesh(one.vertices @ MIRROR, one.faces[:, ::-1].copy())

    first, other = (
        window(mesh, rib, target, outward),
        window(mirrored(mesh), mirrored(rib), MIRROR @ target, MIRROR @ outward),
    )
    assert first.counts == other.counts and len(first.counts) == 2
    faces = (one.T_ct_image[one.left][:, :3, [0, 1, 3]] for one in (first, other))
    planes = (next(faces), MIRROR @ next(faces))
    one, two = ({tuple((row.round(4) + 0.0).ravel().tolist()) for row in rows} for rows in planes)
    assert one == two and len(one) > 10


def test_the_abdomen_has_a_place_for_the_probe(abdomen, view):
    """Its arm reaches it; needle and target lie in the image plane; the sector meets no bone and no air."""
    context, plan = abdomen
    T, probe = view.T_ct_image, context.case.ultrasound
    assert view.assumed and view.depth_mm < probe.depth_mm
    flange = inverse(view.T_base_ct) @ flange_pose(probe.model, view.q_probe)
    assert flange @ probe_mount() == pytest.approx(T, abs=1e-6) and probe.model.within_limits(view.q_probe)
    assert apply(inverse(T), plan.target_ct) == pytest.approx([0.0, view.depth_mm, 0.0], abs=1e-6)
    assert apply(inverse(T), plan.entry_ct)[2] == pytest.approx(0.0, abs=1e-6)
    assert apply(inverse(T), plan.entry_ct)[0] > 0.0
    edge = np.linspace(-probe.width_mm / 2, probe.width_mm / 2, 5)
    ways = T[:3, 3] + edge[:, None] * T[:3, 0] - plan.target_ct
    far = np.linalg.norm(ways, axis=1)
    blocking = opaque(context.anatomy, "abdomen")
    assert [len(meshes) for meshes in blocking.values()] == [0, 6, 7]
    for mesh in (context.anatomy.structure(name).mesh for name in ("ribs_right", "costal_cartilages", "lung_right")):
        solid = trimesh.Trimesh(mesh.vertices, mesh.faces)
        at, ray, _ = solid.ray.intersects_location(np.tile(plan.target_ct, (5, 1)), ways / far[:, None])
        assert (np.linalg.norm(at - plan.target_ct, axis=1) > far[ray]).all()


def test_both_arms_keep_their_clearance_in_the_abdomen(abdomen, view):
    """FCL's distance of every body of the probe's arm, its head among them, from every one of the needle's."""
    context, plan = abdomen
    probe = context.case.ultrasound
    tools = handle_tool(LENGTH_MM - HEAD_MM[1], HANDLE_MM), context.reach.checker.tool
    head = fcl.Box(probe.width_mm + HEAD_MM[0], *HEAD_MM[1:])
    T_head = view.T_ct_image @ pose(np.eye(3), [0.0, -HEAD_MM[1] / 2, 0.0])
    mine = [fcl.CollisionObject(head, fcl.Transform(T_head[:3, :3], T_head[:3, 3]))]
    mine += placed(
        arm_bodies(probe.model, tools[0], 0.0), inverse(view.T_base_ct) @ link_poses(probe.model, view.q_probe)
    )
    bodies = arm_bodies(plan.model, tools[1], 0.0)
    for row, q in enumerate(plan.insertion.q):
        others = placed(bodies, inverse(plan.T_base_ct) @ link_poses(plan.model, q))
        least = min(fcl.distance(one, other) for one in mine for other in others)
        assert least > 0.0 and (least >= CLEARANCE_MM - 1e-3 or row not in (0, len(plan.insertion.q) - 1))


def placed(bodies, poses):
    found = []
    for body in bodies:
        body.place(poses)
        found += [piece.made for piece in body.bare.solids]
    return found


def test_a_stated_place_is_taken_or_answered_no(stated, abdomen, view):
    """The arm that was found is found again at its place; one that stands too far says so, and what would help."""
    context, plan = stated("ultrasound", T_base_ct_mount=view.T_base_ct)
    found = probe_view(context, plan)
    assert not found.assumed and (found.q_probe == view.q_probe).all() and "stated" in found.sentence
    far = view.T_base_ct @ pose(np.eye(3), [0.0, 0.0, 3000.0])
    none = probe_view(*stated("ultrasound", T_base_ct_mount=far))
    assert none.T_ct_image is None and none.q_probe is None and np.isnan(none.depth_mm)
    assert "free" not in none.counts and none.counts["out_of_reach"] > 20
    assert f"{none.counts['out_of_reach']} of" in none.sentence and "[ultrasound.mount]" in none.sentence
    assert sum(none.counts.values()) == sum(view.counts.values()) == 24 * len(ASIDE)


def test_an_obstacle_in_the_way_of_the_probes_arm_is_not_touched(stated, view):
    """A box about the elbow of the arm that was found: this configuration is gone; one beside its head: so is this."""
    context, plan = stated("ultrasound", T_base_ct_mount=view.T_base_ct)
    elbow = (inverse(view.T_base_ct) @ link_poses(context.case.ultrasound.model, view.q_probe))[3, :3, 3]
    obstacle = Obstacle("lamp", "ct", elbow, np.array([60.0, 60.0, 60.0]))
    blocked = replace(context, case=replace(context.case, obstacles=(*context.case.obstacles, obstacle)))
    other = probe_view(blocked, plan)
    assert other.q_probe is None or np.abs(other.q_probe - view.q_probe).max() > 0.1
    beside = apply(view.T_ct_image, np.array([context.case.ultrasound.width_mm / 2 + HEAD_MM[0] / 2 + 5.0, -15.0, 0.0]))
    lamp = replace(context.anatomy.surroundings[-1], mesh=box(pose(np.eye(3), beside), (4.0, 4.0, 4.0)))
    anatomy = replace(context.anatomy, surroundings=(*context.anatomy.surroundings, lamp))
    other = probe_view(replace(context, anatomy=anatomy), plan)
    assert other.counts["probe_arm_collision"] > view.counts.get("probe_arm_collision", 0)
    assert other.T_ct_image is None or np.abs(other.T_ct_image - view.T_ct_image).max() > 1.0


def test_an_assumed_place_that_is_taken_is_left_for_another(abdomen, view):
    """Where something is about the base that was found, the arm is assumed elsewhere; never next to the needle's."""
    context, plan = abdomen
    base = inverse(view.T_base_ct)[:3, 3]
    pillar = replace(context.anatomy.surroundings[-1], mesh=box(pose(np.eye(3), base), (80.0, 80.0, 80.0)))
    anatomy = replace(context.anatomy, surroundings=(*context.anatomy.surroundings, pillar))
    other = probe_view(replace(context, anatomy=anatomy), plan)
    assert other.T_base_ct is None or np.abs(inverse(other.T_base_ct)[:3, 3] - base).max() > 40.0
    for one in (view, other):
        if one.T_base_ct is not None:
            apart = inverse(one.T_base_ct)[:3, 3] - inverse(plan.T_base_ct)[:3, 3]
            assert np.linalg.norm(apart) >= BASES_APART_MM


def test_what_cannot_be_asked_is_refused(stated, abdomen):
    with refused("no_ultrasound", "[ultrasound]"):
        probe_view(*stated("ultrasound"))
    _, plan = abdomen
    with refused("base_in_patient", "ultrasound.mount"):
        probe_view(*stated("ultrasound", T_base_ct_mount=pose(np.eye(3), -plan.target_ct)))


def test_a_target_that_lies_too_deep_has_no_window(stated):
    """Every footprint is counted, and the way out is a probe that sees deeper."""
    view = probe_view(*stated("ultrasound", depth_mm=20.0))
    assert view.T_ct_image is None and set(view.counts) <= {"no_skin", "too_deep", "tilted"}
    assert "depth_mm" in view.sentence
