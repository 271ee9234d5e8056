"""The servo case's file, and the embedded room that it describes."""

import numpy as np
import pytest
from refusals import refused

from puncture_twin.meshes import folder
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.geometry.containment import winding_number
from puncture_twin.planning.geometry.rigid import apply
from puncture_twin.twin.guidance.stereo.planned import carried_rod, grid_points, head_pose, workcell_checker
from puncture_twin.twin.guidance.stereo.servo_case import load_servo_case
from puncture_twin.twin.guidance.stereo.servo_law import configurations, path_upward
from puncture_twin.twin.guidance.stereo.servo_loop import path_contact
from puncture_twin.twin.plant.stereo_workcell import StereoWorkcell, draw_workcell
from tools.phantoms.head import FLOOR_MM, MARKERS_MM, RIM_MM, head_field, head_targets

HEAD = folder() / "head"
TEXT = (HEAD / "servo.toml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def case():
    return load_servo_case(HEAD)


def written(tmp_path, text):
    for name in ("head.ply", "markers.csv", "targets.csv"):
        (tmp_path / name).symlink_to(HEAD / name)
    path = tmp_path / "servo.toml"
    path.write_text(text, encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("old", "new", "what"),
    [
        ("schema = 1", "schema = 2", "unknown_version"),
        ('mesh = "head.ply"', 'mesh = "lost.ply"', "no_such_file head.mesh lost.ply"),
        ('model = "ur3"', 'model = "ur99"', "unknown_robot ur99"),
        ("holder_mm = 40.0", "holder_mm = 400.0", "out_of_range holder_mm 400"),
        ("rod_diameter_mm = 3.0", "rod_diameter_mm = 9.0", "out_of_range"),
        ("tolerance_mm = 0.1", "tolerance_mm = nan", "bad_value tolerance_mm"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, what):
    assert old in TEXT
    with refused(*what.split()):
        load_servo_case(written(tmp_path, TEXT.replace(old, new, 1)))


def test_a_missing_case_is_named(tmp_path):
    with refused("no_such_file", "servo.toml"):
        load_servo_case(tmp_path)


def test_the_head_is_open_and_holds_its_targets(case):
    """Sixteen targets in the hollow's air with room for the ball; markers outside the solid; the mesh is closed."""
    field = head_field()
    targets, markers = np.array(list(head_targets().values())), np.array(list(MARKERS_MM.values()))
    assert targets == pytest.approx(case.targets.points, abs=1e-3)
    assert len(targets) == 16
    assert np.all(field(targets) > 15.0)
    assert np.all((targets[:, 2] > FLOOR_MM) & (targets[:, 2] < RIM_MM))
    assert np.all(field(markers) >= 4.0)
    assert case.skin.closed
    assert all(abs(winding_number(case.skin, point)) < 0.5 for point in np.concatenate([targets, markers]))
    assert np.abs(field(np.asarray(case.skin.vertices))).max() < 0.02


def test_both_cameras_see_every_target_and_marker(case):
    """No line of sight from either camera to a ball there meets the head, and all lie well inside the pictures."""
    workcell = draw_workcell(case, np.random.default_rng(0))
    for camera in workcell.cameras:
        for point in np.concatenate([workcell.targets_c, workcell.markers_c]):
            assert workcell.hidden_fraction(camera, point, 4.0) == 0.0
            assert camera.sees(camera.project(point), 40.0)


def test_a_ball_behind_the_head_is_hidden(case):
    """A ball beyond the far wall, below its rim, is hidden whole; one whose edge it touches in part."""
    workcell = draw_workcell(case, np.random.default_rng(0))
    behind = apply(workcell.T_c_m, np.array([0.0, 110.0, -60.0]))
    assert workcell.hidden_fraction(workcell.cameras[0], behind, 4.0) == 1.0
    heights = np.linspace(-60.0, 40.0, 60)
    shares = [
        workcell.hidden_fraction(workcell.cameras[0], apply(workcell.T_c_m, np.array([0, 110.0, z])), 4.0)
        for z in heights
    ]
    assert any(0.0 < share < 1.0 for share in shares)


def test_the_arm_reaches_everything_without_a_contact(case):
    """Calibration grid, every target from its hovering pose with the head there; no link before the ball."""
    workcell = draw_workcell(case, np.random.default_rng(0))
    rod, T = carried_rod(case), head_pose(case)
    calibrated = configurations(rod, grid_points(case), workcell_checker(case, None)).branch
    targets, checker = apply(T, case.targets.points), workcell_checker(case, T)
    q = configurations(
        rod, np.concatenate([targets, path_upward(rod, targets, case.file.servo.hover_mm)]), checker, first=calibrated
    ).q
    for aim, hover in zip(q[:16], q[16:], strict=True):
        assert path_contact(checker, np.stack([hover, aim])) is None
        assert not arm_hides_ball(workcell, aim)


def arm_hides_ball(workcell: StereoWorkcell, q):
    """Whether some link stands between a camera and the ball, by the links' own meshes."""
    poses = workcell.arm.true.link_poses(q)
    for link in collision_links(workcell.model)[1:]:
        T_c_link = workcell.T_c_base @ poses[link.frame]
        vertices = apply(T_c_link, np.asarray(link.mesh.vertices))
        for camera in workcell.cameras:
            pixels, ball = camera.project(vertices), camera.project(workcell.ball_c(q))
            if np.linalg.norm(pixels - ball, axis=1).min() < 30.0:
                return True
    return False
