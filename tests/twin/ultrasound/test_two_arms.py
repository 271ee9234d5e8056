"""The room of the two arms: who touches whom, which poses can be taken, and the operator's jog."""

from itertools import product

import fcl
import numpy as np
import pytest
from refusals import refused

from puncture_twin.planning.arm.kinematics import flange_pose, link_poses
from puncture_twin.planning.arm.links import visual_links
from puncture_twin.planning.base.errors import NoAnswerError
from puncture_twin.planning.collision.bodies import surface, touch
from puncture_twin.planning.geometry.containment import winding_number
from puncture_twin.planning.geometry.mesh import box
from puncture_twin.twin.guidance.ultrasound import pose_choice
from puncture_twin.twin.guidance.ultrasound.selfcal_case import SelfcalCase, SelfcalFile, load_selfcal_case
from puncture_twin.twin.plant.bmode_image import NeedleInImage
from puncture_twin.twin.plant.ultrasound_workcell import draw_workcell, jog_into_slice
from puncture_twin.twin.report.scene.scene_parts import bar


def make_case(**sections):
    content = SelfcalFile.model_validate({"schema": 1, "name": "room", **sections})
    return SelfcalCase(path=None, content=content, inputs=())


@pytest.fixture(scope="module")
def case():
    """Two UR3, 150 draws."""
    return make_case(poses={"samples": 150})


@pytest.fixture(scope="module")
def room(case):
    return pose_choice.TwoArms(case)


@pytest.fixture(scope="module")
def candidates(case, room):
    return pose_choice.find_candidates(case, room, np.random.default_rng(5))


def arm_surfaces(model, tool, extra=()):
    """Every link as it ships, and the tool, as surfaces with the frames that they move with."""
    meshes = [(link.frame, link.mesh) for link in visual_links(model)]
    z = np.array([0.0, 0.0, 1.0])
    meshes.append((6, bar(0.0 * z, tool.holder_length_mm * z, tool.holder_diameter_mm / 2)))
    meshes.append((6, bar(tool.holder_length_mm * z, tool.needle_length_mm * z, tool.needle_diameter_mm / 2)))
    return [(frame, fcl.CollisionObject(surface(mesh))) for frame, mesh in (*meshes, *extra)]


def meshes_touch(surfaces, poses):
    for parts, frames in zip(surfaces, poses, strict=True):
        for frame, part in parts:
            part.setTransform(fcl.Transform(frames[frame][:3, :3], frames[frame][:3, 3]))
    return any(touch(a, b) for (_, a), (_, b) in product(*surfaces))


def test_apart_against_the_links_own_meshes(case, room, candidates):
    """Arms that are apart have meshes that do not touch; meshes that touch belong to arms that are not apart."""
    between = pose_choice.between_arms(case, case.T_end1_image, case.T_base1_base2, 0.0)
    head = box(pose_choice.head_pose(case, case.T_end1_image), case.content.probe.head_mm)
    surfaces = (
        arm_surfaces(room.probe_model, pose_choice.probe_tool(case), [(6, head)]),
        arm_surfaces(room.needle_model, pose_choice.needle_tool(case)),
    )
    rng = np.random.default_rng(6)
    verdicts = []
    for _ in range(40):
        q_probe = candidates.q_probe[rng.integers(len(candidates.q_probe))]
        q_needle = candidates.q_needle[rng.integers(len(candidates.q_needle))] + rng.normal(0.0, 0.15, 6)
        poses = (link_poses(room.probe_model, q_probe), case.T_base1_base2 @ link_poses(room.needle_model, q_needle))
        verdicts.append((between.apart(q_probe, q_needle), meshes_touch(surfaces, poses)))
    assert (True, True) not in verdicts
    assert (False, True) in verdicts
    assert verdicts.count((False, False)) <= 0.2 * len(verdicts)  # hulls are fuller than the links, but not much


def test_clearance_is_kept(case, room, candidates):
    """Where the arms are apart with a clearance, FCL's distance of their bodies is at least that."""
    between = pose_choice.between_arms(case, case.T_end1_image, case.T_base1_base2, 0.0)
    for q_probe, q_needle in zip(candidates.q_probe[:6], candidates.q_needle[:6], strict=True):
        assert between.apart(q_probe, q_needle)
        pieces = [
            [piece.made for body in bodies for piece in body.bare.solids]
            for bodies in (between.probe_bodies, between.needle_bodies)
        ]
        least = min(fcl.distance(a, b) for a, b in product(*pieces))
        assert least >= case.content.poses.clearance_mm - 1e-3


def test_candidates_show_the_needle_in_the_image(case, room, candidates):
    """By the drawing's kinematics: tip where it should show, shaft in the plane, within limits, nothing touches."""
    n = len(candidates.q_probe)
    assert n == candidates.counts["ok"] >= 10
    assert sum(candidates.counts.values()) == case.content.poses.samples
    A, B = (flange_pose(room.probe_model, candidates.q_probe), flange_pose(room.needle_model, candidates.q_needle))
    assert np.abs(A - candidates.poses.A).max() < 1e-6
    assert np.abs(B - candidates.poses.B).max() < 1e-6
    T = np.linalg.inv(A @ case.T_end1_image) @ case.T_base1_base2 @ B
    tip = T[:, :3, :3] @ case.tip_end2 + T[:, :3, 3]
    assert np.abs(tip - np.column_stack([candidates.poses.P, np.zeros(n)])).max() < 1e-6
    assert np.abs(T[:, :3, 2] - np.column_stack([candidates.poses.v, np.zeros(n)])).max() < 1e-9
    width, depth = case.content.image.imager().size_mm
    assert ((candidates.poses.P > 5.0) & ([width - 5.0, depth - 5.0] > candidates.poses.P)).all()
    for q_probe, q_needle in zip(candidates.q_probe, candidates.q_needle, strict=True):
        assert room.probe_model.within_limits(q_probe)
        assert room.needle_model.within_limits(q_needle)
        assert room.verdict(q_probe, q_needle) is None


def test_the_face_stays_off_the_phantom(case):
    """Its lowest corner is the gel's thickness above the phantom's upper side, at every tilt."""
    seen = pose_choice.draw_geometry(case, 200, np.random.default_rng(7))
    width, _ = case.content.image.imager().size_mm
    head = case.content.probe.head_mm
    corners = np.array([[width / 2 + a * head[0] / 2, 0.0, b * head[2] / 2] for a, b in product((-1, 1), repeat=2)])
    heights = np.einsum("nij,kj->nki", seen.T_base1_image[:, :3, :3], corners) + seen.T_base1_image[:, None, :3, 3]
    gel = case.content.phantom.top_mm[2] + case.content.phantom.gel_mm
    assert np.abs(heights[:, :, 2].min(axis=1) - gel).max() < 1e-9


def test_a_probe_in_the_phantom_is_refused(case, room, candidates):
    """The same pose 12 mm lower: the head is in the tissue."""
    T = np.array(candidates.poses.A[0])
    T[2, 3] -= 12.0
    lowered = pose_choice.configurations(room.probe_model, T[None], candidates.q_probe[0])[0]
    assert len(lowered) > 0
    assert not any(room.probe_free(q) for q in lowered)


def test_a_needle_arm_out_of_reach_is_an_answer(room):
    """With the base 2 m away nothing can be taken, and the counts say why."""
    far = make_case(needle_arm={"position_mm": [2000.0, 0.0, 0.0]}, poses={"samples": 20})
    with refused("no_pose", by=NoAnswerError) as error:
        pose_choice.find_candidates(far, room, np.random.default_rng(0))
    assert error.value.counts["needle_out_of_reach"] > 0


def test_inside_phantom_against_the_winding_number(case):
    phantom = case.content.phantom
    rng = np.random.default_rng(8)
    low, high = pose_choice.phantom_mesh(phantom).bounds
    points = rng.uniform(low - 10.0, high + 10.0, (200, 3))
    mesh = pose_choice.phantom_mesh(phantom)
    inside = pose_choice.inside_phantom(phantom, points)
    wound = np.array([abs(winding_number(mesh, point)) > 0.5 for point in points])
    nearest = np.array([np.linalg.norm(mesh.vertices - point, axis=1).min() for point in points])
    sure = nearest > 6.0
    assert np.array_equal(inside[sure], wound[sure])
    assert 0 < inside.sum() < len(points)


def test_the_jog_brings_the_true_needle_into_the_slice(case, candidates):
    """Arms, mounts and needle differ from the drawing; after the jog the true needle stands as wanted."""
    rng = np.random.default_rng(9)
    truth = draw_workcell(case, rng)
    for row in range(5):
        before = truth.needle_in_image(candidates.q_probe[row], candidates.q_needle[row])
        assert np.linalg.norm(before.tip_image[:2] - candidates.poses.P[row]) > 0.5
        wanted = NeedleInImage(np.array([*candidates.poses.P[row], 0.1]), np.array([*candidates.poses.v[row], 0.0]))
        start, roll = candidates.q_needle[row], float(candidates.roll[row])
        q = jog_into_slice(truth, candidates.q_probe[row], start, wanted, roll)
        after = truth.needle_in_image(candidates.q_probe[row], q)
        assert np.abs(after.tip_image - wanted.tip_image).max() < 1e-3
        assert np.abs(after.direction_image - wanted.direction_image).max() < 1e-6


def test_true_rooms_are_seeded_and_differ_as_asked():
    """The same seed draws the same room; without deviations it is the drawing."""
    exact = {"link_mm": 0.0, "twist_deg": 0.0, "joint_deg": 0.0, "repeatability_deg": 0.0}
    none = {"mount_mm": 0.0, "mount_deg": 0.0, "tip_mm": 0.0, "length_mm": 0.0, "needle_deg": 0.0}
    plain = make_case(probe_arm={"errors": exact}, needle_arm={"errors": exact}, truth=none)
    drawn = draw_workcell(plain, np.random.default_rng(1))
    assert np.abs(drawn.X - plain.T_end1_image).max() < 1e-12
    assert np.abs(drawn.Y - plain.T_base1_base2).max() < 1e-12
    assert drawn.tip_end2 == pytest.approx(plain.tip_end2)
    usual = make_case()
    one, again, other = (draw_workcell(usual, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert np.array_equal(one.X, again.X)
    assert not np.array_equal(one.X, other.X)
    rooms = [draw_workcell(usual, np.random.default_rng(seed)) for seed in range(80)]
    errors = np.array([drawn.Y[:3, 3] - usual.T_base1_base2[:3, 3] for drawn in rooms])
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(usual.content.truth.mount_mm, rel=0.2)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ('schema = 1\nname = "x"\n[probe_arm]\nmodel = "ur3e"\n', "unknown_robot"),
        ('schema = 1\nname = "x"\n[needle]\nshaft_mm = 300.0\n', "out_of_range length_mm"),
        ('schema = 1\nname = "x"\n[phantom]\ntop_mm = [300.0, 0.0, 50.0]\n', "out_of_range"),
        ('schema = 1\nname = "x"\n[poses]\ninsertion_deg = [60.0, 30.0]\n', "range_descends"),
        ('schema = 1\nname = "x"\n[truth]\nclick_mm = "a lot"\n', "bad_value click_mm"),
    ],
)
def test_bad_cases_are_refused(tmp_path, text, says):
    (tmp_path / "selfcal.toml").write_text(text)
    with refused(*says.split()):
        load_selfcal_case(tmp_path)
