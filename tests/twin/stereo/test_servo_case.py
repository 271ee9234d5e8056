"""The servo case's file, the errors that it declares, a truth drawn from them, and the embedded room."""

import numpy as np
import pytest
from refusals import refused
from servo_world import CASE

from benchmarks.servo_rooms import varied
from puncture_twin.meshes import folder
from puncture_twin.planning.arm.links import collision_links
from puncture_twin.planning.geometry.containment import winding_number
from puncture_twin.planning.geometry.rigid import apply, log_rotation
from puncture_twin.twin.guidance.stereo import servo_case
from puncture_twin.twin.guidance.stereo.servo_law import configurations, path_contact
from puncture_twin.twin.plant.stereo_workcell import StereoWorkcell, draw_workcell
from tools.phantoms.head import FLOOR_MM, MARKERS_MM, RIM_MM, head_field, head_targets

HEAD = folder() / "head"
TEXT = (HEAD / "servo.toml").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def case():
    return servo_case.load_servo_case(HEAD)


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
        ('model = "ur3"', 'model = "ur3"\nlink_mm = 0.3', "unknown_key link_mm"),
        ("[errors]", "[rehearsal.errors]", "missing_errors"),
        ("ball_offset_mm", "ball_ofset_mm", "unknown_key ball_offset_mm"),
        ("tip_offset_mm = 0.1", 'arm = ["nominal"]', "bad_value errors.arm"),
        ("hit_radius_mm = 0.5", "hit_radius_mm = 0", "bad_value target.hit_radius_mm"),
    ],
)
def test_mistakes_are_named(tmp_path, old, new, what):
    """Among them an error outside of its table, and a truth beside no belief."""
    assert old in TEXT
    with refused("no_such_file", "servo.toml"):
        servo_case.load_servo_case(tmp_path)
    with refused(*what.split()):
        servo_case.load_servo_case(written(tmp_path, TEXT.replace(old, new, 1)))


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


def test_both_cameras_see_every_target_and_marker_and_no_ball_behind_the_head(case):
    """No line of sight from either camera to a ball there meets the head, and all lie well inside the pictures.

    A ball beyond the far wall, below its rim, is hidden whole; one whose edge it touches in part.
    """
    workcell = draw_workcell(case, np.random.default_rng(0))
    for camera in workcell.cameras:
        for point in np.concatenate([workcell.targets_c, workcell.markers_c]):
            assert workcell.hidden_fraction(camera, point, 4.0) == 0.0
            assert camera.sees(camera.project(point), 40.0)
    behind = [apply(workcell.T_c_m, np.array([0.0, 110.0, z])) for z in np.linspace(-60.0, 40.0, 60)]
    hidden = [workcell.hidden_fraction(workcell.cameras[0], point, 4.0) for point in behind]
    assert hidden[0] == 1.0
    assert any(0.0 < fraction < 1.0 for fraction in hidden)


def test_the_arm_reaches_everything_without_a_contact(case):
    """Calibration grid, every target from its hovering pose with the head there; no link before the ball."""
    workcell = draw_workcell(case, np.random.default_rng(0))
    rod, T = servo_case.carried_rod(case), servo_case.head_pose(case)
    calibrated = configurations(rod, servo_case.grid_points(case), servo_case.workcell_checker(case, None)).branch
    targets, checker = apply(T, case.targets.points), servo_case.workcell_checker(case, T)
    hovers = targets - case.file.servo.hover_mm * rod.R_base_flange[:, 2]
    q = configurations(rod, np.concatenate([targets, hovers]), checker, first=calibrated).q
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


ROOMS = 200


def without_errors():
    start = TEXT.index("[errors]")
    return TEXT[:start] + TEXT[TEXT.index("[servo]") :]


def test_a_case_that_declares_nothing_has_the_defaults(tmp_path):
    errors = servo_case.load_servo_case(written(tmp_path, without_errors())).errors
    assert errors == servo_case.ServoErrors()
    assert (errors.link_mm, errors.tip_offset_mm, errors.marker_mm, errors.target_mm) == (0.05, 0.3, 0.3, 0.3)
    assert np.degrees(errors.twist) == pytest.approx(0.005)
    assert errors.ball_px is None
    assert servo_case.ServoErrors(arm="nominal").link_mm == 0.5
    assert servo_case.ServoErrors(arm="nominal", joint_deg=0.2, marker_mm=0.7).target_mm == 0.7


def test_what_is_stated_is_read_back():
    errors = CASE.errors.scaled(3.0)  # none of them is its default
    again = servo_case.ServoErrors.model_validate(errors.stated())
    assert again == errors
    assert again.scaled(2.0).head_turn == pytest.approx(2 * again.head_turn)
    assert again.scaled(2.0).camera_deviations() == pytest.approx(2 * again.camera_deviations())


def test_the_truth_is_drawn_from_the_declaration():
    """Over 200 rooms arm, cameras, lenses, tool and head scatter as declared: each within 4 standard errors."""
    keys = {"head_shift_mm": 0.4, "head_turn_deg": 0.2, "tip_offset_mm": 0.5, "needle_direction_deg": 0.3}
    case = varied(CASE, errors=keys)
    rooms = [draw_workcell(case, np.random.default_rng(seed)) for seed in range(ROOMS)]
    errors, plan = case.errors, servo_case.planned_cameras(case)[0]
    moved = np.array([np.linalg.inv(workcell.T_c_m) @ workcell.T_c_m_after for workcell in rooms])
    scatter = {
        "ball": (np.array([workcell.tool.ball_offset for workcell in rooms]), errors.ball_offset_mm),
        "tip": (np.array([workcell.tool.tip_offset for workcell in rooms]), errors.tip_offset_mm),
        "lean": (np.array([workcell.tool.lean[:2] for workcell in rooms]), errors.needle_direction),
        "links": (np.array([workcell.arm.true.a - workcell.arm.nominal.a for workcell in rooms]), errors.link_mm),
        "zeros": (np.array([one.arm.true.zeros for one in rooms]), errors.joint),
        "axis": (np.array([one.cameras[0].cx - plan.cx for one in rooms]), errors.camera_axis_px),
        "k1": (np.array([one.cameras[1].distortion[0] - plan.distortion[0] for one in rooms]), errors.lens[0]),
        "turn": (log_rotation(moved[:, :3, :3]), errors.head_turn),
    }
    for name, (drawn, deviation) in scatter.items():
        rms = np.sqrt(np.mean(drawn**2))
        assert rms == pytest.approx(deviation, rel=4 / np.sqrt(2 * drawn.size)), name


def test_another_truth_leaves_the_belief_alone():
    """``[rehearsal.errors]`` changes what is drawn, is said to be a wrong belief, and guidance believes as before."""
    wrong = varied(CASE, rehearsal={"errors": CASE.errors.scaled(3.0).stated()})
    assert wrong.wrong_belief
    assert not CASE.wrong_belief
    assert wrong.errors == CASE.errors
    one, other = (draw_workcell(case, np.random.default_rng(1)) for case in (CASE, wrong))
    np.testing.assert_allclose(other.tool.tip_offset, 3 * one.tool.tip_offset)
    np.testing.assert_allclose(other.arm.true.zeros, 3 * one.arm.true.zeros)
